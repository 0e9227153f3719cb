"""A prediction before a run: whether adaptation pays, how it disturbs a right model, and how far the plant is from the plan.

From it follow margins that keep a plant inside its limits of states although the model of the plans is wrong: docs/theory-
questions.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fpirhc.contraction.spectrum import response_jacobians
from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import refuse_without, resolved, with_margins
from fpirhc.errors import InvalidProblem, NoAnswer, NotSupported
from fpirhc.fields.checked import ByName, checked_call
from fpirhc.fields.kinds import CountOrZero, Positive, Seed
from fpirhc.plant.plant import Plant, check_mismatch
from fpirhc.review.grid import ReviewGrid, each, review_grid, state_slopes
from fpirhc.review.loops import ideal_loops, ideal_places, own_loops
from fpirhc.review.prediction import (
    NominalRun,
    ResponseErrors,
    errors_without_adaptation,
    nominal_run,
    null_errors,
    response_errors,
)
from fpirhc.simulation.linearise.linear_loop import LinearLoop
from fpirhc.simulation.model_as_plant import exactly
from fpirhc.simulation.simulate import simulate
from fpirhc.summary import line, number, table
from fpirhc.task.problem import Problem, cycles_per_stage

_DRAWS = 16  # of the parameters' box


@dataclass(frozen=True, eq=False)
class Prediction:
    """The predicted effect of adaptation along the nominal run.

    Args:
        nominal: the model's own run.
        adapted: response errors with the deformation.
        without: response errors without a deformation.
        null: response errors with the deformation on a right model, where every change does harm.
        tube: bound of |plant's outputs - nominal outputs| and their derivatives with the deformation, to first order, shape
            (cycles + 1, ny), without outputs of the states; with a mismatch the largest over the box of parameters. None where
            there is no bound.
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
        """Largest half-width of the tube by state or output, from `measure_from` on; empty without a tube."""
        if self.tube is None:
            return ByName({}, "Prediction.half_width")
        widest = self.tube[self._first :].max(axis=0)
        names = self.nominal.problem.plant.output.elements
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
    null = null_errors(nominal)
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
    """Return the bound of |y_k - y^_k| (cycles + 1, ny) that the response errors allow, with y^_k the outputs of the nominal run.

    `exact`: exact parameters, shape (np,); None: the plant's.

    Args:
        nominal: the nominal run.
        errors: the response errors that the deformation leaves.
        gain: effective gain of the deformation.
        exact: exact parameters, shape (np,); None: the plant's.

    Raises:
        NotSupported: coordinates or outputs that are not controlled, no linear loop, one that does not converge even with the
            right model.
    """
    plant = nominal.plant
    free = [n for n in plant.chains if not plant.response_orders.get(n)]
    if free:
        raise NotSupported(
            f"no tube: {', '.join(free)} is not controlled through a derivative, and moves by itself or at once"
        )
    force = majorant(nominal, errors, gain, exact) + np.abs(errors.force - errors.error)
    grid = review_grid(nominal.right, 0.0, 0)
    loops = ideal_loops(grid, nominal.controller, _POINTS)
    effects = [_effect(grid, plant, k) for k in ideal_places(grid, plant.exact, _POINTS)]
    answers = [_impulses(loop, *one, nominal.cycles) for loop, one in zip(loops, effects, strict=True)]
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


def _effect(grid: ReviewGrid, plant: Plant, place: int) -> tuple[np.ndarray, np.ndarray]:
    """The gain (n, nu) from inputs to responses at a point, and the slopes (ny, nx) of the outputs and their derivatives."""
    slopes = state_slopes(plant, grid.states[place], grid.needed(plant.exact)[place], plant.exact)
    return slopes.d, slopes.y


def _impulses(loop: LinearLoop, gain: np.ndarray, shown: np.ndarray, cycles: int) -> np.ndarray:
    """|h_j| (j, ny, n): the motion of the outputs after a unit of the responses over one cycle."""
    if loop.radius >= 1:
        raise NoAnswer("no tube: the loop does not converge even with the right model")
    # The largest of all cycles of a period in which the unit may come.
    sizes = np.abs(shown @ loop.impulses(np.linalg.inv(gain), cycles)).max(axis=0)
    lasting = sizes.max(axis=(1, 2)) >= _GONE * sizes.max()
    return np.asarray(sizes[: int(np.flatnonzero(lasting).max(initial=0)) + len(loop.cycles)])


def _convolved(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Convolution along the first axis, by numpy alone: the import of scipy.fft or scipy.signal takes longer than all of this."""
    length = len(one) + len(other) - 1
    padded = 1 << (length - 1).bit_length()
    one, other = (np.fft.rfft(signal, padded, axis=0) for signal in (one, other))
    convolved: np.ndarray = np.fft.irfft(one * other, padded, axis=0)
    return convolved[:length]


_PLANTS = 8  # draws of the parameters, for which margins are
_KEPT = 1e-8  # of the range: what a limit may be passed by

Margins = Mapping[str, tuple[float, ...]]


@checked_call
def tightened(
    problem: Problem,
    controller: Controller,
    *,
    mismatch: float | None = None,
    widen: Positive = 1.1,
    passes: CountOrZero = 12,
    seed: Seed = 0,
) -> Controller:
    """Return the controller whose plans keep a margin from the limits of states, and with which the plants keep the limits.

    The plants are those that are run; `certify_limits` speaks for every plant of a box of parameters.

    Args:
        problem: with hard limits of states. The margins are computed for it, and it stays as it is.
        controller: that plans over the problem's horizon.
        mismatch: margin of the parameters' box around the exact ones, percent; the margins are the largest over draws from the box.
            None: the exact parameters alone.
        widen: factor on the margins, which are computed to first order.
        passes: most runs of each plant that verify the margins; 0: predicted margins, from one run of the model.
        seed: of the draws and of the runs.

    Raises:
        InvalidProblem: no limits of states, or margins that leave nothing between two limits (all are named).
        InvalidValue: a factor that is not positive, a negative number of passes.
        NotSupported: see `nominal_run`; a controller that does not plan, or whose loop does not converge even with the right model;
            a limit that is still passed in the last run.
    """
    margins = state_margins(problem, controller, mismatch=mismatch, widen=widen, passes=passes, seed=seed)
    planned = with_margins(controller, margins)
    planned.check(problem)
    return planned


@checked_call
def state_margins(
    problem: Problem,
    controller: Controller,
    *,
    mismatch: float | None = None,
    widen: Positive = 1.1,
    passes: CountOrZero = 12,
    seed: Seed = 0,
) -> Margins:
    """Return the margins of `tightened` by name of the limited state, one number for every stage; arguments as there."""
    plants = _parameters(problem, mismatch, seed)
    margins = _predicted(problem, controller, plants, widen)
    for k in range(passes):
        beyond = np.max([_beyond(problem, with_margins(controller, margins), p, seed) for p in plants], axis=0)
        passed = {
            e: float(v) for e, v in zip(problem.plant.state.elements, beyond, strict=True) if v > 0 and e in margins
        }
        if not passed:
            break
        if k + 1 == passes:
            amounts = ", ".join(f"'{e}' by {v:.2g}" for e, v in passed.items())
            raise NoAnswer(
                f"no margins: after {passes} runs the plant still passes its limits ({amounts}); with tightened(passes=0) the "
                "plans keep the predicted margins, and no run verifies them"
            )
        margins = {e: tuple(v + max(widen, 1.0) * passed.get(e, 0.0) for v in m) for e, m in margins.items()}
    return margins


def _predicted(problem: Problem, controller: Controller, plants: np.ndarray, widen: float) -> Margins:
    """The margins that follow from one run of the model, times `widen`."""
    ready = resolved(problem, controller)
    hard = [e for e in problem.limits.states if e not in problem.limits.soft and e not in problem.limits.prices]
    if ready.planner is None or problem.horizon is None:
        refuse_without(controller, "plan that could keep margins")
    if not hard:
        raise InvalidProblem("no margins: the problem has no hard limits of states; name them in Limits(states=...)")
    nominal = nominal_run(problem, controller)
    cycles, stages = cycles_per_stage(problem.horizon, problem.period), problem.horizon.stages
    loops = ideal_loops(review_grid(problem, 0.0, 0), nominal.controller, _POINTS)
    deviations = [_deviations(nominal, p) for p in plants]
    reached = np.max([_reached(loop, cycles * stages, d) for loop in loops for d in deviations], axis=0)
    rows = widen * reached[cycles - 1 :: cycles]
    places = {e: k for k, e in enumerate(problem.plant.state.elements)}
    return {e: tuple(map(float, rows[:, places[e]])) for e in hard}


def _beyond(problem: Problem, controller: Controller, exact: np.ndarray, seed: int) -> np.ndarray:
    """By how much a run of this plant passes each limit of a state after `measure_from`, shape (nx,); 0 where it keeps it."""
    controller.check(problem)
    run = simulate(replace(problem, plant=exactly(problem.plant, exact)), controller, seed=seed)
    if run.stop is not None:
        raise NoAnswer(f"no margins: the run that verifies them ended early: {run.stop}")
    lower, upper = problem.limits.state_bounds(problem.plant)
    states = run["state"][min(round(problem.measure_from / problem.period), run.cycles - 1) :]
    beyond = np.maximum(states - upper, lower - states).max(axis=0)
    range_ = np.where(np.isfinite(upper - lower), upper - lower, 1.0)
    return np.where(beyond > _KEPT * range_, beyond, 0.0)


def _parameters(problem: Problem, mismatch: float | None, seed: int) -> np.ndarray:
    """Exact parameters of the plants that the margins are for."""
    draws = review_grid(problem, mismatch or 0.0, seed).draws
    return draws[:1] if mismatch is None else draws[: 1 + _PLANTS]


def _deviations(nominal: NominalRun, exact: np.ndarray) -> np.ndarray:
    """d_k of the run after `measure_from`, shape (cycles, nx)."""
    problem, plant = nominal.problem, nominal.problem.plant
    advance = problem.integrator.step(plant, problem.period)
    errors = response_errors(nominal, exact=exact)
    believed, rows = (np.tile(p, (nominal.cycles, 1)) for p in (nominal.believed, exact))
    still = np.zeros((nominal.cycles, len(plant.names)))
    own = each(plant.equations.inverse, nominal.states[:-1], nominal.desired, believed)
    states_next = each(advance, nominal.states[:-1], errors.command, rows, still)
    deviations = states_next - each(advance, nominal.states[:-1], own, believed, still)
    if not np.isfinite(deviations).all():
        raise NoAnswer("no margins: the predicted deviations do not stay finite")
    return np.asarray(deviations[min(round(problem.measure_from / problem.period), nominal.cycles - 1) :])


def _reached(loop: LinearLoop, cycles: int, deviations: np.ndarray) -> np.ndarray:
    """Largest over k of the sum of |H_l d_(k-l)| over l < 1 ... cycles: shape (cycles, nx)."""
    if loop.radius >= 1:
        raise NoAnswer("no margins: the loop does not converge even with the right model")
    after = loop.carried(loop.placed, cycles)[0]
    sums, total = [], np.zeros_like(deviations)
    for late, matrix in enumerate(after):
        if late < len(deviations):
            total[late:] += np.abs(deviations[: len(deviations) - late] @ matrix.T)
        sums.append(total.max(axis=0))
    return np.array(sums)
