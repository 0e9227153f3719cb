"""The signals that judge a run, computed from its log: the cost, the same for all controllers, and the contraction factor."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import casadi as ca
import numpy as np

from fpirhc.contraction.spectrum import factors_along, identified_factor, jacobians_along
from fpirhc.controllers.base import Controller
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.simulation.path import REALITY_STATE
from fpirhc.simulation.run import Run
from fpirhc.simulation.tables import LOGGED
from fpirhc.symbolic.evaluate import Evaluator, Latest, attempted
from fpirhc.symbolic.layout import Layout, Signal, scalar
from fpirhc.task.exogenous import model_values, real_values, rows_of
from fpirhc.task.problem import Problem

JUDGING = ("cost", "contraction")  # signals that are computed from the log of a run
_CHUNK = 500  # cycles whose costs are evaluated in one call
Judgement = tuple[Signal, np.ndarray]
# Every controller of a comparison is judged by the same cost.
_COSTS: Latest[tuple[OptimalControl, Evaluator]] = Latest(2)


def with_judgements(run: Run, problem: Problem, controller: Controller) -> Run:
    """Return a run with the signals that judge it, `JUDGING`; problem and controller are those of the run."""
    broken: list[str] = []
    judged = judgements(problem, controller, run.layout, run.log, broken)
    log = np.hstack([run.log, *(values for _, values in judged)])
    log.setflags(write=False)
    facts = {**run.settings, "broken": broken} if broken else run.settings
    return replace(run, layout=run.layout + Layout(tuple(signal for signal, _ in judged)), log=log, settings=facts)


def judgements(
    problem: Problem, controller: Controller, layout: Layout, log: np.ndarray, broken: list[str]
) -> list[Judgement]:
    """Return 'cost' by term where there is one of states that really are, and 'contraction' where the controller adapts.

    Sentences about signals that break are added to `broken`.
    """
    judged: list[Judgement | None] = []
    # A cost of states that the reality does not have is nobody's.
    whole = "plant_state" in layout and layout["plant_state"].elements == problem.plant.state.elements
    if problem.cost is not None and problem.horizon is not None and whole:
        judged.append(attempted("the signal 'cost'", _costs, problem, layout, log, broken=broken))
    gain = controller.deformation.effective_gain()
    of_responses = controller.deforms in ("response", "command")
    if gain != 0 and log.shape[0] and of_responses:
        named = "the signal 'contraction'"
        factors = attempted(named, _contraction, problem, controller, layout, log, broken=broken)
        finite = factors is not None and np.isfinite(factors).all()
        judged += [(scalar("contraction"), factors[:, None])] if factors is not None and finite else []
    return [one for one in judged if one is not None]


def _contraction(problem: Problem, controller: Controller, layout: Layout, log: np.ndarray) -> np.ndarray:
    """Return the factor of every cycle: of the Jacobian at an instant, with a reality of the one over a cycle.

    Plant and model have the signals from outside of the cycle. With a foreign reality it is the factor that the run shows, the same
    in every cycle, or NaN.
    """
    states, deformed = log[:, layout.slice("state")], log[:, layout.slice("deformed")]
    gain, model = controller.deformation.effective_gain(), controller.plant_model(problem)
    form = controller.deformation.form
    if not problem.equations_known:
        shown = (
            np.nan
            if problem.response_delay
            else identified_factor(deformed, log[:, layout.slice("realised")], gain, form.weights)
        )
        return np.full(len(log), shown)
    own = model.plant
    plant, real = (
        (own, states) if problem.reality is None else (problem.real_plant, log[:, layout.slice(REALITY_STATE)])
    )
    times = log[:, layout.slice("time")].ravel() + problem.period / 2
    exact = rows_of(real_values(plant, problem.signals), times, plant.exact)
    believed = rows_of(model_values(own, model.signals), times, model.parameters(own))
    modelled = problem if own is problem.plant else replace(problem, plant=own)

    def jacobians(rows: np.ndarray) -> np.ndarray:
        parameters = believed[rows], exact[rows]
        return form.weighted(jacobians_along(modelled, real[rows], states[rows], deformed[rows], *parameters))

    return factors_along(len(log), jacobians, gain)


def _costs(problem: Problem, layout: Layout, log: np.ndarray) -> tuple[Signal, np.ndarray]:
    """Return the stage cost of every cycle by term, at the actual state and command, with the exact parameters.

    With a reality it is the model's cost at the states that really were, with the exact values of the model's own parameters.
    The same cost judges all controllers of a problem, whatever their models: effort relative to a feedforward is relative to the
    feedforward of the plant.
    """
    shifted, own = LOGGED in layout.names, bool(problem.own_signals)
    ocp, evaluator = _COSTS.of((problem,), (shifted,), lambda: _cost_evaluator(problem, shifted=shifted))
    states = log[:, layout.slice("plant_state")]
    commands = log[:, layout.slice("command")]
    before = np.vstack([commands[:1], commands[:-1]])
    times = log[:, layout.slice("time")]
    # Along the reference that the run had, where it is no function of the time alone.
    motion = [log[:, layout.slice(name)] for name in ("reference", "reference_response")] if own else []
    # A disturbed output is h + d; its error is that of h to the reference less d.
    shift = [log[:, layout.slice(LOGGED)]] if shifted else []
    sources = times, *motion, *shift, states, commands, before
    costs = np.empty((log.shape[0], len(ocp.terms)))
    evaluator.arguments[-1][:] = problem.plant.exact
    for at in range(0, log.shape[0], _CHUNK):
        size = min(_CHUNK, log.shape[0] - at)
        for argument, source in zip(evaluator.arguments, sources, strict=False):
            argument.reshape(_CHUNK, -1)[:size] = source[at : at + size]
        evaluator.evaluate()
        costs[at : at + size] = evaluator.results[0].reshape(_CHUNK, -1)[:size]
    return Signal("cost", tuple(ocp.terms)), costs


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
