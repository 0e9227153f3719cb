"""Gain and filter pole for a budget of chatter: as much adaptation as the noise of the measured response allows.

The largest gain is sought with which noise alone moves no input by more than its budget per cycle, at any of some
points of the reference (`contraction.noise`), the filter's pole following the gain so that the iteration keeps its
damping. What noise leaves of tracking is independent of both, as long as the iteration is fast against the tracking
law: the plant then realises d - n, which acts as -n at its response in the loop with the right model.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from fpirhc.by_name import FoundByName
from fpirhc.contraction.noise import filter_pole
from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import resolved, without_deformation
from fpirhc.deformation.base import Deformation, with_inner
from fpirhc.deformation.wrappers.filtered import Filtered
from fpirhc.errors import FpirhcError, InvalidName, InvalidValue, NotContractive, NotSupported, nearest
from fpirhc.fields.checked import checked_call
from fpirhc.review.grid import review_grid
from fpirhc.review.loops import loops_along
from fpirhc.review.noise_along import Noisy, noisy_points
from fpirhc.review.question import TRIED
from fpirhc.simulation.linearise.linear_loop import LinearLoop
from fpirhc.simulation.trials import Trials, harm_in
from fpirhc.summary import line, number, table
from fpirhc.task.problem import Problem

RINGING = 6.0  # kappa: damping 0.2, between 4 and 8, beyond which tracking gains nothing
_BISECTIONS = 50
_SMALLEST = 1e-6  # of the deadbeat gain


@dataclass(frozen=True, eq=False)
class Suggestion(FoundByName):
    """Gain and pole, and what noise does with them.

    Parameters:
        deformation: the controller's own with gain and pole; put it in with `dataclasses.replace`.
        effective_gain, pole: of it. gain: the map's own gain, `gain_name` its field.
        chatter: by input, predicted rms of the command's step per cycle that noise causes, in the input's unit.
        floor: by controlled coordinate, predicted rms tracking error that noise causes, in the coordinate's unit; NaN where no
            linear loop is known.
        harm: what runs on the plant and on the controller's own model show against it, beside no adaptation; empty without harm.
    """

    deformation: Deformation
    effective_gain: float
    pole: float
    gain_name: str
    gain: float
    chatter: Mapping[str, float]
    floor: Mapping[str, float]
    harm: str = ""

    def __repr__(self) -> str:
        return line(self, *(f"{name} {value}" for name, value in self._facts()))

    def _repr_html_(self) -> str:
        """Gain, pole and predictions as a table, for notebooks."""
        return table("Suggested gain", ("", "value"), self._facts(), [])

    def _facts(self) -> list[tuple[str, str]]:
        own = [(self.gain_name, number(self.gain)), ("pole", number(self.pole))]
        steps = [(f"step of {i} per cycle", number(v)) for i, v in self.chatter.items()]
        against = [("against it", self.harm)] if self.harm else []
        return [*own, *steps, *((f"rms error of {c} from noise", number(v)) for c, v in self.floor.items()), *against]


@checked_call
def suggest(
    problem: Problem,
    controller: Controller,
    *,
    chatter: float | Mapping[str, float],
    noise: Mapping[str, float] | None = None,
    ringing: float = RINGING,
) -> Suggestion:
    """Return the largest gain, with the pole of a filter of its error, whose chatter is within a budget.

    The gain ends at the deadbeat one, the inverse of the largest eigenvalue of the response Jacobian along the reference. The
    wrappers of the deformation stay, a `Filtered` among them is replaced. It is run on the plant and on the controller's model, for
    1000 cycles at most: where no adaptation does better, `harm` says so.

    Parameters: `chatter`: rms step of the command per cycle that noise may cause, in the input's unit, by input or one for all;
    `noise`: standard deviation of the measured response by controlled coordinate, by default that of the problem's sensors;
    `ringing` kappa = a lambda / (1 - p), 0 for no filter.

    Raises:
        InvalidValue: a budget that is not positive, a negative noise or ringing, no noise. InvalidName: unknown input
        or coordinate. NotSupported: a controller without adaptation; a response that is estimated, whose noise must
        be given. NotInvertible: see `review`. NotContractive: eigenvalues that no gain suits.
    """
    found = within_budget(problem, controller, chatter=chatter, noise=noise, ringing=ringing)
    return replace(found, harm=_harm(problem, controller, found.deformation))


def within_budget(
    problem: Problem,
    controller: Controller,
    *,
    chatter: float | Mapping[str, float],
    noise: Mapping[str, float] | None = None,
    ringing: float = RINGING,
) -> Suggestion:
    """Return what `suggest` does, before it is run."""
    ready = resolved(problem, controller)
    _check(ready, ringing)
    budget = _budget(problem, chatter)
    grid = review_grid(problem, 0.0, 0)
    noisy = noisy_points(grid, ready, noise)
    sign, largest = _largest_eigenvalue(noisy.jacobians)

    def fits(size: float) -> bool:
        return bool((noisy.steps(sign * size, filter_pole(size * largest, ringing)) <= budget).all())

    size = _largest_within(fits, 1 / largest)
    pole = filter_pole(size * largest, ringing)
    deformation = _with(ready.deformation, sign * size, pole)
    own = getattr(deformation, deformation.gain_name, None)
    name, value = ("effective gain", sign * size) if own is None else (deformation.gain_name, float(own))
    predicted = dict(zip(problem.plant.inputs, map(float, noisy.steps(sign * size, pole)), strict=True))
    floor = _floor(loops_along(grid, ready).ideal, noisy, problem)
    return Suggestion(deformation, sign * size, pole, name, value, predicted, floor)


def _harm(problem: Problem, controller: Controller, deformation: Deformation) -> str:
    try:
        trials = Trials(problem, without_deformation(controller), cycles=TRIED)
        return harm_in(*trials.errors(controller.with_deformation(deformation)))
    except FpirhcError as error:
        return f"it cannot be tried ({error})"


def _check(controller: Controller, ringing: float) -> None:
    if controller.deformation.effective_gain() == 0:
        raise NotSupported(
            f"{type(controller).__name__} has no deformation to choose a gain for; give it Sigmoid(gain=...)"
        )
    if not (math.isfinite(ringing) and ringing >= 0):
        raise InvalidValue(
            f"suggest(ringing={ringing!r}): expected a number of at least 0; 4 to 8 is usual, 0 is no filter"
        )


def _budget(problem: Problem, chatter: float | Mapping[str, float]) -> np.ndarray:
    inputs = tuple(problem.plant.inputs)
    budgets = chatter if isinstance(chatter, Mapping) else dict.fromkeys(inputs, chatter)
    for name, value in budgets.items():
        if name not in inputs:
            raise InvalidName(f"suggest(chatter=...): input '{name}' is unknown.{nearest(name, inputs)}")
        if not value > 0:
            raise InvalidValue(
                f"suggest(chatter=...): {value!r} for '{name}'; expected a positive rms step per cycle, in the unit of the input"
            )
    return np.array([float(budgets.get(name, math.inf)) for name in inputs])


def _largest_eigenvalue(jacobians: np.ndarray) -> tuple[float, float]:
    """Sign of the gain, and the inverse of the deadbeat gain: the largest |lambda|^2 / |Re lambda|."""
    values = np.linalg.eigvals(jacobians).ravel()
    if values.real.min() * values.real.max() <= 0:
        raise NotContractive(
            f"the response Jacobian has eigenvalues with real parts from {values.real.min():.4g} to {values.real.max():.4g} along "
            "the reference: no gain converges"
        )
    return float(np.sign(values.real[0])), float((np.abs(values) ** 2 / np.abs(values.real)).max())


def _largest_within(fits: Callable[[float], bool], most: float) -> float:
    low, high = _SMALLEST * most, most
    if fits(high):
        return high
    for _ in range(_BISECTIONS):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


def _with(deformation: Deformation, gain: float, pole: float) -> Deformation:
    """The deformation with that gain, its error filtered inside all other wrappers."""
    inner = deformation.inner
    if inner is None:
        changed = deformation.with_effective_gain(gain)
        return Filtered(changed, pole=pole) if pole else changed
    if deformation.iteration.error_pole != inner.iteration.error_pole:  # a filter, which the new one replaces
        return _with(inner, gain, pole)
    return with_inner(deformation, _with(inner, gain, pole))


def _floor(ideal: LinearLoop | None, noisy: Noisy, problem: Problem) -> dict[str, float]:
    """Rms of the coordinates in the loop with the right model, with noise at the response."""
    plant = problem.plant
    if ideal is None or ideal.radius >= 1:
        return dict.fromkeys(plant.controlled_names, math.nan)
    spread = ideal.spread(noisy.inverses[0] @ noisy.covariance @ noisy.inverses[0].T)
    sizes = np.sqrt(np.diag(ideal.errors @ spread @ ideal.errors.T))
    judged = dict(zip(problem.judged_names, map(float, sizes), strict=True))
    return {c: judged.get(c, math.nan) for c in plant.controlled_names}
