"""A prediction before a run: whether adaptation pays, how it disturbs a right model, and how far the plant is from the plan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fpirhc.by_name import ByName
from fpirhc.contraction.spectrum import response_jacobians
from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import refuse_without, resolved
from fpirhc.errors import NoAnswer, NotSupported
from fpirhc.fields.checked import checked_call
from fpirhc.fields.kinds import Seed
from fpirhc.plant.mismatch import check_mismatch
from fpirhc.review.grid import ReviewGrid, review_grid
from fpirhc.review.loops import ideal_loops, ideal_places, own_loops
from fpirhc.review.prediction import NominalRun, ResponseErrors, errors_without_adaptation, nominal_run, response_errors
from fpirhc.review.state_slopes import state_slopes
from fpirhc.simulation.linearise.linear_loop import LinearLoop
from fpirhc.summary import line, number, table
from fpirhc.task.problem import Problem

_DRAWS = 16  # of the parameters' box


@dataclass(frozen=True, eq=False)
class Prediction:
    """The predicted effect of adaptation along the nominal run.

    Args:
        nominal: the model's own run.
        adapted: response errors with the deformation.
        without: response errors without a deformation.
        null: response errors with the deformation on a right model, where every change does harm.
        tube: bound of |plant's state - nominal state| with the deformation, to first order, shape (cycles + 1, nx);
            with a mismatch the largest over the box of parameters. None where there is no bound.
        reason: why there is no tube; else empty.
    """

    nominal: NominalRun
    adapted: ResponseErrors
    without: ResponseErrors
    null: ResponseErrors
    tube: np.ndarray | None
    reason: str

    @property
    def helps(self) -> bool:
        """Whether the response error is smaller with the deformation than without, in the sum of squares of all coordinates."""
        with np.errstate(over="ignore", invalid="ignore"):
            return bool(np.sum(self._judged(self.adapted) ** 2) < np.sum(self._judged(self.without) ** 2))

    def rms(self, errors: ResponseErrors) -> dict[str, float]:
        """Rms response error by controlled coordinate, from the problem's `measure_from` on, in units of the response."""
        names = self.nominal.problem.plant.controlled_names
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.mean(self._judged(errors) ** 2, axis=0)
        return ByName(zip(names, map(float, np.sqrt(squares)), strict=True), "Prediction.rms(...)")

    @property
    def half_width(self) -> Mapping[str, float]:
        """Largest half-width of the tube by state, from `measure_from` on; empty without a tube."""
        if self.tube is None:
            return ByName({}, "Prediction.half_width")
        widest = self.tube[self._first :].max(axis=0)
        names = self.nominal.problem.plant.state.elements
        return ByName(zip(names, map(float, widest), strict=True), "Prediction.half_width")

    @property
    def _first(self) -> int:
        problem = self.nominal.problem
        return min(round(problem.measure_from / problem.period), self.nominal.cycles - 1)

    def _judged(self, errors: ResponseErrors) -> np.ndarray:
        return errors.error[self._first :]

    def __repr__(self) -> str:
        return line(self, "helps" if self.helps else "does not help", *(f"{n} {v}" for n, v in self._facts()))

    def _repr_html_(self) -> str:
        """Errors and tube as a table, for notebooks."""
        notes = [self.reason] if self.reason else []
        return table("Predicted response", ("", "value"), self._facts(), notes)

    def _facts(self) -> list[tuple[str, str]]:
        kinds = {"without": self.without, "with": self.adapted, "with a right model": self.null}
        errors = [(f"rms of {c} {k}", number(v)) for k, e in kinds.items() for c, v in self.rms(e).items()]
        return [*errors, *((f"tube of {s}", number(v)) for s, v in self.half_width.items())]


@checked_call
def predict_response(
    problem: Problem, controller: Controller, *, mismatch: float | None = None, seed: Seed = 0, compiled: bool = True
) -> Prediction:
    """Return the predicted effect of the controller's deformation, from one run of the model and no run of the plant.

    A prediction whose errors do not stay finite is returned with these errors.

    Args:
        problem: the problem.
        controller: the controller with its deformation.
        mismatch: margin of the parameters' box around the exact ones, percent; the tube is the largest over draws from
            the box. None: the exact parameters alone.
        seed: of the draws.
        compiled: whether the model runs in C when there is a compiler.

    Raises:
        NotSupported: see `nominal_run`; a controller without adaptation.
        InvalidValue: a mismatch outside [0, 100).
        FpirhcError: every error that the controller raises about the problem.
    """
    if mismatch is not None:
        check_mismatch(problem.plant, mismatch)
    if resolved(problem, controller).deformation.effective_gain() == 0:
        refuse_without(controller, "deformation whose effect could be predicted")
    nominal = nominal_run(problem, controller, compiled=compiled)
    adapted = response_errors(nominal)
    widest, reason = _widest(nominal, adapted, mismatch, seed)
    null = response_errors(nominal, exact=nominal.believed)
    return Prediction(nominal, adapted, errors_without_adaptation(nominal), null, widest, reason)


def _widest(
    nominal: NominalRun, adapted: ResponseErrors, mismatch: float | None, seed: int
) -> tuple[np.ndarray | None, str]:
    gain = nominal.controller.deformation.effective_gain()
    if not np.isfinite(adapted.error).all():
        return None, "no tube: the predicted response errors do not stay finite"
    loops = own_loops(review_grid(nominal.problem, 0.0, 0), nominal.controller)
    if loops.loops and loops.radii.max() >= 1:
        return None, f"no tube: the loop with its deformation does not converge, {loops.radii.max():.6g} per cycle"
    try:
        widest = tube(nominal, adapted, gain)
        for exact in _drawn(nominal.problem, mismatch, seed):
            widest = np.maximum(widest, tube(nominal, response_errors(nominal, exact=exact), gain, exact))
    except NotSupported as error:
        return None, str(error)
    return widest, ""


def _drawn(problem: Problem, mismatch: float | None, seed: int) -> np.ndarray:
    """Some draws of the exact parameters from their box, none without a mismatch."""
    if mismatch is None:
        return np.zeros((0, problem.plant.parameter.size))
    draws = review_grid(problem, mismatch, seed).draws[1:]
    count = min(len(draws), _DRAWS)
    return draws[np.unique(np.linspace(0, len(draws) - 1, count).astype(int))] if count else draws


_POINTS = 5  # of the reference, whose impulse responses are compared
_GONE = 1e-6  # share of its largest value below which an impulse response is over
_ROUNDING = 1e-15  # entry of a product of I - a J, which adds nothing any more
_LOST = 1e6  # entry of a product of I - a J, from which errors grow


def tube(nominal: NominalRun, errors: ResponseErrors, gain: float, exact: np.ndarray | None = None) -> np.ndarray:
    """Return the bound of |x_k - x^_k| (cycles + 1, nx) that the response errors allow, with x^_k the states of the nominal run.

    Args:
        nominal: the nominal run.
        errors: the response errors that the deformation leaves.
        gain: effective gain of the deformation.
        exact: exact parameters, shape (np,); None: the plant's.

    Raises:
        NotSupported: coordinates that are not controlled, no linear loop, one that does not converge even with the
            right model.
    """
    plant = nominal.problem.plant
    if plant.outputs:
        raise NotSupported("no tube: the nominal run of outputs is that of the plant, and a tube is around the model's")
    if len(plant.controlled_names) < len(plant.names):
        raise NotSupported("no tube: a coordinate that is not controlled moves by itself")
    force = majorant(nominal, errors, gain, exact) + np.abs(errors.force - errors.error)
    grid = review_grid(nominal.problem, 0.0, 0)
    loops = ideal_loops(grid, nominal.controller, _POINTS)
    effects = [_effect(grid, nominal, k) for k in ideal_places(grid, nominal.believed, _POINTS)]
    answers = [_impulses(*one, nominal.cycles) for one in zip(loops, effects, strict=True)]
    longest = max(len(a) for a in answers)
    largest = np.max([np.pad(a, ((0, longest - len(a)), (0, 0), (0, 0))) for a in answers], axis=0)
    bound = np.zeros((nominal.cycles + 1, largest.shape[1]))
    summed = _convolved(largest, force[:, None, :]).sum(axis=2)
    bound[1:] = np.maximum(summed[: nominal.cycles], 0.0)
    return bound


def majorant(nominal: NominalRun, errors: ResponseErrors, gain: float, exact: np.ndarray | None = None) -> np.ndarray:
    """Return e+ (cycles, n); the size of the errors where products of I - a J do not decay; arguments as in `tube`."""
    plant = nominal.problem.plant
    rows = np.tile(plant.exact if exact is None else exact, (nominal.cycles, 1))
    jacobians = response_jacobians(plant, nominal.states[:-1], nominal.desired, rows, nominal.believed)
    jacobians = nominal.controller.deformation.iteration.weighted(jacobians)
    factors, size = np.eye(jacobians.shape[1]) - gain * jacobians, np.abs(errors.error)
    if gain == 0 or not np.isfinite(factors).all():
        return size
    parts = size.copy()
    parts[1:] = np.abs(errors.error[1:] - np.einsum("kij,kj->ki", factors[1:], errors.error[:-1]))
    bound, carried = parts.copy(), factors.copy()
    for late in range(1, nominal.cycles):  # cycles after which a part is still felt
        bound[late:] += np.einsum("kij,kj->ki", np.abs(carried[late:]), parts[:-late])
        largest = np.abs(carried[late:]).max()
        if largest < _ROUNDING:
            return bound
        if largest > _LOST:
            break
        carried[late + 1 :] = carried[late + 1 :] @ factors[1:-late]
    return size


def _effect(grid: ReviewGrid, nominal: NominalRun, place: int) -> np.ndarray:
    """The model's gain (n, nu) from inputs to responses at a point."""
    at = grid.states[place], grid.needed(nominal.believed)[place], nominal.believed
    return state_slopes(grid.problem.plant, *at).d


def _impulses(loop: LinearLoop, gain: np.ndarray, cycles: int) -> np.ndarray:
    """|h_j| (j, nx, n): the motion of the states after a unit of the responses over one cycle."""
    if loop.radius >= 1:
        raise NoAnswer("no tube: the loop does not converge even with the right model")
    sizes = np.abs(loop.impulses(np.linalg.inv(gain), cycles)).max(
        axis=0
    )  # of all cycles of a period in which the unit may come
    lasting = sizes.max(axis=(1, 2)) >= _GONE * sizes.max()
    return np.asarray(sizes[: int(np.flatnonzero(lasting).max(initial=0)) + len(loop.cycles)])


def _convolved(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Convolution along the first axis, by numpy alone: the import of scipy.fft or scipy.signal takes longer than all of this."""
    length = len(one) + len(other) - 1
    padded = 1 << (length - 1).bit_length()
    one, other = (np.fft.rfft(signal, padded, axis=0) for signal in (one, other))
    convolved: np.ndarray = np.fft.irfft(one * other, padded, axis=0)
    return convolved[:length]
