"""Outputs y = h(x, p): what follows a reference may be an expression of the state, disturbed, late, and planned."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import tasks
from helpers.of_outputs import ARM, OPTIMISER, arm, circle, curve, hill, planned, sedated
from helpers.plants import simulated

import fpirhc as fp
from fpirhc.contracts import Deformation
from fpirhc.errors import NotSupported


def test_derivatives_of_outputs_are_those_of_the_motion() -> None:
    """y, y', y'' against differences of y along a simulated motion with the input held."""
    plant, h = arm(), 1e-3
    x, u, p, calm = np.array([0.4, 1.1, 0.7, -0.5]), np.array([0.3, -0.2]), plant.exact, np.zeros(2)
    back, ahead = (fp.RungeKutta4(substeps=4).step(plant, dt)(x, u, p, calm) for dt in (-h, h))
    before, now, after = (plant.equations.output(s, u, p, calm).full().ravel() for s in (back, x, ahead))
    assert plant.output.elements == ("x", "y", "x'", "y'")
    assert np.allclose(now[2:], (after - before)[:2] / (2 * h), atol=1e-6)
    response = plant.equations.controlled_response(x, u, p).full().ravel()
    assert np.allclose(response, (after - 2 * now + before)[:2] / h**2, atol=1e-5)
    assert np.allclose(plant.equations.inverse(x, response, p).full().ravel(), u)


def test_a_limit_of_an_output_is_kept_by_the_plan() -> None:
    low = fp.PathConstraint(lambda view: view.output.depth, lower=45.0, unit="1")
    problem = planned(limits=fp.Limits(inputs={"u": (0.0, 40.0)}, paths={"light": low}))
    run = simulated(problem, fp.ExactModel(fp.RecedingHorizon(OPTIMISER)))
    free = simulated(planned(), fp.ExactModel(fp.RecedingHorizon(OPTIMISER)))
    assert free["output.depth"].min() < 41
    assert run["output.depth"].min() > 44.9


def test_an_output_that_is_only_judged_is_measured_and_not_controlled() -> None:
    plant = hill(5.5)
    both = {**plant.outputs, "level": fp.Output("mg/l", lambda x, p: x.E)}
    plant = replace(plant, outputs=both, controlled=("depth",))
    first = sedated(hill(5.5))

    def motion(t: Any) -> dict[str, Any]:
        return {**first.reference.coordinates(t), "level": 4.0 + 0 * t}

    judged = replace(first, plant=plant, reference=fp.Trajectory(motion), judged=("depth", "level"))
    run = simulated(judged, fp.ComputedTorque(fp.Exponential(rate=1.0)))
    assert run.layout["desired"].elements == ("depth",)
    assert np.array_equal(run["true_error.level"], 4.0 - run["plant_state.E"])


# What is refused, and how


def double(outputs: dict[str, fp.Output], **settings: Any) -> fp.Plant:
    """Two integrators with some outputs."""
    usual: dict[str, Any] = {"states": {"a": "m", "b": "m/s"}, "inputs": {"u": "N"}, "parameters": {}}
    usual["rates"] = lambda x, u, p: {"a": x.b, "b": u.u}
    return fp.Plant.of_states(**usual | settings, outputs=outputs)


SQUARE = {"y": fp.Output("m^2", lambda x, p: x.a**2)}


def squared(motion: Callable[[Any], Any], **settings: Any) -> fp.Problem:
    """Y = a^2."""
    follows = fp.Trajectory(lambda t: {"y": motion(t)})
    return fp.Problem(double(SQUARE), follows, {"a": 1.0, "b": 0.0}, 1e-2, 4.0, **settings)


WRONG: dict[str, tuple[Callable[[], object], str]] = {
    "not reached": (lambda: double({"y": fp.Output("m", lambda x, p: 3.0 + 0 * x.a)}), "no input reaches 'y'"),
    "another expression": (lambda: double({"a": fp.Output("m", lambda x, p: 2 * x.a)}), "rename the output"),
    "arguments": (lambda: double({"y": fp.Output("m", lambda x: x.a)}), r"called as function\(x, p\)"),
    "name in it": (lambda: double({"y": fp.Output("m", lambda x, p: x.c)}), "state 'c' is unknown"),
    "controlled": (lambda: double(SQUARE, controlled=("z",)), "quantity 'z' is unknown. Valid: y"),
    "name of a state": (lambda: double(SQUARE, states={"a'": "m", "b": "m"}), "'a'' is not an identifier"),
    "name of an input": (lambda: double({"u": fp.Output("m", lambda x, p: x.a)}), "both an input and an output"),
    "no rate": (lambda: double(SQUARE, rates=lambda x, u, p: {"a": x.b}), "rates does not give the derivative b' of state 'b'"),
    "reference": (lambda: replace(squared(lambda t: 1 + 0 * t), reference=fp.Trajectory(lambda t: {"yy": t})), "mean 'y'"),
    "judged": (lambda: squared(lambda t: 1 + 0 * t, judged=("z",)), "judged: quantity 'z' is unknown"),
    "states in the cost": (lambda: squared(lambda t: 1 + 0 * t, cost=fp.Quadratic(states={"a": 1.0})), "have no reference"),
    "both in the cost": (
        lambda: replace(tasks.two_mass.problem, cost=fp.Quadratic(states={"q1": 1.0}, outputs={"q2": 1.0})),
        "states and outputs: both weigh errors",
    ),
    "reality": (lambda: replace(squared(lambda t: 1 + 0 * t), reality=fp.Reality(double({}))), "it has no 'y'"),
    "too few inputs": (
        lambda: double({**SQUARE, "b": fp.Output("m/s", lambda x, p: x.b)}).controlled_names, "cannot hold 2 outputs"
    ),
    "deviation": (
        lambda: simulated(
            planned(cost=fp.Quadratic(outputs={"depth": 1.0}, deviation={"u": 1e-3})), fp.RecedingHorizon(OPTIMISER)
        ),
        "needs the states C, E",
    ),
    "disturbance": (lambda: sedated(hill(4.0), disturbances={"deep": fp.Noise(1.0)}), "coordinate or output 'deep' is unknown"),
    "disturbance without a number": (
        lambda: sedated(hill(4.0), disturbances={"depth": fp.Formula(ca.sqrt)}), "not finite"
    ),
    "gains": (lambda: simulated(sedated(hill(5.5)), fp.PID({"deep": -1.0})), "controlled coordinate 'deep' is unknown"),
    "mechanics": (
        lambda: simulated(circle(arm()), fp.load_problem("planar_arm").controllers["AID"]), "mechanics in its own coordinates"
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", WRONG)
def test_a_mistake_is_named(mistake: str) -> None:
    make, words = WRONG[mistake]
    with pytest.raises(fp.FpirhcError, match=words):
        make()


# The three forms of the iteration, and a rival, are those of loops in numpy
FORMS: dict[str, Deformation] = {
    "plain": fp.Affine(-0.6),
    "increment": fp.Increment(fp.Affine(-0.6), cycles=0, uncertainty=0),
    "model-referenced": fp.ModelReferenced(fp.Affine(-0.6)),
}


def by_hand(problem: fp.Problem, form: str) -> tuple[np.ndarray, np.ndarray]:
    """Angles and torques of computed torque on the hand: J q'' + J' q' = r, by numpy alone."""
    l1, l2 = ARM.values()
    period, mass, believed = problem.period, 1.0, 1.4
    damping, inertia = np.array([0.2, 0.1]), np.array([1.0, 0.5])
    motion = problem.reference.function(problem.plant)

    def kinematics(q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        s1, c1, s12, c12 = np.sin(q[0]), np.cos(q[0]), np.sin(q.sum()), np.cos(q.sum())
        hand = np.array([l1 * c1 + l2 * c12, l1 * s1 + l2 * s12])
        jacobian = np.array([[-l1 * s1 - l2 * s12, -l2 * s12], [l1 * c1 + l2 * c12, l2 * c12]])
        w = v.sum()
        bias = np.array([-l1 * c1 * v[0] ** 2 - l2 * c12 * w**2, -l1 * s1 * v[0] ** 2 - l2 * s12 * w**2])
        return hand, jacobian @ v, jacobian, bias

    def rates(x: np.ndarray, torque: np.ndarray) -> np.ndarray:
        return np.concatenate([x[2:], (torque - damping * x[2:]) / (inertia * mass)])

    x, torque, request = problem.start_state.copy(), np.zeros(2), np.zeros(2)
    states, torques, delta, before = [], [], np.zeros(2), np.zeros(2)
    rate, share = 6.0, 0.3  # of the law, and the effective gain
    for k in range(problem.cycles):
        q, v = x[:2], x[2:]
        hand, speed, jacobian, bias = kinematics(q, v)
        nominal, wanted = (np.asarray(m.full()).ravel() for m in motion(k * period))
        error, slope = nominal[:2] - hand, nominal[2:] - speed
        desired = wanted + rate**2 * error + 2 * rate * slope
        measured = jacobian @ ((torque - damping * v) / (inertia * mass)) + bias
        modelled = jacobian @ ((torque - damping * v) / (inertia * believed)) + bias
        if k == 0:
            request = desired
        elif form == "plain":
            request = request - share * (measured - desired)
        elif form == "increment":
            request = desired + (request - before) - share * (measured - before)
        elif form == "model-referenced":
            asked = modelled - delta
            delta = delta - share * (measured - asked)
            request = desired + delta
        else:
            request = desired
        before = desired
        torque = inertia * believed * np.linalg.solve(jacobian, request - bias) + damping * v
        states.append(x)
        torques.append(torque)
        k1 = rates(x, torque)
        k2 = rates(x + period / 2 * k1, torque)
        k3 = rates(x + period / 2 * k2, torque)
        x = x + period / 6 * (k1 + 2 * k2 + 2 * k3 + rates(x + period * k3, torque))
    return np.array(states), np.array(torques)


@pytest.mark.parametrize("form", ["none", *FORMS])
def test_computed_torque_on_the_hand_is_inverse_kinematics_by_hand(form: str) -> None:
    problem = replace(circle(arm()), duration=1.0, measure_from=0.0)
    run = simulated(problem, fp.ComputedTorque(fp.Exponential(6.0, integral=False), FORMS.get(form, fp.Identity())))
    states, torques = by_hand(problem, form)
    assert np.abs(run["state"] - states).max() < 1e-12
    assert np.abs(run["command"] - torques).max() < 1e-10


def test_an_increment_by_hand_on_the_hand_of_an_arm() -> None:
    """The first request after a step of the model: its response to the last command plus the change, less its own drift."""
    problem = replace(circle(arm()), duration=0.1, measure_from=0.0)
    run = simulated(problem, fp.rivals.ResolvedAccelerationRate(rate=6.0))
    plant, k, p, size = problem.plant, 20, [1.4], 1e-6
    respond, x, u = plant.equations.controlled_response, run["state"][k], run["command"][k - 1]
    moved = plant.equations.rate(x, u, p).full().ravel()
    ends = [respond(x + s * size * moved, u, p).full().ravel() for s in (1, -1)]
    drift = (ends[0] - ends[1]) / (2 * size)
    change = run["desired"][k] - run["realised"][k]
    request = respond(x, u, p).full().ravel() + change - problem.period * drift
    assert np.allclose(run["command"][k], plant.equations.inverse(x, request, p).full().ravel(), atol=1e-6)


# Disturbances: y = h(x, p) + d(t) is what is measured, judged and followed
LAW = fp.Exponential(rate=1.0)
WAVE = fp.Formula(lambda t: 2.0 * ca.sin(2 * np.pi * 0.1 * t + 0.3))
FORMULA = fp.Formula(lambda t: 2.0 * ca.sin(0.2 * ca.pi * t + 0.3))


def with_clock(believed: float) -> fp.Plant:
    """The wave as a part of the output, by the plant's own clock."""
    plain = hill(believed)
    return fp.Plant.of_states(
        states={**plain.coordinates, "clock": "min"},
        inputs=plain.inputs,
        parameters=plain.parameters,
        rates=lambda x, u, p: {"C": u.u - x.C, "E": 0.5 * (x.C - x.E), "clock": 1.0 + 0 * x.C},
        outputs={"depth": fp.Output("1", lambda x, p: curve(x.E, p.half) + FORMULA.expression(x.clock))},
        time_unit="min",
    )


@pytest.mark.parametrize("wave", [WAVE, FORMULA])
@pytest.mark.parametrize("adaptive", [False, True])
def test_a_disturbed_output_is_the_output_with_the_disturbance_in_it(wave: Any, adaptive: bool) -> None:
    """A controller that knows the clock has the wave in its model; the other one sees it in what is measured."""
    plain = sedated(hill(4.0), disturbances={"depth": wave})
    clock = replace(plain, plant=with_clock(4.0), start={**plain.start, "clock": 0.0}, disturbances={})
    law = fp.ComputedTorque(LAW, fp.Affine(-1.0) if adaptive else fp.Identity())
    run, other = (simulated(p, law) for p in (plain, clock))
    assert np.allclose(run["output_disturbance.depth"], FORMULA.values(run.time, np.random.default_rng(0)), atol=1e-12)
    # At the same states both measure the same y, y' and, under the same command, the same y''.
    x = np.column_stack([run["plant_state"], run.time])
    u, p, calm = run["command"], [4.0], np.zeros(3)
    of = clock.plant.equations.output.map(run.cycles)
    y = np.asarray(of(x.T, u.T, np.tile(p, (run.cycles, 1)).T, np.tile(calm, (run.cycles, 1)).T).full()).T
    assert np.allclose(run["output"], y, atol=1e-9)
    second = clock.plant.equations.controlled_response.map(run.cycles - 1)
    r = np.asarray(second(x[1:].T, u[:-1].T, np.full((1, run.cycles - 1), 4.0)).full()).ravel()
    assert np.allclose(run["realised.depth"][1:], r, atol=1e-9)
    # The controller that does not know the wave follows nearly as well once it adapts.
    errors = [np.sqrt(np.mean(one["true_error.depth"][900:] ** 2)) for one in (run, other)]
    if adaptive:
        assert errors[0] < 0.01
    else:
        assert errors[0] > 0.1
        assert errors[1] < 0.005


# Behind dead time outputs are predicted with the state, and keep their distance from the model's
LATE = 0.2  # min, of the pump


def late(problem: fp.Problem, time: float = LATE) -> fp.Problem:
    return replace(problem, dead_time=fp.DeadTime(inputs={"u": time}))


def test_the_residual_of_an_output_is_the_forcing_that_makes_it_up() -> None:
    """Y = 3 x of a tank with a wrong leak: the residual of y'' acts on the state as a third of it, as if x had been measured."""

    def run_of(gain: float, time: float | None) -> fp.Run:
        leak, output = {"a": fp.Parameter(1.0, 2.0, "1")}, fp.Output("m", lambda q, v, p: gain * q.x)
        plant = fp.Plant({"x": "m"}, {"u": "N"}, leak, lambda q, v, u, p: {"x": u.u - p.a * q.x}, outputs={"y": output})
        waved, late = fp.Trajectory(lambda t: {"y": gain * ca.sin(t)}), fp.DeadTime(inputs={"u": 0.1})
        problem = fp.Problem(plant, waved, {"x": 0.0, "x'": 1.0}, 0.02, 6.0, measure_from=4.0, dead_time=late)
        return simulated(problem, fp.Predicted(fp.ComputedTorque(LAW), inputs=0.1, residual_time=time))

    runs = [run_of(1.0, 0.5), run_of(3.0, 0.5), run_of(1.0, None)]
    for signal in ("command", "state_ahead"):
        assert runs[1][signal] == pytest.approx(runs[0][signal], rel=1e-6, abs=1e-9)
    missed = [np.abs(run["state_ahead"][200:-5] - run["plant_state"][205:]).max() for run in runs]
    assert missed[0] < 0.5 * missed[2]


def test_outputs_ahead_of_a_right_model_are_those_that_come() -> None:
    """With the exact model, ahead is what is measured later, to the error of the integrator."""
    problem = late(sedated(hill(4.0)))
    run = simulated(problem, fp.Predicted(fp.ComputedTorque(LAW), inputs=LATE))
    cycles = round(LATE / problem.period)
    assert np.allclose(run["output_ahead"][:-cycles], run["output"][cycles:], atol=1e-6)
    assert np.abs(run["output_ahead"] - run["output"]).max() > 0.5


def test_the_distance_of_a_wrong_model_moves_as_a_polynomial() -> None:
    """Ahead is what the model has at the state ahead, and d + d' tau; d and d' are what is measured less the model's."""
    run = simulated(late(sedated(hill(5.5))), fp.Predicted(fp.ComputedTorque(LAW), inputs=LATE))

    def model(state: np.ndarray) -> np.ndarray:
        level, size = state[:, 1], 1e-6
        slope = (curve(level + size, 5.5) - curve(level - size, 5.5)) / (2 * size)
        return np.column_stack([curve(level, 5.5), slope * 0.5 * (state[:, 0] - level)])

    distance = run["output"] - model(run["state"])
    moved = np.column_stack([distance[:, 0] + LATE * distance[:, 1], distance[:, 1]])
    np.testing.assert_allclose(run["output_ahead"], model(run["state_ahead"]) + moved, atol=1e-6)
    assert np.abs(LATE * distance[:, 1]).max() > 0.1


def test_what_is_not_covered_says_so() -> None:
    desired = fp.Predicted(fp.ComputedTorque(LAW), inputs=LATE, by="desired")
    with pytest.raises(NotSupported, match=r"does not predict C, E, which no desired response moves; use by='model'"):
        simulated(late(planned()), desired)


# Plans that start where the model has the measured outputs keep the limits of the measured state
ADAPTIVE = fp.ModelReferenced(fp.Affine(-1.6))
SOLVED = fp.FixedPointSolver(iterations=20, tolerance=1e-4)  # V


def servo(believed: float, **settings: Any) -> fp.Problem:
    """A servo, angle' = a speed, speed' = 4 b (u - speed): a move at a speed of at most 1 rad/s; the model has a and b wrong."""
    parameters = {"a": fp.Parameter(believed, 1.0, "1"), "b": fp.Parameter(1.3, 1.0, "1/s")}
    rates = lambda x, u, p: {"angle": p.a * x.speed, "speed": 4 * p.b * (u.u - x.speed)}  # noqa: E731 -- of the states
    shown = {"outputs": {"y": fp.Output("rad", lambda x, p: x.angle)}, "rates": rates, "parameters": parameters}
    plant = fp.Plant.of_states(states={"angle": "rad", "speed": "rad/s"}, inputs={"u": "V"}, **shown)
    limits: dict[str, Any] = {"inputs": {"u": (-3.0, 3.0)}, "states": {"speed": (-1.0, 1.0)}, **settings}
    planned: dict[str, Any] = {"cost": fp.Quadratic(outputs={"y": 1.0}, rate={"u": 1e-4}), "period": 0.02}
    planned |= {"horizon": fp.Horizon(stages=20, step=0.1), "duration": 4.0, "limits": fp.Limits(**limits)}
    moved = fp.Trajectory(lambda t: {"y": 2 / (1 + ca.exp(-4 * (t - 2)))})
    return fp.Problem(plant, moved, {"angle": 0.0, "speed": 0.0}, **planned)


@pytest.mark.parametrize(("believed", "most"), [(0.7, 1.02), (1.4, 1.2)])
def test_limits_of_states_behind_outputs_hold_for_the_measured_state(believed: float, most: float) -> None:
    """At x* the model's speed is a / a^ times the measured one: bound there, it may be 1.4 rad/s, or not more than .7."""
    problem, controller = servo(believed), fp.RecedingHorizon(SOLVED, ADAPTIVE)
    run = simulated(problem, controller)
    assert 0.98 < np.abs(run["state.speed"]).max() < most
    assert run["status"].max() == 0
    free = simulated(servo(believed, states={}), controller)
    assert np.abs(free["state.speed"]).max() > 1.5


def test_behind_an_estimator_a_right_model_is_left_alone_by_plans_from_the_given_state() -> None:
    """And not by those from the estimated outputs, of which a note says so."""
    problem = replace(servo(1.3, states={}), sensing=fp.Sensing(estimator=fp.SavitzkyGolay(window=15, degree=2)))
    right = problem.with_exact(problem.plant.approximate)
    plain, usual = fp.RecedingHorizon(SOLVED), fp.RecedingHorizon(SOLVED, ADAPTIVE)
    given = fp.RecedingHorizon(SOLVED, ADAPTIVE, consistent=False)
    errors = [fp.measure(right, simulated(right, one)).rms_error["y"] for one in (plain, given, usual)]
    assert errors[1] == pytest.approx(errors[0], rel=1e-6)
    assert errors[2] > 1.5 * errors[0]
    assert [len(one.notes(problem)) for one in (plain, given, usual)] == [0, 0, 1]
    assert "consistent=False" in usual.notes(problem)[0]
    assert usual.notes(replace(problem, sensing=fp.Sensing())) == ()
