"""Iterations on targets, of outputs that the command moves later (a cascade) and at once (order 0), and learners beside outputs."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
import scipy.linalg
from helpers import tasks
from helpers.of_outputs import OPTIMISER, affine, arm, circle, hill, planned, sedated
from helpers.plants import simulated
from scipy.optimize import least_squares

import fpirhc as fp
from fpirhc.contracts import Controller, Deformation

STATIC = fp.FeedforwardOnly()
SETTLING, LAGGED = 20.0, 5.0  # the heat exchanger's, and that of `linear`


def rms_and_step(problem: fp.Problem, controller: Any) -> tuple[float, float]:
    """Rms error of the output and largest step of the command, without the transient."""
    run = fp.simulate(problem, controller, seed=1, compiled=False)
    assert run.stop is None
    measured = run.time >= problem.measure_from
    error, command = run["error"][measured], run["command"][measured]
    return float(np.sqrt(np.mean(error**2))), float(np.abs(np.diff(command, axis=0)).max())


def test_paired_through_the_model_every_gain_serves():
    """A map with slopes from .15 to 2.15 behind a lag and a dead time: up to twelve times better than without, and quiet."""
    without, _ = rms_and_step(tasks.heat_exchanger.problem, STATIC)
    for gain, share in ((0.05, 0.2), (0.1, 0.13), (0.2, 0.11), (0.5, 0.1), (0.9, 0.1)):
        error, step = rms_and_step(tasks.heat_exchanger.problem, fp.Cascade(STATIC, affine(gain), SETTLING))
        assert error < share * without, gain
        assert step < 0.01, gain


def test_the_shift_is_that_of_the_recursion_by_hand():
    """Logged outputs through the formulas in numpy: reference and shift in force, undeformed target, map."""
    run = fp.simulate(tasks.heat_exchanger.problem, fp.Cascade(STATIC, affine(0.4), SETTLING), seed=1, compiled=False)
    decay, gain = np.exp(-1 / 20), 0.4
    reference, shifts = run["reference.outlet"], [0.0] * 6
    shift, in_force = 0.0, 0.3 - reference[0]
    for k in range(400):
        target_in_force = reference[max(k - 5, 0)] + in_force
        if k:
            shift = shift - gain * (run["state.outlet"][k] - target_in_force + shift)
        assert run["shift.outlet"][k] == pytest.approx(shift, abs=1e-12)
        assert run["target.outlet"][k] == pytest.approx(reference[k] + shift, abs=1e-12)
        shifts = [shift, *shifts[:5]]
        in_force = decay * in_force + (1 - decay) * shifts[5]


def linear(slope: float, **changes: Any) -> fp.Problem:
    """Y' = (slope u - y) / 5 s with the model y' = (u - y) / 5 s, a set-point of one, cycles of 4 s."""
    plant = fp.Plant(
        coordinates={"y": "K"},
        inputs={"u": "1"},
        order=1,
        response=lambda q, u, p: {"y": (p.slope * u.u - q.y) / 5.0},
        parameters={"slope": fp.Parameter(approximate=1.0, exact=slope, unit="K")},
    )
    values = {
        "plant": plant,
        "reference": fp.Trajectory(lambda t: {"y": 1.0 + 0 * t}),
        "start": {"y": 0.0},
        "period": 4.0,
        "duration": 1600.0,
        "integrator": fp.RungeKutta4(8),
    }
    return fp.Problem(**{**values, **changes})


@pytest.mark.parametrize("gain", [0.3, 0.6, 1.0])
def test_the_limit_is_that_of_the_theory(gain):
    """Sampled: slope < 1 + (2 - a) (1 + rho) / (a (1 - rho)); 2 % below the shift settles, 2 % above it grows."""
    decay = np.exp(-4.0 / 5.0)
    limit = 1 + (2 - gain) * (1 + decay) / (gain * (1 - decay))
    for share, settles in ((0.98, True), (1.02, False)):
        run = fp.simulate(linear(share * limit), fp.Cascade(STATIC, affine(gain), LAGGED), seed=1, compiled=False)
        early, late = (np.abs(run["error.y"][k : k + 40]).max(initial=0.0) for k in (40, 360))
        late = np.inf if run.stop else late  # it ran away
        assert bool(late < early) is settles, (share, early, late)


def test_a_target_out_of_reach_does_not_wind_the_shift_up():
    """The reference is beyond the limit of the valve for 800 s; afterwards the output is as near as if it had never been."""

    def reference(t: Any) -> dict[str, Any]:
        return {"y": ca.if_else(ca.logic_and(t > 400, t < 1200), 3.0, 1.0)}

    limited = linear(0.7, limits=fp.Limits(inputs={"u": (0.0, 2.0)}), reference=fp.Trajectory(reference))
    run = fp.simulate(limited, fp.Cascade(STATIC, affine(0.5), LAGGED), seed=1, compiled=False)
    out = (run.time > 500) & (run.time < 1200)
    assert run["state.y"][out] == pytest.approx(1.4, abs=1e-3)
    assert np.abs(run["shift"]).max() < 2.0
    assert np.abs(run["error.y"][run.time > 1320]).max() < 1e-2


def test_without_adaptation_it_is_what_it_is_around():
    wrapped = fp.ExactModel(fp.Cascade(STATIC, affine(0.4), None)).with_deformation(fp.Identity())
    assert wrapped.controller is STATIC


# A cascade on outputs that are expressions of the state, and its way back from a limit
LAW = fp.ComputedTorque(fp.Exponential(rate=1.0))


@pytest.mark.parametrize("inner", ["computed torque", "receding horizon"])
def test_a_cascade_around_a_controller_of_an_output_takes_its_error_away(inner: str) -> None:
    """The depth of a patient with a wrong curve: a law and a plan leave errors that a shifted target lowers."""
    problem, controller = {
        "computed torque": (sedated(hill(5.5)), LAW),
        "receding horizon": (planned(), fp.RecedingHorizon(OPTIMISER)),
    }[inner]
    cascade = fp.Cascade(controller, affine(0.3), lag=1.0)
    errors = [fp.measure(problem, simulated(problem, c)).rms_error["depth"] for c in (controller, cascade)]
    assert errors[1] < 0.75 * errors[0]


def test_plans_along_a_target_are_none_along_the_reference():
    """Nobody who asks for the plans of the problem's horizon is shown them; around other wrappers they are the same."""
    plan = fp.RecedingHorizon(OPTIMISER)
    assert (fp.Cascade(plan, affine(0.5), None).planner, fp.Predicted(plan, inputs=0.0).planner) == (None, plan.planner)


# Outputs of order 0: an iteration on targets makes up for a wrong static map
AT_ONCE = 0.0
COLD, WARMER = 20.0, 4e-3  # Ohm, 1/K
HEAT, LOSS = 50.0, 2.0  # J/K, W/K


def resistance(x: Any, p: Any) -> Any:
    return p.cold * (1 + p.warmer * x.theta)


def element(cold: float = 14.0, warmer: float = 0.0, **settings: Any) -> fp.Plant:
    """The heating element, with what the model believes of its resistance."""
    return fp.Plant.of_states(
        states={"theta": "K"},
        inputs={"u": "V"},
        parameters={
            "cold": fp.Parameter(approximate=cold, exact=COLD, unit="Ohm"),
            "warmer": fp.Parameter(approximate=warmer, exact=WARMER, unit="1/K"),
        },
        rates=lambda x, u, p: {"theta": (u.u**2 / resistance(x, p) - LOSS * x.theta) / HEAT},
        outputs={"power": fp.Output("W", lambda x, u, p: u.u**2 / resistance(x, p))},
        **{"inverse": lambda x, r, p: {"u": ca.sqrt(r.power * resistance(x, p))}, **settings},
    )


def heated(plant: fp.Plant, **settings: Any) -> fp.Problem:
    """A power that swings, from a cold start."""
    values: dict[str, Any] = {
        "reference": fp.Trajectory(lambda t: {"power": 200 + 60 * ca.sin(t / 5)}),
        "start": {"theta": 10.0},
        "input_before": {"u": 60.0},
        "period": 0.1,
        "duration": 40.0,
        "measure_from": 5.0,
    }
    return fp.Problem(plant=plant, **{**values, **settings})


def rms(problem: fp.Problem, controller: Controller) -> float:
    return float(fp.measure(problem, simulated(problem, controller)).rms_error["power"])


def test_the_order_is_found_from_the_symbols() -> None:
    plant = element()
    assert plant.equations.output_orders == {"power": 0}
    assert "power of relative order 0" in repr(plant)
    named_only = fp.Plant.of_states(
        states={"a": "m"}, inputs={"u": "1"}, parameters={}, rates=lambda x, u, p: {"a": u.u},
        outputs={"y": fp.Output("m", lambda x, u, p: 2 * x.a + 0 * u.u)},
    )  # fmt: skip
    assert named_only.equations.output_orders == {"y": 1}
    assert set(named_only.chains.values()) == {1}


def test_response_and_nominal_response_are_the_output_itself() -> None:
    """Logged: the measured power under the last voltage, and the reference at the end of the cycle."""
    problem = heated(element())
    run = simulated(problem, STATIC)
    assert run.layout["realised"].entry_units == ("W",)
    assert np.array_equal(run["realised"], run["output"])
    ohms = COLD * (1 + WARMER * run["state.theta"])
    assert run["output.power"][1:] == pytest.approx(run["command.u"][:-1] ** 2 / ohms[1:], rel=1e-12)
    assert run["desired.power"][:-1] == pytest.approx(run["reference.power"][1:], rel=1e-12)
    assert run["command.u"] == pytest.approx(np.sqrt(14.0 * run["desired.power"]), rel=1e-12)


def test_a_wrong_static_map_is_made_up_for() -> None:
    """Without iteration a quarter of the power is missing; with it the error is that of one cycle, whatever the gain."""
    problem = heated(element())
    without = rms(problem, STATIC)
    assert without > 50
    for gain in (0.3, 0.6, 1.0):
        assert rms(problem, fp.Cascade(STATIC, affine(gain), AT_ONCE)) < 0.06 * without, gain
        assert rms(problem, fp.Cascade(STATIC, affine(gain), lag=None)) < 0.06 * without, gain


# Plans

SOLVED = fp.FixedPointSolver(iterations=20, tolerance=1e-10)
WEIGHT = 0.02  # of the rate of the voltage


def planned_power(**settings: Any) -> fp.Problem:
    """Eight stages of one cycle."""
    cost = fp.Quadratic(outputs={"power": 1.0}, rate={"u": WEIGHT})
    return heated(element(), **{"horizon": fp.Horizon(stages=8, step=0.1), "cost": cost, "duration": 10.0, **settings})


def plan_by_hand(time: float, before: float, distance: float) -> float:
    """First voltage of the plan: the model's powers less the reference and their distance, and the steps, squared and summed."""
    times = time + 0.1 * np.arange(8)
    wanted = 200 + 60 * np.sin(times / 5) - distance

    def residuals(voltages: np.ndarray) -> np.ndarray:
        powers = voltages**2 / 14.0  # the model's element does not warm up
        steps = np.diff(voltages, prepend=before)
        return np.concatenate([powers - wanted, np.sqrt(WEIGHT) * steps])

    return float(least_squares(residuals, np.full(8, before), xtol=1e-15, ftol=1e-15, gtol=1e-15).x[0])


def test_a_plan_on_an_output_of_order_zero_is_the_minimum_by_hand() -> None:
    """Cycle by cycle from the measured distance y - h(x, u) under the last voltage, which the reference is laid away by."""
    run = simulated(planned_power(), fp.RecedingHorizon(SOLVED))
    for k in (1, 2, 40):
        before = run["command.u"][k - 1]
        distance = run["output.power"][k] - before**2 / 14.0
        by_hand = plan_by_hand(0.1 * k, before, distance)
        assert run["planned.u"][k] == pytest.approx(by_hand, abs=1e-6)
        assert run["command.u"][k] == pytest.approx(by_hand, abs=1e-6)


def test_the_integral_of_order_zero_removes_a_constant_error() -> None:
    """The law is y^N + rate e_int with measured errors: e_{k+1} = e_k - J rate T e_{k-1}."""
    problem = heated(element(), reference=fp.Trajectory(lambda t: {"power": 200.0 + 0 * t}), start={"theta": 100.0})
    still = replace(element(), response=lambda x, u, p: {"theta": 0 * u.u}, inverse=element().inverse)
    problem = replace(problem, plant=still)
    run = simulated(problem, fp.ComputedTorque(fp.Exponential(rate=0.5, bumpless=False)))
    share, error = 14.0 / (COLD * (1 + WARMER * 100.0)), run["error.power"]
    assert error[3:60] == pytest.approx(error[2:59] - 0.5 * 0.1 * share * error[1:58], abs=1e-9)


# Learners: offset-free control, and disturbances of outputs and responses
STATES = {"C": 0.01, "E": 0.01}
SLOW = {"C": 1e-3, "E": 1e-3}
ANSWER = fp.DisturbanceKalman({"depth''": 100.0}, {"depth''": 0.1, **STATES}, noise=SLOW)
SHIFT = fp.DisturbanceKalman({"depth": 1.0}, {"depth": 0.01, **STATES}, noise=SLOW)
PLAN = fp.RecedingHorizon(fp.FixedPointSolver(iterations=3, tolerance=1e-2))


def test_the_filter_on_the_hand_of_an_arm_is_the_recursion_by_hand() -> None:
    """Angles, hand and the hand's acceleration are measured; a joint and the hand's acceleration are disturbed."""
    drift, noise = {"a": 2.0, "x''": 3.0}, {"b": 0.1}
    measured = {"a": 0.01, "b": 0.01, "x": 0.02, "y'": 0.05, "x''": 0.5}
    problem = replace(circle(arm()), duration=0.3, measure_from=0.0)
    filter = fp.DisturbanceKalman(drift, measured, noise)
    run = simulated(problem, fp.Estimating(fp.ComputedTorque(fp.Exponential(6.0)), filter))

    plant, mass, period = problem.plant, 1.4, problem.period
    rate = plant.equations.forced_rate

    def moved(x: np.ndarray, u: np.ndarray, w: np.ndarray) -> np.ndarray:
        def f(s: np.ndarray) -> np.ndarray:
            return rate(s, u, [mass], w).full().ravel()

        k1 = f(x)
        k2 = f(x + period / 2 * k1)
        k3 = f(x + period / 2 * k2)
        return x + period / 6 * (k1 + 2 * k2 + 2 * k3 + f(x + period * k3))

    def shown(x: np.ndarray, u: np.ndarray, w: np.ndarray) -> np.ndarray:
        """The second w adds to the hand's acceleration alone."""
        forcing = np.array([w[0], 0.0])
        y = plant.equations.output(x, u, [mass], forcing).full().ravel()
        step = 1e-4  # of a central difference of the hand's speed along the motion
        xdot = rate(x, u, [mass], forcing).full().ravel()
        ends = tuple(plant.equations.output(x + s * step * xdot, u, [mass], forcing).full().ravel()[2] for s in (1, -1))
        back = (ends[0] - ends[1]) / (2 * step)
        return np.array([x[0], x[1], y[0], y[3], back + w[1]])

    def slopes(of: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> np.ndarray:
        return np.column_stack([(of(at + e) - of(at - e)) / 2e-5 for e in 1e-5 * np.eye(at.size)])

    # The operating point: the reference at t = 0 and the input that the model needs for its response there.
    first = problem.start_state
    response = np.asarray(problem.reference.function(plant)(0.0)[1].full()).ravel()
    u0 = plant.equations.inverse(first, response, [mass]).full().ravel()
    a_x = slopes(lambda x: moved(x, u0, np.zeros(2)), first)
    b_w = slopes(lambda w: moved(first, u0, w), np.zeros(2))
    a = np.block([[a_x, b_w[:, :1], np.zeros((4, 1))], [np.zeros((2, 4)), np.eye(2)]])
    c = np.hstack(
        [slopes(lambda x: shown(x, u0, np.zeros(2)), first), slopes(lambda w: shown(first, u0, w), np.zeros(2))]
    )
    q = scipy.linalg.block_diag(np.outer(b_w[:, 1], b_w[:, 1]) * 0.1**2, np.diag([period * 4.0, period * 9.0]))
    r = np.diag(np.array(list(measured.values())) ** 2)
    p = scipy.linalg.solve_discrete_are(a.T, c.T, q, r)
    gain = p @ c.T @ np.linalg.inv(c @ p @ c.T + r)

    x, w = run["state"][0], np.zeros(2)
    for k in range(1, run.cycles):
        u = run["command"][k - 1]
        ahead = moved(x, u, np.array([w[0], 0.0]))
        seen = np.array([*run["state"][k][:2], run["output.x"][k], run["output.y'"][k], run["realised.x"][k]])
        z = np.concatenate([ahead, w]) + gain @ (seen - shown(ahead, u, w))
        x, w = z[:4], z[4:]
        assert np.allclose(run["estimate"][k], w, rtol=1e-3, atol=1e-4)
    assert np.ptp(run["estimate"], axis=0).min() > 0.05


def test_a_disturbance_of_an_output_is_the_distance_of_the_curves() -> None:
    """At rest the estimate is the measured depth less that of the model."""
    problem = sedated(hill(5.5))
    run = simulated(problem, fp.Estimating(LAW, SHIFT))
    model = problem.plant.equations.output(run["state"][-1], run["command"][-1], [5.5], np.zeros(2)).full().ravel()
    assert run["estimate.w_depth"][-1] == pytest.approx(run["output.depth"][-1] - model[0], rel=0.01)
    assert abs(run["estimate.w_depth"][-1]) > 5
    for inner in (LAW, PLAN):
        [note] = fp.Estimating(inner, SHIFT).notes(planned())
        assert note.endswith("w_depth, and the offset of an output is taken from the measurement; name states: C, E")
        assert fp.Estimating(inner, ANSWER).notes(planned()) == ()
    commands = [simulated(planned(), one)["command"] for one in (PLAN, fp.Estimating(PLAN, SHIFT))]
    assert commands[0] == pytest.approx(commands[1], rel=1e-6)


def estimating(inner: Controller, *numbers: Mapping[str, float]) -> Callable[[], object]:
    return lambda: simulated(sedated(hill(5.5)), fp.Estimating(inner, fp.DisturbanceKalman(*numbers)))


def around(deformation: Deformation, **settings: Any) -> Callable[[], object]:
    return lambda: simulated(linear(0.6), fp.Cascade(STATIC, deformation, **{"lag": LAGGED} | settings))


REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "wrong sign": (around(fp.Affine(gain=0.5)), "use the other sign"),
    "paired inside": (around(fp.Paired(affine(0.5), cycles=3)), "Paired pairs by itself"),
    "model-referenced inside": (around(fp.ModelReferenced(affine(0.5))), "already compares"),
    "no scale": (around(fp.Sigmoid(gain=-0.5)), "scale"),
    "two lags": (around(affine(0.5), lag=(5.0, 3.0)), "1 controlled coordinates"),
    "too late": (around(affine(0.5), dead_time=1e5), "more than 1000"),
    "adds up without feedback": (
        lambda: simulated(sedated(hill(5.5)), fp.Cascade(STATIC, affine(0.3), lag=1.0)),
        "FeedforwardOnly does not cover outputs",
    ),
    "estimator": (
        lambda: simulated(heated(element(), sensing=fp.Sensing(estimator=fp.PositionDifference())), STATIC),
        r"the command moves 'power' at once .* leave the estimator out",
    ),
    "terminal": (
        lambda: planned_power(cost=fp.Quadratic(outputs={"power": 1.0}, rate={"u": 1.0}, terminal={"power": 1.0})),
        "terminal: the command moves 'power' at once",
    ),
    "feedforward of order one": (
        lambda: simulated(
            heated(
                replace(element(), outputs={"hot": fp.Output("K", lambda x, p: x.theta**2)}, inverse=None),
                reference=fp.Trajectory(lambda t: {"hot": 100.0 + 0 * t}),
            ),
            STATIC,
        ),
        "hot.*: without feedback their errors would add up",
    ),
    "no state": (
        lambda: fp.Plant.of_states(
            states={}, inputs={"u": "1"}, parameters={}, rates=lambda x, u, p: {},
            outputs={"y": fp.Output("1", lambda x, u, p: u.u)},
        ),
        r"a static map y = h\(u\) may have one that stands still",
    ),
    "arguments": (
        lambda: replace(element(), outputs={"power": fp.Output("W", lambda x: x.theta)}),
        r"called as function\(x, p\), or as function\(x, u, p\)",
    ),
    "a measured name": (estimating(LAW, {"C": 1.0}, {"depth'''": 1.0}), "measured: state, output or response"),
    "a name": (estimating(LAW, {"deep": 1.0}, STATES), "mean 'depth'"),
    "too little": (estimating(LAW, {"C": 1.0, "E": 1.0, "depth": 1.0}, STATES), "need as many measured quantities"),
    "no use of the model": (estimating(fp.PID({"depth": -1.0}), {"C": 1.0}, STATES), "PID uses none of them"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_work_is_refused_with_the_remedy(name: str) -> None:
    make, words = REFUSED[name]
    with pytest.raises(fp.FpirhcError, match=words):
        make()
