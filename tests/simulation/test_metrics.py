"""Metrics and figures of merit by value: every number that a user reads, on runs that were made by hand."""

import math
import pickle
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.first_files import PENDULUM
from helpers.plants import linear

import fpirhc as fp
from fpirhc.contracts import Layout, Signal, scalar
from fpirhc.errors import FpirhcError, InvalidName, InvalidValue

PERIOD, CYCLES = 0.1, 100
SOLVE = ("cost", "stationarity", "feasibility", "iterations", "status")


def problem(**changes) -> fp.Problem:
    """A plant with one coordinate [m] and one input [N], measured from the second half of a run on."""
    settings = {
        "plant": linear(1.0, 1.0),
        "start": {"y": 0.0},
        "period": PERIOD,
        "duration": PERIOD * CYCLES,
        "measure_from": 5.0,
    }
    return fp.Problem(reference=fp.Trajectory(lambda t: {"y": ca.sin(t)}), **{**settings, **changes})


def run(error, *, reference=None, clipped=0.0, command=0.0, status=0, stop=None, **more) -> fp.Run:
    """A run with this error of 'y' in every cycle; `more` are further signals (name -> columns)."""
    error = np.broadcast_to(np.asarray(error, dtype=float), (CYCLES,))
    reference = np.linspace(0.0, 1.0, CYCLES) if reference is None else reference
    motion = np.column_stack([reference - error, 0 * reference])
    signals = {
        "time": (scalar("time", "s"), PERIOD * np.arange(CYCLES)),
        "reference": (Signal("reference", ("y", "y'"), ("m", "m/s")), np.column_stack([reference, 0 * reference])),
        "state": (Signal("state", ("y", "y'"), ("m", "m/s")), motion),
        "error": (Signal("error", ("y",), ("m",)), error),
        "command": (Signal("command", ("u",), ("N",)), command),
        "clipped": (scalar("clipped"), clipped),
        "status": (scalar("status"), status),
        **more,
        "plant_state": (Signal("plant_state", ("y", "y'"), ("m", "m/s")), motion),
        "true_error": (Signal("true_error", ("y",), ("m",)), error),
    }
    log = np.hstack([np.broadcast_to(np.asarray(v, float).T, (s.size, CYCLES)).T for s, v in signals.values()])
    layout, cycles = Layout(tuple(s for s, _ in signals.values())), CYCLES if stop is None else CYCLES // 4
    return fp.Run("case", "CTC", 0, PERIOD, layout, log[:cycles], stop, False, {})


def step(before, after, cycle):
    """`before` up to a cycle, `after` from it on."""
    return np.where(np.arange(CYCLES) < cycle, before, after)


def test_errors_are_those_of_the_measured_part():
    """Ten in the transient, which does not count; then 3 and 4 in turn: rms (12.5)^(1/2), largest 4."""
    error = np.where(np.arange(CYCLES) < 50, 10.0, np.where(np.arange(CYCLES) % 2, 3.0, -4.0))
    metrics = fp.measure(problem(), run(error))
    assert metrics.rms_error["y"] == pytest.approx(np.sqrt(12.5))
    assert metrics["max_error"]["y"] == 4.0


STILL, SMALL = np.zeros(CYCLES), np.linspace(0.0, 1e-3, CYCLES)
FIRST_WIDENS = np.where(np.arange(CYCLES) == 1, 50.0, step(5.0, 0.101, 20))
SETTLING = {
    "inside the band": (step(0.5, 0.019, 30), None, 3.0),
    "outside the band": (step(0.5, 0.021, 30), None, np.nan),
    "outside up to the last cycle but one": (step(0.5, 0.0, 99), None, 9.9),
    "outside in the last": (0.5, None, np.nan),
    "outside in the first": (step(0.5, 0.0, 1), None, 0.1),
    "never outside; the whole run counts": (0.01, None, 0.0),
    "at rest, the band is that of the first error": (step(5.0, 0.099, 20), STILL, 2.0),
    "at rest, outside the band": (step(5.0, 0.101, 20), STILL, np.nan),
    "at rest, from below": (step(-5.0, 0.1, 20), STILL, 2.0),
    "at rest, a later and larger error does not widen it": (FIRST_WIDENS, STILL, np.nan),
    "at rest without an error": (0.0, STILL, 0.0),
    "at rest without a first error, the band has a floor": (step(0.0, 1e-15, 30), STILL, 0.0),
    "a millimetre": (step(5e-4, 1.9e-5, 30), SMALL, 3.0),
    "a millimetre, outside": (step(5e-4, 2.1e-5, 30), SMALL, np.nan),
}


@pytest.mark.parametrize("name", SETTLING)
def test_settling_is_the_cycle_after_the_last_one_outside_two_per_cent(name):
    """Of the range of the reference, 1 m; of the first error where it rests."""
    error, reference, settled = SETTLING[name]
    assert fp.measure(problem(), run(error, reference=reference))["settling"]["y"] == pytest.approx(
        settled, nan_ok=True
    )


def test_at_limit_is_where_a_command_stands_and_of_the_measured_part():
    """At 2 N, clipped or planned there, for 20 of the 50 measured cycles; what came before does not count."""
    limited = problem(limits=fp.Limits(inputs={"u": (-1.0, 2.0)}))

    def share(after: float, given: fp.Problem = limited) -> float:
        return fp.measure(given, run(0.0, command=step(2.0, after, 70)))["at_limit"][""]

    assert share(0.0) == pytest.approx(0.4)
    assert share(-1.0) == share(2.0 - 2e-9) == 1.0
    assert share(2.0 - 4e-9) == pytest.approx(0.4)  # 1e-9 of the range of 3 N is at the limit
    assert share(2.0, problem()) == 0.0  # nothing limits it
    pump = problem(limits=fp.Limits(inputs={"u": (0.0, float("inf"))}))
    assert share(0.0, pump) == share(0.9e-9, pump) == pytest.approx(0.6)
    assert share(1.5e-9, pump) == 0.0  # a billionth of 1 N where a limit is open
    given = replace(run(0.0, command=step(2.0, 0.0, 70)), settings={"limits": [[0.0], [2.0]]})
    assert fp.measure(limited, given)["at_limit"][""] == 1.0  # a limit that the run was given
    slow = problem(limits=fp.Limits(rates={"u": (-1.0, 2.0)}))  # 0.1 N down and 0.2 N up a cycle, to a millionth
    moves = {-0.1 + 5e-8: 0.98, -0.1 + 2e-7: 0.0, 0.2 - 1e-7: 0.98, 0.2 - 3e-7: 0.0}  # the first measured one begins
    for move, stands in moves.items():
        assert fp.measure(slow, run(0.0, command=move * np.arange(CYCLES)))["at_limit"][""] == pytest.approx(stands)


def test_total_variation_is_movement_per_second_and_effort_the_rms():
    """2 N up and 2 N down in turn, every 0.1 s, from t = 5 s on: 20 N/s. What was sent before does not count."""
    command = np.where(np.arange(CYCLES) < 50, 100.0 * np.arange(CYCLES), np.arange(CYCLES) % 2 * 2.0)
    metrics = fp.measure(problem(), run(0.0, command=command))
    assert metrics.total_variation["u"] == pytest.approx(20.0)
    assert metrics["effort"]["u"] == pytest.approx(np.sqrt(2.0))
    assert metrics.units["total_variation"]["u"] == "N/s"
    assert fp.measure(problem(measure_from=9.8), run(0.0, command=command)).total_variation["u"] == pytest.approx(20.0)
    assert fp.measure(problem(), run(0.0, command=3.0)).total_variation["u"] == 0.0


PRICED: dict[str, Any] = {
    "cost": fp.Quadratic(states={"y": 1.0}, effort={"u": 0.5}),
    "horizon": fp.Horizon(stages=2, step=PERIOD),
}


def test_cost_is_the_sum_of_the_measured_part_by_term():
    """An error of 2 m and a command of 2 N for 5 s: 20 and 10. Others before do not count, and no run that ended early has one."""
    along: dict[str, Any] = {"reference": np.sin(PERIOD * np.arange(CYCLES)), "command": step(9.0, 2.0, 50)}
    metrics = fp.measure(problem(**PRICED), run(step(9.0, 2.0, 50), **along))
    assert metrics["cost"] == pytest.approx({"states": 20.0, "effort": 10.0, "total": 30.0})
    every = fp.measure(problem(**PRICED, measure_from=0.0), run(step(9.0, 2.0, 50), **along))
    assert every["cost"]["total"] == pytest.approx(30.0 + 1.5 * 81 * 5)
    assert [fp.measure(problem(**{k: PRICED[k]}), run(0.0))["cost"] for k in PRICED] == [{}, {}]
    assert fp.measure(problem(**PRICED), run(0.0, **along, stop="signal 'x' is not finite"))["cost"] == {}


def test_statuses_are_counted_and_the_worst_is_told():
    """Ninety cycles as they should be, seven not converged, three held."""
    status = np.repeat([fp.Status.OK, fp.Status.NOT_CONVERGED, fp.Status.HELD], [90, 7, 3])
    metrics = fp.measure(problem(), run(0.0, status=status))
    assert metrics.statuses == {"OK": 90, "NOT_CONVERGED": 7, "HELD": 3}
    assert metrics.worst_status == "HELD"
    assert repr(metrics["cycles"][""]) == "100"  # a count stays whole in files
    # Two held cycles of that status, and the one in which the run ended; a status that never occurred counts zero.
    status = np.where(np.arange(CYCLES) < 2, float(fp.Status.NON_FINITE), 0.0)
    metrics = fp.measure(problem(), run(0.0, status=status, stop="signal 'x' is not finite"))
    assert metrics.statuses == {"OK": 23, "NON_FINITE": 3}
    always = ("OK", "NOT_CONVERGED", "INFEASIBLE", "HELD", "NON_FINITE")  # the others are statuses of a machine
    assert metrics["status"] == {name: {"OK": 23, "NON_FINITE": 3}.get(name, 0) for name in always}


def of_plans(metrics) -> dict[str, float]:
    """The numbers of the optimiser by name."""
    return {m.name.removeprefix("solve."): value for m, _, value in metrics.rows() if m.name.startswith("solve.")}


def test_solves_are_summed_up_over_the_whole_run():
    """Iterations 1 to 10, residuals of a ninth of that; a plan that is held for ten cycles is one plan."""
    iterations = np.repeat(np.arange(1.0, 11.0), 10)
    solve = np.column_stack([0 * iterations, iterations / 9, iterations / 81, iterations, 0 * iterations])
    metrics = fp.measure(problem(), run(0.0, solve=(Signal("solve", SOLVE), solve)))
    wanted = {"median_iterations": 5.5, "worst_iterations": 10, "median_stationarity": 5.5 / 9}
    assert of_plans(metrics) == pytest.approx({**wanted, "worst_stationarity": 10 / 9, "worst_feasibility": 10 / 81})
    assert metrics["plans"][""] == 10
    assert of_solves(np.arange(CYCLES) // 10 % 2)["plans"][""] == 2  # plans that return are counted once
    assert of_solves(np.arange(CYCLES))["plans"][""] == CYCLES
    said = {m.name: m.text(value) for m, _, value in metrics.rows()}
    assert [said[f"solve.{name}"] for name in ("worst_iterations", "median_stationarity")] == ["10", "0.6"]
    text = metrics.entries["solve.worst_iterations"].text
    assert (text(0.0), text(of_solves(np.zeros(CYCLES))["solve.worst_iterations"][""])) == ("0", "-")  # it tells none
    assert of_plans(fp.measure(problem(), run(0.0))) == {}


def test_a_run_that_ended_early_has_no_errors():
    """Its errors are NaN, it never settled, and the cycle in which it ended counts as not finite."""
    metrics = fp.measure(problem(), run(1.0, stop="signal 'x' is not finite"))
    for name in ("rms_error", "max_error", "settling", "effort"):
        assert np.isnan(list(metrics[name].values())).all()
    late = fp.measure(problem(measure_from=0.0), run(1e-3, stop="it ended inside the band"))
    assert np.isnan([late["settling"]["y"], late.rms_error["y"]]).all()
    assert metrics.statuses == {"OK": 25, "NON_FINITE": 1}
    assert metrics.worst_status == "NON_FINITE"


def test_contraction_is_the_factor_of_the_plant_and_the_gain():
    """With y'' = 1.6 u and a believed gain of one, J = 1.6: |1 - 1.6 a| for the effective gain a, from symbols and from the run.

    The gain is that of the run; ten cycles are needed, and a controller that adapts nothing has no factor.
    """
    deformation = fp.Sigmoid(gain=-0.4, scale=50.0)
    task = problem(plant=linear(1.6, 1.0), start={"y": 0.5}, period=1e-3, duration=1.0, measure_from=0.0)
    controllers = fp.ComputedTorque(fp.Exponential(rate=6.0), deformation), fp.ComputedTorque(fp.Exponential(rate=6.0))
    result, plain = (fp.simulate(task, c, seed=0, compiled=False) for c in controllers)
    factor, adaptive = abs(1 - 1.6 * deformation.effective_gain()), fp.measure(task, result)
    assert 0.1 < factor < 0.9
    assert adaptive["contraction.predicted"][""] == pytest.approx(factor)
    assert adaptive["contraction.measured"][""] == pytest.approx(factor, rel=0.1)
    assert adaptive["contraction.growing"][""] == 0.0
    silent = replace(result, settings={k: v for k, v in result.settings.items() if k != "iterates"})
    assert fp.measure(task, plain)["contraction.predicted"] == fp.measure(task, silent)["contraction.predicted"] == {}
    larger = replace(result, settings={**result.settings, "effective_gain": 1.5})  # |1 - 1.6 * 1.5| = 1.4
    assert fp.measure(task, larger)["contraction.growing"][""] == 1.0
    for cycles, names in ((9, set()), (10, {"contraction.predicted", "contraction.growing", "contraction.measured"})):
        metrics = fp.measure(task, result.first(cycles))
        assert {m.name for m, _, _ in metrics.rows() if m.name.startswith("contraction")} == names


def test_contraction_with_a_signal_from_outside_is_that_of_the_middle_of_a_cycle():
    """Of y'' = w u, which the model takes for one: 1 - a w is largest where w is least, in the first or the last cycle of those.

    The first of a run is none, as there was no request before it.
    """
    plant = replace(linear(1.0, 1.0), parameters={"b": fp.outside(1.0, "1/kg")})
    law = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Affine(gain=-0.8))
    for sign, begin, least in (1, 0.2, 1.205), (1, 0.0, 1.015), (-1, 0.0, 0.5025):
        signals = {"b": fp.Unknown(lambda t, sign=sign: 1 + (t if sign > 0 else -t / 2))}
        task = problem(plant=plant, start={"y": 0.5}, period=1e-2, duration=1.0, measure_from=begin, signals=signals)
        found = fp.measure(task, fp.simulate(task, law, seed=0, compiled=False))["contraction.predicted"][""]
        assert found == pytest.approx(abs(1 - law.deformation.effective_gain() * least), rel=1e-9)


def test_contraction_of_an_exact_model_is_that_of_the_reality_that_it_is():
    """Of a reality y'' = 2 u the model y'' = 1.6 u sees 1.25 of its own response, and the reality as the model sees one."""
    deformation = fp.Affine(gain=-0.8)
    other = replace(linear(1.0, 1.0), response=lambda q, v, u, p: {"y": 2 * p.b * u.u})
    believed = problem(plant=linear(1.6, 1.6), start={"y": 0.5}, period=1e-3, duration=1.0, measure_from=0.0)
    task = replace(believed, reality=fp.Reality(other))
    law = fp.ComputedTorque(fp.Exponential(rate=6.0), deformation)
    for controller, gain in ((law, 1.25), (fp.ExactModel(law), 1.0)):
        metrics = fp.measure(task, fp.simulate(task, controller, seed=0, compiled=False))
        assert metrics["contraction.predicted"][""] == pytest.approx(abs(1 - gain * deformation.effective_gain()))


@pytest.mark.parametrize("late", [False, True])
def test_every_run_has_the_same_columns(late):
    """What the plant did is there with ideal and with late measurement; a loop that is told it does not log it twice."""
    dead_time = fp.DeadTime(measurement=0.2) if late else fp.DeadTime()
    task = problem(dead_time=dead_time, start={"y": 0.3}, measure_from=0.0)
    result = fp.simulate(task, fp.ComputedTorque(fp.Exponential(rate=1.0)), seed=0, compiled=False)
    assert {"plant_state", "plant_realised", "true_error"} <= set(result.layout.names)
    np.testing.assert_array_equal(result["true_error"], result["reference"][:, :1] - result["plant_state"][:, :1])
    assert np.array_equal(result["plant_state"], result["state"]) != late
    assert np.array_equal(result["plant_realised"], result["realised"]) != late
    assert np.array_equal(result["true_error"], result["error"]) != late
    assert result.unit("plant_realised.y") == result.unit("realised.y")


def of_solves(plans) -> Any:
    """Metrics of a run with these plans, cycle by cycle: one number stands for a whole plan."""
    plans = np.asarray(plans, dtype=float)
    solve = np.column_stack([plans, 0 * plans, 0 * plans, -1 + 0 * plans, 0 * plans])
    return fp.measure(problem(), run(0.0, solve=(Signal("solve", SOLVE), solve)))


def test_a_run_that_ended_at_once_has_no_numbers():
    solve = (Signal("solve", SOLVE), np.ones((CYCLES, 5)))
    metrics = fp.measure(problem(), replace(run(1.0, solve=solve).first(0), stop="signal 'x' is not finite"))
    assert np.isnan([value for m, _, value in metrics.rows() if m.order < 70 and m.name != "cycles"]).all()
    assert of_plans(metrics) == {}
    assert metrics.statuses == {"NON_FINITE": 1}
    assert metrics["cycles"] == {"": 0}
    assert metrics.broken == fp.measure(problem(), run(1.0)).broken == {}


def test_a_plan_that_is_not_finite_has_iterations_and_no_residual():
    """It took its time, and its residual is no number of a plan."""
    solve = np.tile([0.0, 0.1, 0.2, 3.0, fp.Status.OK], (CYCLES, 1))
    solve[7] = [0.0, 9.0, 9.0, 50.0, fp.Status.NON_FINITE]
    of = of_plans(fp.measure(problem(), run(0.0, solve=(Signal("solve", SOLVE), solve))))
    assert (of["worst_iterations"], of["worst_stationarity"], of["worst_feasibility"]) == (50, 0.1, 0.2)


def overshoot(task, run):
    """Largest error beyond the reference, by coordinate."""
    return {c: float(np.max(-run[f"true_error.{c}"])) for c in run.layout["error"].elements}


OVERSHOOT = fp.Metric("overshoot", overshoot, by="coordinate", unit="m", main=True, order=15)


def test_a_metric_is_one_value():
    """Measured, with its unit, and as it writes itself."""
    metrics = fp.measure(problem(), run(np.linspace(1.0, -0.25, CYCLES)), [OVERSHOOT])
    assert metrics["overshoot"] == {"y": 0.25}
    assert ("overshoot", "y", "0.25") in [(m.name, element, m.text(value)) for m, element, value in metrics.rows()]
    assert metrics.units["overshoot"]["y"] == "m"
    with pytest.raises(InvalidName, match="Did you mean 'overshoot'"):
        metrics["overshot"]


def returning(by: Any, result: Any) -> fp.Metric:
    return fp.Metric("mine", lambda problem, run: result, by=by)


REFUSED: dict[str, Callable[[], Any]] = {
    "metric 'mine': .*must return a mapping with a number for every coordinate, got float": lambda: returning("coordinate", 3.0),
    "metric 'mine': .*must return one number, got dict": lambda: returning(None, {"y": 3.0}),
    "metric 'mine': .*expected numbers, got str": lambda: returning("coordinate", {"y": "three"}),
    "low is 3 and high is 2; expected low < high": lambda: fp.figures.InBand("command.u", 3.0, 2.0),
    "low is 3 and high is 3; expected low < high": lambda: fp.figures.InBand("command.u", 3.0, 3.0),
}  # fmt: skip


@pytest.mark.parametrize("message", REFUSED)
def test_a_metric_that_has_no_meaning_is_refused(message):
    with pytest.raises(InvalidValue, match=message):
        fp.measure(problem(), run(0.0), [REFUSED[message]()])


TAKEN = {
    "rms_error": "is defined 2 times", "solve": "has another meaning", "plan": "has another meaning",
    "plan.first": "has another meaning", "Mine": "expected a name of small letters", "mine.first": "", "solve.mine": "",
}  # fmt: skip


@pytest.mark.parametrize("name", TAKEN)
def test_a_name_that_stands_for_something_else_in_results_is_refused(name, tmp_path):
    """For a known metric, for a group of them, or for another fact of a run; one's own metrics come last."""
    (tmp_path / "mine.py").write_text(f"{PENDULUM}\nmetrics = (fp.Metric({name!r}, lambda problem, run: 1.0),)\n")
    if TAKEN[name]:
        with pytest.raises(FpirhcError, match=TAKEN[name]):
            fp.load_problem(tmp_path / "mine.py")
    else:
        assert fp.load_problem(tmp_path / "mine.py").metrics[-1].name == name


# Figures of merit by value, on runs that were made by hand; 50 cycles of 0.1 s are measured, from t = 5 s on
figures = fp.figures
# Ten before the measured part, which does not count; then 3 and -4 in turn.
COMMAND = np.where(np.arange(CYCLES) < 50, 10.0, np.where(np.arange(CYCLES) % 2, 3.0, -4.0))


@pytest.mark.parametrize(
    ("figure", "value", "unit", "better"),
    [
        (figures.InBand("command.u", -4.0, 3.0), 1.0, "1", "larger"),
        (figures.TimeOver("command.u", 2.9), 2.5, "s", "smaller"),
        (figures.TimeOver("command.u", 3.0), 0.0, "s", "smaller"),
        (figures.Total("command.u"), -2.5, "N s", "smaller"),
        (figures.Total("state.y'"), 0.0, "m", "smaller"),
        (figures.Overshoot("y"), 0.0, "m", "smaller"),
        (figures.Largest("command.u"), 4.0, "N", "smaller"),
        (figures.Nadir("command.u"), -4.0, "N", "larger"),
        (figures.Largest(fp.Quantity("half", "kN", lambda r: r["command.u"] / 2)), 2.0, "kN", "smaller"),
    ],
)
def test_figures_have_the_value_of_their_definition(figure, value, unit, better):
    metrics = fp.measure(problem(), run(0.0, command=COMMAND), [figure])
    assert metrics[figure.name][""] == pytest.approx(value)
    assert metrics.units[figure.name][""] == unit
    assert (figure.better, figure.main) == (better, True)
    ended = fp.measure(problem(measure_from=0.0), run(0.0, command=COMMAND, stop="limits"), [figure])
    assert math.isnan(ended[figure.name][""])


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_an_overshoot_is_beyond_the_last_change_of_the_reference(direction):
    """The reference steps at 6 s; 0.2 m beyond it counts and 0.5 m short of it does not, whatever the step's direction."""
    reference = direction * step(0.0, 1.0, 60)
    error = direction * np.where(np.arange(CYCLES) == 61, 0.5, np.where(np.arange(CYCLES) == 70, -0.2, 0.0))
    metrics = fp.measure(problem(), run(error, reference=reference), [figures.Overshoot("y")])
    assert metrics["overshoot"][""] == pytest.approx(0.2)
    assert metrics.units["overshoot"][""] == "m"
    short = fp.measure(problem(), run(np.abs(error) * direction, reference=reference), [figures.Overshoot("y")])
    assert short["overshoot"][""] == 0.0


def test_the_first_direction_is_that_from_the_start_to_the_reference():
    """A set point that never moves: the plant begins 1 m below it and goes 0.3 m beyond."""
    metrics = fp.measure(problem(), run(step(1.0, -0.3, 1), reference=np.zeros(CYCLES)), [figures.Overshoot("y")])
    assert metrics["overshoot"][""] == pytest.approx(0.3)


def test_a_signal_that_is_not_there_breaks_its_figure_alone():
    several = figures.Nadir("state", name="several")  # its entries have units of their own
    metrics = fp.measure(problem(), run(0.0), [figures.Largest("comand.u"), figures.Nadir("command.u"), several])
    assert metrics["nadir"][""] == 0.0
    assert "name one, such as 'state.y'" in metrics.broken["several"]
    assert "metric 'largest'" in metrics.broken["largest"]
    assert "Did you mean 'command.u'?" in metrics.broken["largest"]


# In the order of tables. h: stands in short ones, r: in reports, s: in studies too where nobody judges by it.
MEANT = {
    "cycles": "s", "rms_error": "hrs", "max_error": "rs", "settling": "rs", "effort": "rs", "command_range": "s",
    "total_variation": "hrs", "at_limit": "hrs", "cost": "r", "status": "s", "contraction.measured": "hr",
    "contraction.predicted": "r", "contraction.growing": "r", "solve.median_iterations": "rs", "solve.worst_iterations": "s",
    "solve.median_stationarity": "s", "solve.worst_stationarity": "rs", "solve.worst_feasibility": "s", "plans": "s",
}  # fmt: skip


def test_metrics_come_from_other_processes_and_say_what_they_are_for():
    """Pickled and read again they are the same numbers of the same metrics."""
    task = fp.load_problem("two_mass")
    problem = replace(task.problem, duration=0.05, measure_from=0.0)
    metrics = fp.measure(problem, fp.simulate(problem, task.controllers["RHC+FPI"], seed=0, compiled=False))
    again = pickle.loads(pickle.dumps(metrics))
    assert repr(dict(again)) == repr({name: metrics[name] for name in metrics}) == repr(dict(metrics.items()))
    assert all(again.entries[name] is metric for name, metric in metrics.entries.items())
    found = {}
    for m in dict.fromkeys(metric for metric, _, _ in metrics.rows()):
        marks = zip("hrs", (m.main, m.report, m.always), strict=True)
        found[m.name] = "".join(letter for letter, on in marks if on)
    assert list(found.items()) == list(MEANT.items())
