"""The problem's stage cost along a run, by term: the same cost judges all controllers of a problem, whatever their models."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import casadi as ca
import numpy as np

from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.simulation.metrics.base import Metric, by_name, measured_cycles
from fpirhc.simulation.run import Run
from fpirhc.simulation.tables import LOGGED
from fpirhc.symbolic.evaluate import Evaluator, Latest
from fpirhc.task.exogenous import real_values
from fpirhc.task.problem import Problem

_CHUNK = 500  # cycles whose costs are evaluated in one call
# Every controller of a comparison is judged by the same cost.
_COSTS: Latest[tuple[OptimalControl, Evaluator]] = Latest(2)


def cost(problem: Problem, run: Run) -> dict[str, float]:
    """Return the sum of the stage cost by term, and 'total', from `measure_from` on.

    It is empty for a run that ended early, and where the reality lacks states of the model: their cost is nobody's.
    """
    whole = "plant_state" in run.layout and run.layout["plant_state"].elements == problem.plant.state.elements
    if problem.cost is None or problem.horizon is None or run.stop is not None or not whole:
        return {}
    terms, costs = _costs(problem, run)
    sums = by_name(terms, costs[measured_cycles(problem, run)].sum(axis=0))
    return {**sums, "total": sum(sums.values())}


def _costs(problem: Problem, run: Run) -> tuple[tuple[str, ...], np.ndarray]:
    """The terms, and what every cycle costs by term, at the actual state and command, with the exact parameters.

    With a reality it is the model's cost at the states that really were, with the exact values of the model's own parameters.
    Effort relative to a feedforward is relative to the feedforward of the plant.
    """
    shifted, own = LOGGED in run.layout.names, bool(problem.own_signals)
    ocp, evaluator = _COSTS.of((problem,), (shifted,), lambda: _cost_evaluator(problem, shifted=shifted))
    states, commands = run["plant_state"], run["command"]
    before = np.vstack([commands[:1], commands[:-1]])
    # Along the reference that the run had, where it is no function of the time alone.
    motion = [run[name] for name in ("reference", "reference_response")] if own else []
    # A disturbed output is h + d; its error is that of h to the reference less d.
    shift = [run[LOGGED]] if shifted else []
    sources = run["time"], *motion, *shift, states, commands, before
    costs = np.empty((run.cycles, len(ocp.terms)))
    evaluator.arguments[-1][:] = problem.plant.exact
    for at in range(0, run.cycles, _CHUNK):
        size = min(_CHUNK, run.cycles - at)
        for argument, source in zip(evaluator.arguments, sources, strict=False):
            argument.reshape(_CHUNK, -1)[:size] = source[at : at + size]
        evaluator.evaluate()
        costs[at : at + size] = evaluator.results[0].reshape(_CHUNK, -1)[:size]
    return tuple(ocp.terms), costs


def _cost_evaluator(problem: Problem, *, shifted: bool) -> tuple[OptimalControl, Evaluator]:
    """A horizon of one cycle, and its cost terms of many cycles."""
    assert problem.horizon is not None
    assert problem.cost is not None
    plant, own = problem.plant, bool(problem.own_signals)
    one_cycle = replace(problem.horizon, stages=1, step=problem.period, blocks=(), margins={}, lengths=())
    ocp = transcribe(plant, problem.reference, one_cycle, problem.cost, problem.limits, start=problem.start_state)
    outside = real_values(plant, problem.signals)
    data_of = stage_data(plant, problem.reference, one_cycle, problem.cost, signals=outside, previewed=own)
    return ocp, Evaluator(_cost_function(ocp, data_of, _CHUNK, shifted=shifted))


def _cost_function(ocp: OptimalControl, data_of: ca.Function, count: int, *, shifted: bool) -> ca.Function:
    """Function (times, [states and responses of the reference], [shift], states, inputs, inputs before, parameters) -> cost terms.

    They are those of `count` cycles. The shift is subtracted from the reference.
    """
    t, x, before = ca.MX.sym("t"), *(ca.MX.sym(ocp.start.name_in(k), ocp.start.size1_in(k)) for k in (0, 1))
    u, p = ca.MX.sym("u", ocp.input.size), ca.MX.sym("p", data_of.size1_in(data_of.n_in() - 1))
    motion = [ca.MX.sym(data_of.name_in(k), data_of.size1_in(k)) for k in range(1, data_of.n_in() - 1)]
    data = data_of(t, *(ca.repmat(m, 1, 2) for m in motion), p)[:, 0]
    if shifted:
        place = ocp.data.slice("reference")
        shift = ca.MX.sym("shift", place.stop - place.start)
        data = ca.vertcat(data[: place.start], data[place] - shift, data[place.stop :])
        motion = [*motion, shift]
    terms = ocp.stage_cost(ocp.start(x, before), u, data)[1]
    one = ca.Function("fpirhc_cost", [t, *motion, x, u, before, p], [terms])
    with contextlib.suppress(RuntimeError):  # a table to look up, or a solver, is no scalar code
        one = one.expand()
    tables = [ca.MX.sym(one.name_in(k), one.size1_in(k), count) for k in range(one.n_in() - 1)]
    costs = one.map(count)(*tables, ca.repmat(p, 1, count))
    return ca.Function("fpirhc_costs", [*tables, p], [costs])


METRICS = (Metric("cost", cost, by="term", shown=("total",), order=70, always=False),)
