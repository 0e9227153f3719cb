"""Margins that keep a plant inside its limits of states although the model of the plans is wrong.

A plan starts from the measured state. What the model does not predict over one control cycle moves the state by

    d_k = advance(x_k, u_k; exact) - advance(x_k, u^_k; believed)

along the nominal run, where u_k is the command with the deformation and u^_k the model's own. From then on the closed loop of
plant = model without deformation carries this deviation on: H_l is its response after l cycles to a deviation of the state. So i
stages after a plan was made the plant is away from it by at most

    m_i = sum over l < i n of |H_l| d,        d = the largest |d_k| of the run,        n = cycles per stage,

entry by entry, to first order. The run's first moments, up to `measure_from`, do not count: adaptation has not found the plant yet.
A plan that keeps m_i from its limits after stage i leaves room for this, and also for the plans that follow it. These are the
restricted constraints of robust MPC (L. Chisci, J. A. Rossiter, G. Zappa, Automatica 37(7), 2001), with the feedback of the loop
itself and the deviations that adaptation leaves.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import resolved
from fpirhc.errors import InvalidProblem, InvalidValue, NotSupported
from fpirhc.review.grid import each, review_grid
from fpirhc.review.linear import LinearLoop
from fpirhc.review.loops import ideal_loops
from fpirhc.review.prediction import NominalRun, nominal_run, response_errors
from fpirhc.task.problem import Problem, cycles_per_stage

_POINTS = 5  # of the reference, whose loops are compared
_DRAWS = 8  # of the parameters


def tightened(
    problem: Problem, controller: Controller, *, mismatch: float | None = None, widen: float = 1.1, seed: int = 0
) -> Controller:
    """Return the controller whose plans keep a margin from the limits of states, from one run of the model.

    Args:
        problem: with hard limits of states. The margins are computed for it, and it stays as it is.
        controller: that plans over the problem's horizon.
        mismatch: margin of the parameters' box around the exact ones, percent; the margins are the largest over draws from the box.
            None: the exact parameters alone.
        widen: factor on the margins, which are computed to first order.
        seed: of the draws.

    Raises:
        InvalidProblem: no limits of states, or margins that leave nothing between two limits (all are named).
        InvalidValue: a factor that is not positive.
        NotSupported: see `nominal_run`; a controller that does not plan, or whose loop does not converge even with the right model.
    """
    margins = state_margins(problem, controller, mismatch=mismatch, widen=widen, seed=seed)
    planned = controller.with_margins(margins)
    planned.check(problem)
    return planned


def state_margins(
    problem: Problem, controller: Controller, *, mismatch: float | None = None, widen: float = 1.1, seed: int = 0
) -> Mapping[str, tuple[float, ...]]:
    """Return the margins of `tightened` by name of the limited state, one number for every stage; arguments as there."""
    if not 0 < widen < np.inf:
        raise InvalidValue(f"tightened(widen={widen!r}): expected a positive number")
    ready = resolved(problem, controller)
    hard = [e for e in problem.limits.states if e not in problem.limits.soft and e not in problem.limits.prices]
    if ready.planner is None or problem.horizon is None:
        raise NotSupported(f"{type(controller).__name__} does not plan over a horizon, so no plan can keep a margin")
    if not hard:
        raise InvalidProblem("no margins: the problem has no hard limits of states; name them in Limits(states=...)")
    nominal = nominal_run(problem, controller)
    deviation = np.max([_deviation(nominal, p) for p in _parameters(problem, mismatch, seed)], axis=0)
    cycles, stages = cycles_per_stage(problem.horizon, problem.period), problem.horizon.stages
    loops = ideal_loops(review_grid(problem, 0.0, 0), nominal.controller, _POINTS)
    reached = np.max([_reached(loop, cycles * stages, deviation) for loop, _ in loops], axis=0)
    rows = widen * reached[cycles - 1 :: cycles]
    places = {e: k for k, e in enumerate(problem.plant.state.elements)}
    return {e: tuple(map(float, rows[:, places[e]])) for e in hard}


def _parameters(problem: Problem, mismatch: float | None, seed: int) -> np.ndarray:
    """Exact parameters of the plants that the margins are for."""
    draws = review_grid(problem, mismatch or 0.0, seed).draws
    return draws[:1] if mismatch is None else draws[: 1 + _DRAWS]


def _deviation(nominal: NominalRun, exact: np.ndarray) -> np.ndarray:
    """Largest |d_k| of the run by state, shape (nx,)."""
    problem, plant = nominal.problem, nominal.problem.plant
    advance = problem.integrator.step(plant, problem.period)
    errors = response_errors(nominal, exact=exact)
    believed, rows = (np.tile(p, (nominal.cycles, 1)) for p in (nominal.believed, exact))
    still = np.zeros((nominal.cycles, len(plant.names)))
    own = each(plant.inverse_function, nominal.states[:-1], nominal.desired, believed)
    moved = each(advance, nominal.states[:-1], errors.command, rows, still)
    predicted = each(advance, nominal.states[:-1], own, believed, still)
    sizes = np.abs(moved - predicted)
    if not np.isfinite(sizes).all():
        raise NotSupported("no margins: the predicted deviations do not stay finite")
    return sizes[min(round(problem.measure_from / problem.period), nominal.cycles - 1) :].max(axis=0)


def _reached(loop: LinearLoop, cycles: int, deviation: np.ndarray) -> np.ndarray:
    """Sum over the first cycles of |H_l| d, shape (cycles, nx)."""
    if loop.radius >= 1:
        raise NotSupported("no margins: the loop does not converge even with the right model")
    memory = np.zeros((len(loop.dynamics), len(loop.state)))
    memory[loop.state, np.arange(len(loop.state))] = 1.0
    sums, total = [], np.zeros(len(loop.state))
    for _ in range(cycles):
        total = total + np.abs(memory[loop.state]) @ deviation
        sums.append(total)
        memory = loop.dynamics @ memory
    return np.array(sums)
