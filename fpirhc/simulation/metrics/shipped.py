"""Shipped metrics: errors and settling of what is judged, the commands, cycles by status, plans, the stage cost, the contraction.

The stage cost by term is the problem's own, so the same one judges all controllers, whatever their models. The contraction is the
factor by which the iteration shrinks an error per cycle: from the symbols along the measured cycles (all, where a run ended before
`measure_from`), and identified from the run.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np

from fpirhc.contraction.spectrum import identified_factor, jacobians_along, predicted_factor
from fpirhc.horizon.nominal import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.plant.motion import derivative_unit
from fpirhc.simulation.metrics import Function, Metric, by_name, coordinate_unit, input_unit, measured_cycles
from fpirhc.simulation.run import Run
from fpirhc.simulation.tables import LOGGED
from fpirhc.status import Status
from fpirhc.summary import in_percent, written_out
from fpirhc.symbolic.evaluate import Evaluator, Latest
from fpirhc.task.exogenous import model_values, real_values, rows_of
from fpirhc.task.problem import Problem

_SMALLEST = 1e-12  # range of a reference
SETTLED = 0.02  # half width of the band, as a share of the reference's range or of the first error, whichever is larger
_AT = 1e-9  # of the range between the limits: nearer is at the limit
_AT_RATE = 1 - 1e-6  # of the limit of a rate: faster is at the limit
# A run of a simulated plant counts these even where they never occurred; the others are statuses of a real plant.
_ALWAYS = (Status.OK, Status.NOT_CONVERGED, Status.INFEASIBLE, Status.HELD, Status.NON_FINITE)


def _of_errors(number: Callable[[np.ndarray, float], np.ndarray]) -> Callable[[Problem, Run], dict[str, float]]:
    """Function of a metric of every judged coordinate's measured errors and the period; a run that ended early has NaN."""

    def function(problem: Problem, run: Run) -> dict[str, float]:
        names, measured = run.layout["error"].elements, measured_cycles(problem, run)
        if run.stop is not None or not measured.any():
            return dict.fromkeys(names, np.nan)
        return by_name(names, number(run["true_error"][measured], problem.period))

    return function


rms_error = _of_errors(lambda e, _: np.sqrt((e * e).sum(axis=0) / len(e)))
max_error = _of_errors(lambda e, _: np.abs(e).max(axis=0))


def settling(problem: Problem, run: Run) -> dict[str, float]:
    """Return the time from which |error| stays within the band; 0 where it always is, NaN where the run ends outside it."""
    names, errors = run.layout["error"].elements, np.abs(run["true_error"])
    if run.stop is not None:
        return dict.fromkeys(names, np.nan)
    ranges = np.array([np.ptp(run[f"reference.{name}"]) for name in names])
    outside = errors > SETTLED * np.fmax(np.fmax(ranges, errors[0]), _SMALLEST)
    after = (outside * np.arange(1, run.cycles + 1)[:, None]).max(axis=0)
    return by_name(names, np.where(after < run.cycles, after * problem.period, np.nan))


def effort(problem: Problem, run: Run) -> dict[str, float]:
    """Return the rms command of every input."""
    commands = _measured(problem, run)
    return by_name(run.layout["command"].elements, np.sqrt(_mean(commands * commands)))


def command_range(problem: Problem, run: Run) -> dict[str, float]:
    """Return the largest less the smallest command of every input; NaN where no cycle is measured."""
    commands = _measured(problem, run)
    ranges = np.ptp(commands, axis=0) if len(commands) else np.full(commands.shape[1], np.nan)
    return by_name(run.layout["command"].elements, ranges)


def total_variation(problem: Problem, run: Run) -> dict[str, float]:
    """Return sum |u_k+1 - u_k| per unit of time, by input."""
    moves = _mean(np.abs(np.diff(_measured(problem, run), axis=0))) / problem.period
    return by_name(run.layout["command"].elements, moves)


def at_limit(problem: Problem, run: Run) -> float:
    """Return the share of the cycles in which a command, or its change, stands at a limit, clipped or planned there."""
    return float(_mean(np.asarray(at_limits(problem, run).any(axis=1))))


def at_limits(problem: Problem, run: Run, *, rates: bool = True) -> np.ndarray:
    """Return whether every command, or with `rates` its change, is at a limit in a measured cycle, shape (cycles, inputs)."""
    lower, upper = np.array(run.settings.get("limits", problem.limits.input_bounds(problem.plant)))  # in force
    span = upper - lower
    near, commands = _AT * np.where(np.isfinite(span), span, 1.0), _measured(problem, run)
    stands = (commands <= lower + near) | (commands >= upper - near)
    slowest, fastest = _AT_RATE * problem.period * np.array(problem.limits.rate_bounds(problem.plant))
    moves = np.diff(commands, axis=0, prepend=commands[:1])
    stands |= ((moves <= slowest) | (moves >= fastest)) & rates
    return np.asarray(stands)


def _measured(problem: Problem, run: Run) -> np.ndarray:
    """The commands of the measured cycles, shape (cycles, inputs)."""
    return run["command"].reshape(run.cycles, run.layout["command"].size)[measured_cycles(problem, run)]


def _mean(values: np.ndarray) -> np.ndarray:
    """The mean over cycles; NaN where no cycle is measured."""
    return np.asarray(values.sum(axis=0) / len(values) if len(values) else np.full(values.shape[1:], np.nan))


def cycles(problem: Problem, run: Run) -> int:  # noqa: ARG001 -- every metric is given the problem
    """Return the number of cycles."""
    return run.cycles


def status(problem: Problem, run: Run) -> dict[str, int]:  # noqa: ARG001 -- every metric is given the problem
    """Return the number of cycles of the whole run by status; that in which a run ended early counts as NON_FINITE."""
    counts = {s: int((run["status"] == s).sum()) for s in Status}
    counts[Status.NON_FINITE] += run.stop is not None
    return {s.name: count for s, count in counts.items() if count or s in _ALWAYS}


def iterations(value: float) -> str:
    """Return a number of iterations as text; an optimiser that does not report the number logs -1."""
    return f"{value:.0f}" if value >= 0 else "-"


def _over(column: str, summary: Callable[[np.ndarray], np.floating]) -> Function:
    """Function of a metric that sums up one column of 'solve'; a plan that is not finite has an entry there, but no such number."""

    def function(problem: Problem, run: Run) -> float | None:  # noqa: ARG001 -- every metric is given the problem
        if "solve" not in run.layout:
            return None
        counts = column == "iterations" or run["solve.status"] < Status.NON_FINITE
        values = run[f"solve.{column}"][np.broadcast_to(counts, run.cycles)]
        return float(summary(values)) if values.size else None

    return function


def plans(problem: Problem, run: Run) -> int | None:  # noqa: ARG001 -- every metric is given the problem
    """Return the number of different plans: one that is held for several cycles counts once."""
    return len(np.unique(run["solve"], axis=0)) if "solve" in run.layout and run.cycles else None


_SHORTEST = 10  # cycles from which a run is long enough for a factor
_SAMPLES = 200  # cycles of a run whose eigenvalues are computed


def predicted(problem: Problem, run: Run) -> float | None:
    """Return the largest max|1 - a lambda| in sampled cycles of the run; None for an ExternalPlant. See `fpirhc.contraction`."""
    eigenvalues = _eigenvalues(problem, run)
    return None if eigenvalues is None else predicted_factor(eigenvalues, _gain(run))


def growing(problem: Problem, run: Run) -> float | None:
    """Return the share of the sampled cycles with max|1 - a lambda| >= 1, in which small errors do not shrink."""
    eigenvalues = _eigenvalues(problem, run)
    return None if eigenvalues is None else float(np.mean(np.abs(1 - _gain(run) * eigenvalues).max(axis=1) >= 1))


def measured(problem: Problem, run: Run) -> float | None:
    """Return the factor that is fitted to requests and responses of the run; NaN where they do not excite every direction.

    None where the response is late: it does not belong to the last request. None too for a plant outside that nothing excites.
    """
    if not _adapts(run) or problem.response_delay:
        return None
    factor = identified_factor(run["deformed"], run["plant_realised"], _gain(run), _weights(run))
    return factor if problem.moves.simulated or np.isfinite(factor) else None


def _gain(run: Run) -> float:
    gain = run.settings["effective_gain"]
    assert isinstance(gain, float)
    return gain


def _weights(run: Run) -> np.ndarray | None:
    rows = run.settings.get("weights")
    return None if rows is None else np.array(rows)


def sampled_spectrum(problem: Problem, run: Run) -> np.ndarray:
    """Return the eigenvalues of the weighted response Jacobian at sampled cycles of a run, with its controller's parameters.

    The cycles are those from `measure_from` on, without the first of the run, before which there is no request.

    With a reality that is a plant they are those over a whole cycle; signals from outside have the values of the cycle.
    """
    first = max(1, int(np.argmax(measured_cycles(problem, run))))
    rows = np.unique(np.linspace(first, run.cycles - 1, _SAMPLES).astype(int))
    states, deformed, times = run["state"][rows], run["deformed"][rows], run.time[rows] + problem.period / 2
    task = problem.of_equations
    modelled = replace(task, plant=task.real_plant) if run.settings.get("model is reality") else task
    real = run["reality_state"][rows] if "reality_state" in run.layout else states
    known = rows_of(model_values(modelled.plant, task.signals), times, np.array(run.settings["parameters"]))
    exact = rows_of(real_values(task.real_plant, task.signals), times, task.real_plant.exact)
    jacobians = jacobians_along(modelled, real, states, deformed, known, exact)
    finite, weights = jacobians[np.isfinite(jacobians).all(axis=(1, 2))], _weights(run)
    return np.linalg.eigvals(finite if weights is None else finite @ weights)


def _eigenvalues(problem: Problem, run: Run) -> np.ndarray | None:
    """Those of sampled cycles; None where its factors do not follow from equations."""
    eigenvalues = sampled_spectrum(problem, run) if _adapts(run) and problem.moves.simulated else None
    return eigenvalues if eigenvalues is not None and len(eigenvalues) else None


def _adapts(run: Run) -> bool:
    """Whether the run has a contraction: where its controller adapts the plant's own response."""
    return bool(run.settings.get("iterates")) and run.cycles >= _SHORTEST


# Every controller of a comparison is judged by the same cost.
_COSTS: Latest[tuple[tuple[str, ...], ca.Function]] = Latest(2)


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
    terms, one = _COSTS.of((problem,), (shifted,), lambda: _cost_function(problem, shifted=shifted))
    states, commands = run["plant_state"], run["command"]
    before = np.vstack([commands[:1], commands[:-1]])
    # Along the reference that the run had, where it is no function of the time alone.
    motion = [run[name] for name in ("reference", "reference_response")] if own else []
    # A disturbed output is h + d; its error is that of h to the reference less d.
    shift = [run[LOGGED]] if shifted else []
    exact = np.tile(problem.plant.exact, (run.cycles, 1))
    sources = run["time"], *motion, *shift, states, commands, before, exact
    [costs] = Evaluator(one.map(run.cycles))(*sources)
    return terms, costs.reshape(run.cycles, -1)


def _cost_function(problem: Problem, *, shifted: bool) -> tuple[tuple[str, ...], ca.Function]:
    """The terms, and their Function (time, [states and responses of the reference], [shift], state, input, the one before, p).

    It is that of the first stage of a horizon of one cycle. The shift is subtracted from the reference.
    """
    assert problem.horizon is not None
    assert problem.cost is not None
    plant, own = problem.plant, bool(problem.own_signals)
    one_cycle = replace(problem.horizon, stages=1, step=problem.period, blocks=(), margins={}, lengths=())
    ocp = transcribe(plant, problem.reference, one_cycle, problem.cost, problem.limits, start=problem.start_state)
    outside = real_values(plant, problem.signals)
    data_of = stage_data(plant, problem.reference, one_cycle, problem.cost, signals=outside, previewed=own)
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
    one = ca.Function("fpirhc_cost", [t, *motion, x, u, before, p], [ca.densify(terms)])
    with contextlib.suppress(RuntimeError):  # a table to look up, or a solver, is no scalar code
        one = one.expand()
    return tuple(ocp.terms), one


METRICS = (
    Metric("rms_error", rms_error, by="coordinate", unit=coordinate_unit, short="rms", main=True, order=10),
    Metric("max_error", max_error, by="coordinate", unit=coordinate_unit, order=20),
    Metric("settling", settling, by="coordinate", unit=lambda problem, _: problem.time_unit, title="settled", order=40),
    Metric("effort", effort, by="input", unit=input_unit, better="neither", title="rms", order=50),
    Metric("command_range", command_range, by="input", unit=input_unit, better="neither", report=False, order=50),
    Metric(
        "total_variation",
        total_variation,
        by="input",
        unit=lambda problem, name: derivative_unit(input_unit(problem, name), 1, problem.time_unit),
        better="neither",
        title="variation",
        main=True,
        order=50,
    ),
    Metric("at_limit", at_limit, better="neither", title="at limit", text=in_percent, main=True, order=50),
    Metric("cycles", cycles, better="neither", report=False, order=5),
    Metric("status", status, by="status", better="neither", report=False, order=80),
    Metric(
        "solve.median_iterations",
        _over("iterations", np.median),
        title="iterations",
        short="iter",
        text=iterations,
        order=90,
    ),
    Metric("solve.worst_iterations", _over("iterations", np.max), text=iterations, report=False, order=90),
    Metric(
        "solve.median_stationarity",
        _over("stationarity", np.median),
        text=lambda value: written_out(value, 1),
        title="residual",
        short="residual",
        report=False,
        order=90,
    ),
    Metric("solve.worst_stationarity", _over("stationarity", np.max), title="worst residual", order=90),
    Metric("solve.worst_feasibility", _over("feasibility", np.max), report=False, order=90),
    Metric("plans", plans, better="neither", report=False, order=90),
    Metric("cost", cost, by="term", shown=("total",), order=70, always=False),
    Metric(
        "contraction.measured",
        measured,
        short="contr. factor",
        better="neither",  # the smallest factor is not the best gain
        main=True,
        order=85,
        always=False,
    ),
    Metric("contraction.predicted", predicted, title="contraction bound", better="neither", order=85, always=False),
    Metric("contraction.growing", growing, title="bound above 1", text=in_percent, order=85, always=False),
)
