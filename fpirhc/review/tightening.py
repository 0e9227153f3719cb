"""Margins that keep a plant inside its limits of states although the model of the plans is wrong.

Theory: docs/theory-questions.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import refuse_without, resolved, with_margins
from fpirhc.errors import InvalidProblem, InvalidValue, NoAnswer
from fpirhc.fields.checked import checked_call
from fpirhc.fields.kinds import Seed
from fpirhc.review.grid import each, review_grid
from fpirhc.review.loops import ideal_loops
from fpirhc.review.prediction import NominalRun, exactly, nominal_run, response_errors
from fpirhc.simulation.linearise.linear_loop import LinearLoop
from fpirhc.simulation.simulate import simulate
from fpirhc.task.problem import Problem, cycles_per_stage

_POINTS = 5  # of the reference, whose loops are compared
_DRAWS = 8  # of the parameters
_KEPT = 1e-8  # of the range: what a limit may be passed by

Margins = Mapping[str, tuple[float, ...]]


@checked_call
def tightened(
    problem: Problem,
    controller: Controller,
    *,
    mismatch: float | None = None,
    widen: float = 1.1,
    passes: int = 12,
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
    widen: float = 1.1,
    passes: int = 12,
    seed: Seed = 0,
) -> Margins:
    """Return the margins of `tightened` by name of the limited state, one number for every stage; arguments as there."""
    if not 0 < widen < np.inf:
        raise InvalidValue(f"tightened(widen={widen!r}): expected a positive number")
    if passes < 0:
        raise InvalidValue(f"tightened(passes={passes!r}): expected 0 or a positive number of runs")
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
    return draws[:1] if mismatch is None else draws[: 1 + _DRAWS]


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
