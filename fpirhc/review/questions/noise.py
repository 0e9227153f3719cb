"""What does the noise of sensors do? The chatter of the commands, and the gain and filter that it asks for.

`suggest` seeks the largest gain with which noise alone moves no input by more than its budget per cycle, at any of some points of
the reference; the filter's pole follows the gain, so that the iteration keeps its damping. A review's budget is 1 % of the range
between the limits of an input, or the chatter of the deformation in use where no input has limits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from fpirhc.contraction.spectrum import Spectrum
from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import refuse_without, resolved, without_deformation
from fpirhc.deformation.base import Deformation, own_gain, with_inner
from fpirhc.deformation.wrappers.filtered import Filtered
from fpirhc.errors import FpirhcError, InvalidName, InvalidValue, NotContractive, nearest
from fpirhc.fields.checked import FoundByName, checked_call
from fpirhc.fields.kinds import NotNegative
from fpirhc.plant.motion import with_space
from fpirhc.review.grid import ReviewGrid, review_grid
from fpirhc.review.loops import Points, points_of, spectrum_near, thinned, usable
from fpirhc.review.prediction import TRIED
from fpirhc.review.question import Answer, Case, ControllerQuestion, Verdict
from fpirhc.sensing.base import response_names
from fpirhc.simulation.linearise.linear_loop import LinearLoop
from fpirhc.simulation.linearise.linear_map import behind_noise
from fpirhc.simulation.trials import Trials, harm_in
from fpirhc.summary import in_percent, line, number, table
from fpirhc.task.problem import Problem

RINGING = 6.0  # kappa: damping 0.2, between 4 and 8, beyond which tracking gains nothing
_TRIED, _BISECTIONS = 49, 40  # gains, and parts of the way between two of them
_PLACES = 9  # points of the reference
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
    ringing: NotNegative = RINGING,
) -> Suggestion:
    """Return the largest gain, with the pole of a filter of its error, whose chatter is within a budget.

    The gain ends at the deadbeat one, the inverse of the largest eigenvalue of the response Jacobian along the reference. The
    wrappers of the deformation stay, a `Filtered` among them is replaced. It is run on the plant and on the controller's model, for
    1000 cycles at most: where no adaptation does better, `harm` says so.

    Parameters: `chatter`: rms step of the command per cycle that noise may cause, in the input's unit, by input or one for all;
    `noise`: standard deviation of the measured response by controlled coordinate, by default that of the problem's sensors;
    `ringing` kappa = a lambda / (1 - p), 0 for no filter; where no gain is within the budget with a filter, one without is sought.

    Raises:
        InvalidValue: a budget that is not positive, a negative noise or ringing, no noise, as of a response that is estimated,
        whose noise must be given. InvalidName: unknown input or coordinate. NotSupported: a controller without adaptation.
        NotInvertible: see `review`. NotContractive: eigenvalues that no gain suits; a budget that no gain keeps.
    """
    suggestion = _within_budget(problem, controller, chatter, noise, ringing)
    return replace(suggestion, harm=_harm(problem, controller, suggestion.deformation))


def _within_budget(
    problem: Problem,
    controller: Controller,
    chatter: float | Mapping[str, float],
    noise: Mapping[str, float] | None = None,
    ringing: NotNegative = RINGING,
) -> Suggestion:
    """Return what `suggest` does, before it is run."""
    ready = resolved(problem, controller)
    if ready.deformation.effective_gain() == 0:
        refuse_without(ready, "deformation to choose a gain for; give it Sigmoid(gain=...)")
    budget = _allowed(problem, chatter)
    grid = review_grid(problem, 0.0, 0)
    noisy = noisy_points(grid, ready, noise)
    believed = ready.plant_model(problem).parameters(problem.plant)
    sign, largest = _largest_eigenvalue(
        spectrum_near(grid, believed, grid.draws[:1], ready.deformation.iteration, near=False)
    )

    def sought(kappa: float) -> float:
        return _largest_within(
            lambda size: noisy.steps(sign * size, filter_pole(size * largest, kappa)), budget, 1 / largest
        )

    try:
        size = sought(ringing)
    except NotContractive:
        if not ringing:
            raise
        size, ringing = sought(0.0), 0.0  # with small eigenvalues of coupled responses a filter makes the loop grow
    pole = filter_pole(size * largest, ringing)
    deformation = _with(ready.deformation, sign * size, pole)
    name, value = own_gain(deformation)
    predicted = dict(zip(problem.plant.inputs, map(float, noisy.steps(sign * size, pole)), strict=True))
    floor = noisy.errors(sign * size, pole, problem)
    return Suggestion(deformation, sign * size, pole, name, value, predicted, floor)


def _harm(problem: Problem, controller: Controller, deformation: Deformation) -> str:
    try:
        trials = Trials(problem, without_deformation(controller), cycles=TRIED)
        return harm_in(*trials.errors(controller.with_deformation(deformation)))
    except FpirhcError as error:
        return f"it cannot be tried ({error})"


def _allowed(problem: Problem, chatter: float | Mapping[str, float]) -> np.ndarray:
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


def _largest_eigenvalue(spectrum: Spectrum) -> tuple[float, float]:
    """Sign of the gain, and the inverse of the deadbeat gain: the largest |lambda|^2 / |Re lambda|."""
    values, low, high = spectrum.eigenvalues, spectrum.smallest_real, spectrum.largest_real
    if low * high <= 0:
        raise NotContractive(
            f"the response Jacobian has eigenvalues with real parts from {low:.4g} to {high:.4g} along the reference: no "
            "gain converges"
        )
    return math.copysign(1.0, low), float((np.abs(values) ** 2 / np.abs(values.real)).max())


class _OverBudget(NotContractive):
    """The loop converges with some gains, and none of them is within the budget."""


def _largest_within(steps: Callable[[float], np.ndarray], budget: np.ndarray, most: float) -> float:
    """The largest gain within the budget, sought downwards: with a small one the loop itself may grow."""

    def fits(size: float) -> bool:
        return bool((steps(size) <= budget).all())

    sizes = most * np.geomspace(1.0, _SMALLEST, _TRIED)
    place = next((k for k, size in enumerate(sizes) if fits(size)), None)
    if place is None:
        least = min(float((steps(size) / budget).max()) for size in sizes)
        if not math.isfinite(least):
            raise NotContractive(
                f"the loop converges with no effective gain from {sizes[-1]:.3g} to {most:.3g} in size"
            )
        raise _OverBudget(
            f"no gain is within the budget: its chatter is at least {least:.3g} times as large with every gain with which the loop "
            "converges; allow more, or measure with less noise"
        )
    low, high = sizes[place], sizes[max(place - 1, 0)]
    for _ in range(_BISECTIONS if place else 0):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if fits(middle) else (low, middle)
    return float(low)


def _with(deformation: Deformation, gain: float, pole: float) -> Deformation:
    """The deformation with that gain, its error filtered inside all other wrappers."""
    inner = deformation.inner
    if inner is None:
        changed = deformation.with_effective_gain(gain)
        return Filtered(changed, pole=pole) if pole else changed
    if deformation.iteration.error_pole != inner.iteration.error_pole:  # a filter, which the new one replaces
        return _with(inner, gain, pole)
    return with_inner(deformation, _with(inner, gain, pole))


_DRAWN = 20_000  # values of a noise, whose spread is its deviation
_POLE = 0.5  # of the filter of loops from which those of others are interpolated


@dataclass(frozen=True, eq=False)
class Noisy:
    """Linear loops behind noise of the response that the map sees; build it with `noisy_points`.

    The matrices of a cycle are affine in the gain and in the pole of the filter of its error, so four loops are those of all.

    Parameters: corners: loops of each point for (a / 2, 0), (a, 0), (a / 2, pole), (a, pole) of the map's own gain a;
    gain: a; covariance (n, n) of the noise.
    """

    corners: tuple[tuple[LinearLoop, ...], ...]
    gain: float
    covariance: np.ndarray

    def steps(self, gain: float, pole: float) -> np.ndarray:
        """Return the rms step of every input (nu,), the largest of all points; infinite where noise grows."""
        return np.asarray(np.max([one.steps(self.covariance) for one in self._loops(gain, pole)], axis=0))

    def errors(self, gain: float, pole: float, problem: Problem) -> dict[str, float]:
        """Return the rms error from noise by controlled coordinate, the largest of all points; NaN of what is not judged."""
        spreads = [one.errors @ one.spread(self.covariance) @ one.errors.T for one in self._loops(gain, pole)]
        rms = np.sqrt(np.max([np.diag(one) for one in spreads], axis=0))
        judged = dict(zip(problem.judged_names, map(float, rms), strict=True))
        return {c: judged.get(c, math.nan) for c in problem.plant.controlled_names}

    def _loops(self, gain: float, pole: float) -> list[LinearLoop]:
        share = 2 * (gain / self.gain - 1)
        return [b.mixed(a, share).mixed(d.mixed(c, share), -pole / _POLE) for a, b, c, d in self.corners]


def noisy_points(grid: ReviewGrid, controller: Controller, noise: Mapping[str, float] | None) -> Noisy:
    """Return the loops at points of the reference with the noise of the problem's sensors, or the given one.

    Parameters: `controller`, resolved; `noise`: standard deviation of the measured response by controlled coordinate.
    """
    covariance, gain = np.diag(_deviations(grid.problem, noise) ** 2), controller.deformation.effective_gain()
    bare = controller.with_deformation(_with(controller.deformation, gain, 0.0))
    points = Points(grid, behind_noise(bare))
    places = thinned(usable(grid), _PLACES if points.asked.quick else _POINTS)
    corners = [(share * gain, pole) for pole in (0.0, _POLE) for share in (0.5, 1.0)]
    return Noisy(tuple(points.shaken(k, corners) for k in places), gain, covariance)


def chatter_of(grid: ReviewGrid, controller: Controller, gain: float, pole: float) -> dict[str, float]:
    """Return, by input, the rms step of the command per cycle that the noise of the problem's sensors causes.

    Parameters: `controller`, resolved; effective `gain` and `pole` of the filter of its error.
    """
    noisy = noisy_points(grid, controller, None)
    return dict(zip(grid.problem.plant.inputs, map(float, noisy.steps(gain, pole)), strict=True))


def _deviations(problem: Problem, noise: Mapping[str, float] | None) -> np.ndarray:
    """Standard deviation of every controlled coordinate's measured response."""
    names = problem.plant.controlled_names
    spreads = _of_sensors(problem) if noise is None else noise
    for name, value in spreads.items():
        if name not in names:
            raise InvalidName(f"suggest(noise=...): coordinate '{name}' is not controlled.{nearest(name, names)}")
        if not 0 <= value < math.inf:
            raise InvalidValue(
                f"suggest(noise=...): {value!r} for '{name}'; expected a standard deviation of at least 0"
            )
    levels = np.array([float(spreads.get(name, 0.0)) for name in names])
    if not levels.any():
        raise InvalidValue(
            "suggest: no response has noise, so no gain chatters; give noise={'"
            + names[0]
            + "': ...}, the standard deviation of "
            "the measured response"
        )
    return levels


def _of_sensors(problem: Problem) -> dict[str, float]:
    """Deviation of the noise of the sensors that measure responses."""
    plant, sensing = problem.plant, problem.sensing
    measured = dict(zip(response_names(plant), plant.controlled_names, strict=True))
    if sensing.sensors and not set(measured) & set(sensing.measures(plant)):
        raise InvalidValue(
            f"suggest: the response is estimated by {type(sensing.estimator).__name__}, whose noise is not white; give "
            "noise={coordinate: standard deviation of the estimated response}"
        )
    times = problem.period * np.arange(_DRAWN)
    noises = {measured[name]: sensor.noise for name, sensor in sensing.sensors.items() if name in measured}
    random = np.random.default_rng(0)
    return {c: float(np.std(n.values(times, random))) for c, n in noises.items() if n is not None}


def filter_pole(product: float, ringing: float) -> float:
    """Return p with a lambda / (1 - p) = ringing; 0 where the product exceeds the ringing, and where the ringing is 0."""
    return max(0.0, 1 - product / ringing) if ringing else 0.0


CHATTER = "Is the chatter from measured responses small?"
SMALL = 0.01  # of the range between an input's limits
_POINTS = 3  # of the reference, whose loops are asked
_WHITE = 0.03  # correlation of a drawn series with itself one cycle later, below which it is white


def chatter_small(case: Case) -> Answer | None:
    """Return the rms steps of the commands that noise causes in the whole loop, by its discrete Lyapunov equation.

    None without noise, for maps and models that change on line, and where a linear loop does not converge.
    """
    problem, deformation = case.problem, case.controller.deformation
    loops = _noisy_loops(case) if deformation.iteration.constant or not deformation.adapts else None
    if loops is None:
        return None
    rms = np.max([one.steps(covariance) for one, covariance in loops], axis=0)
    steps = dict(zip(problem.plant.inputs, map(float, rms), strict=True))
    lower, upper = problem.limits.input_bounds(problem.plant)
    share = float(np.max(rms / (upper - lower)))
    units = dict(zip(problem.plant.inputs, problem.plant.input.units, strict=True))
    text = "rms step per cycle from noise: " + ", ".join(f"{i} {v:.3g}{with_space(units[i])}" for i, v in steps.items())
    if share > 0:
        text += f"; {in_percent(share)} of the range between limits, and less than {in_percent(SMALL)} is small"
    numbers = {f"step_{i}": v for i, v in steps.items()} | {"share_of_limits": share}
    if share < SMALL:
        return Answer(CHATTER, Verdict.YES, text, "", numbers)
    change = "fp.suggest(problem, controller, chatter=...) gives the gain and the filter for a smaller one."
    if not deformation.adapts:
        change = "Lower the rate, weigh the change of the inputs, or estimate more slowly."
    elif problem.response_delay > 0:
        change = "Lower the gain, filter its error (Filtered), or estimate more slowly."
    return Answer(CHATTER, Verdict.CAUTION, text, change, numbers)


def _noisy_loops(case: Case) -> list[tuple[LinearLoop, np.ndarray]] | None:
    """Linear loops behind the sensors' noise, each with the covariance of what drives it; None where one does not converge."""
    noises = [one.noise for one in case.problem.sensing.sensors.values() if one.noise is not None]
    if not noises or not case.loops.loops or case.loops.radii.max() >= 1 or case.loops.learns:
        return None
    times, random = case.problem.period * np.arange(_DRAWN), np.random.default_rng(0)
    series = np.array([one.values(times, random) for one in noises])
    points, variances = points_of(case.grid, case.controller), series.var(axis=1)
    correlation = np.mean(series[:, 1:] * series[:, :-1], axis=1) / np.maximum(variances, 1e-300)
    correlation = np.where(np.abs(correlation) < _WHITE, 0.0, correlation)
    loops = [points.noisy(k, correlation) for k in thinned(case.loops.places, _POINTS)]
    if any(np.abs(one.poles).max(initial=0.0) >= 1 for one in loops):
        return None
    return [(one, np.diag(variances * (1 - correlation**2))) for one in loops]


NOISE_PAIR = "Are gain and filter those that the sensors' noise asks for?"
_ENOUGH = 0.5  # share of the suggested gain that is as good


def suits_noise(case: Case) -> Answer | None:
    """Return gain and pole for the problem's sensors beside those in use; None without noise or for a map that changes on line."""
    deformation = case.controller.deformation
    noisy = any(sensor.noise is not None for sensor in case.problem.sensing.sensors.values())
    if not noisy or not deformation.iteration.constant or case.problem.response_delay > 0:
        return None
    try:
        steps = chatter_of(case.grid, case.controller, deformation.effective_gain(), deformation.iteration.error_pole)
        limited = _budget(case)
        budget = limited or steps
        pair = _within_budget(case.problem, case.controller, budget)
    except FpirhcError as error:
        if isinstance(error, _OverBudget) and not limited:
            return Answer(
                NOISE_PAIR, Verdict.YES, "no filter with a larger gain has as little chatter as the pair in use"
            )
        return Answer(NOISE_PAIR, Verdict.UNKNOWN, str(error))
    pole = deformation.iteration.error_pole
    gain, share = abs(deformation.effective_gain()), abs(deformation.effective_gain() / pair.effective_gain)
    numbers = {"gain": gain, "pole": pole, "recommended": abs(pair.effective_gain), "recommended_pole": pair.pole}
    allowed = ", ".join(f"{name} {value:.3g}" for name, value in budget.items())
    text = (
        f"effective gain {gain:.3g} and pole {pole:.3g}; with steps per cycle of {allowed} from noise the pair "
        f"is {abs(pair.effective_gain):.3g} and {pair.pole:.3g}"
    )
    if share >= _ENOUGH and all(steps[name] <= 1.01 * value for name, value in budget.items()):
        return Answer(NOISE_PAIR, Verdict.YES, text, "", numbers)
    against = case.harm(pair.deformation)
    if against:
        change = "Less noise at the response is needed: a better sensor, an estimator, or a longer period."
        return Answer(NOISE_PAIR, Verdict.CAUTION, f"{text}, but {against}", change, numbers)
    change = f"Use {pair.gain_name} = {pair.gain:.3g}" + (
        f" in Filtered(map, pole={pair.pole:.3g})." if pair.pole else " without a filter."
    )
    return Answer(NOISE_PAIR, Verdict.CAUTION, text, change, numbers)


def _budget(case: Case) -> dict[str, float]:
    """1 % of the range of every input with limits."""
    lower, upper = case.problem.limits.input_bounds(case.problem.plant)
    sizes = SMALL * (np.asarray(upper) - np.asarray(lower))
    return {name: float(s) for name, s in zip(case.problem.plant.inputs, sizes, strict=True) if math.isfinite(s)}


QUESTIONS = (
    ControllerQuestion(chatter_small, CHATTER, order=12, adaptive=False),
    ControllerQuestion(suits_noise, NOISE_PAIR, order=70),
)
