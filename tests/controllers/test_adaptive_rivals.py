"""Controllers that learn: the classical rules, what projection and a deformation add, and learning behind dead time."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.plants import pendulum

import fpirhc as fp
from fpirhc.errors import InvalidValue, NotSupported

FREE = (-np.inf, np.inf)


# A mass on a hardening spring: four parameters, one coordinate.


def hardening(exact=(1.0, 0.5, 20.0, 3.0), believed=(1.5, 0.0, 12.0, 0.0)):
    units = {"m": "kg", "b": "N s/m", "k": "N/m", "c": "N/m^3"}
    values = zip(units, believed, exact, units.values(), strict=True)
    return fp.Plant(
        coordinates={"q": "m"},
        inputs={"u": "N"},
        parameters={n: fp.Parameter(float(a), float(e), unit) for n, a, e, unit in values},
        response=lambda q, v, u, p: {"q": (u.u - p.b * v.q - p.k * q.q - p.c * q.q**3) / p.m},
    )


BOX = {"m": (0.1, 40.1), "b": (-20.0, 20.0), "k": (-10.0, 30.0), "c": (-20.0, 20.0)}  # equal widths: no scaling
TRACKING = fp.Exponential(rate=4.0)
ADAPTATION = fp.LyapunovRule({"m": 1e2, "b": 1e3, "k": 1e4, "c": 1e4})
GENTLE = fp.LyapunovRule({"m": 1.0, "b": 10.0, "k": 100.0, "c": 100.0})
AID = fp.rivals.AdaptiveInverseDynamics(TRACKING, ADAPTATION, BOX)
NLMS = fp.rivals.AdaptiveInverseDynamics(TRACKING, fp.Projection(gain=0.02), BOX)


def rich(t):
    """Two frequencies: enough for four parameters."""
    return {"q": 0.6 * ca.sin(2 * t) + 0.4 * ca.sin(3.3 * t)}


def poor(t):
    """One frequency."""
    return {"q": ca.sin(2 * t)}


def task(motion=poor, duration=20.0, **plant):
    speed = {poor: 2.0, rich: 2.52}.get(motion, 0.0)
    reference = fp.Trajectory(motion)
    return fp.Problem(hardening(**plant), reference, {"q": 0.0, "q'": speed}, period=1e-3, duration=duration)


@cache
def ran(controller, motion=poor, duration=20.0):
    run = fp.simulate(task(motion, duration), CONTROLLERS[controller], seed=0, compiled=False)
    assert run.stop is None
    return run


CONTROLLERS = {
    "CT": fp.ComputedTorque(TRACKING),
    "AID": AID,
    "NLMS": NLMS,
    "NLMS+FPI": replace(NLMS, deformation=fp.Sigmoid(gain=-1.0, scale=50.0)),
    "Slotine-Li": fp.rivals.SlotineLi(4.0, {"q": 8.0}, GENTLE, dict.fromkeys(BOX, FREE)),
}


def largest(run, begin, end):
    """Largest error of q between two times, in seconds."""
    return float(np.abs(run["error"][round(1000 * begin) : round(1000 * end)]).max())


@pytest.mark.parametrize("name", ["AID", "NLMS", "NLMS+FPI", "Slotine-Li"])
@pytest.mark.parametrize("motion", [poor, rich])
def test_learning_ends_the_tracking_error(name, motion):
    """Without learning 0.15 to 0.17 m for ever; with it less than a tenth of that in the last 5 s, excited or not."""
    assert largest(ran("CT", motion), 15, 20) > 0.14
    assert largest(ran(name, motion), 15, 20) < 0.01
    assert (CONTROLLERS[name].learns, CONTROLLERS["CT"].learns) == (True, False)


# The two-link arm of the book.


def book(believed):
    def response(q, v, u, p):
        c, s = ca.cos(q.q2), ca.sin(q.q2)
        h11, h12, h22 = p.a1 + 2 * p.a3 * c + 2 * p.a4 * s, p.a2 + p.a3 * c + p.a4 * s, p.a2
        h = p.a3 * s - p.a4 * c
        r1, r2 = u.t1 + h * v.q2 * (2 * v.q1 + v.q2), u.t2 - h * v.q1**2
        d = h11 * h22 - h12**2
        return {"q1": (h22 * r1 - h12 * r2) / d, "q2": (h11 * r2 - h12 * r1) / d}

    values = zip(believed, (3.34, 0.97, 1.0392, 0.6), strict=True)
    parameters = {f"a{k}": fp.Parameter(a, e, "kg m^2") for k, (a, e) in enumerate(values, 1)}
    plant = fp.Plant({"q1": "rad", "q2": "rad"}, {"t1": "N m", "t2": "N m"}, parameters, response)

    def motion(t):
        swing = 1 - ca.cos(2 * ca.pi * t)
        return {"q1": ca.pi / 6 * swing, "q2": ca.pi / 4 * swing}

    return fp.Problem(plant, fp.Trajectory(motion), {"q1": 0, "q2": 0}, period=1e-3, duration=3.0)


BOOK_RULE = fp.LyapunovRule({"a1": 0.03, "a2": 0.05, "a3": 0.1, "a4": 0.3})
BOOK = fp.rivals.SlotineLi(20.0, {"q1": 100.0, "q2": 100.0}, BOOK_RULE, dict.fromkeys(BOOK_RULE.gains, FREE))
NOTHING = (0.02, 0.01, 0.0, 0.0)


def test_slotine_li_as_in_the_book():
    """Slotine and Li (1991), section 9.2, gains and motion, starting from (almost) no knowledge."""
    run = fp.simulate(book(NOTHING), BOOK, seed=0, compiled=False)
    degrees = np.degrees(np.abs(run["error"]))
    np.testing.assert_allclose(degrees[:1000].max(axis=0), [3.27, 1.29], rtol=0.03)
    np.testing.assert_allclose(degrees[2000:].max(axis=0), [0.45, 0.23], rtol=0.04)
    np.testing.assert_allclose(run["estimate"][-1], [0.174, 0.663, 1.759, 1.329], atol=0.03)
    known = fp.simulate(book((3.34, 0.97, 1.0392, 0.6)), BOOK, seed=0, compiled=False)
    assert np.degrees(np.abs(known["error"])).max() < 0.02


def test_slotine_li_and_its_demand_are_one_law():
    """M_hat v' + C_hat v + ... + K_D rho is what the model needs for d = v' + M_hat^-1 (C_hat + K_D) rho, at any state."""
    problem = book((3.2, 1.2, 0.7, 0.7))
    box = {"a1": (3.0, 4.0), "a2": (1.0, 1.6), "a3": (0.4, 0.9), "a4": (0.5, 0.9)}
    plain = replace(BOOK, bounds=box)
    # In the first cycle there is no pair, so that a deformation passes what is desired.
    controllers = plain, replace(plain, deformation=fp.Affine(gain=-0.5))
    steps = [fp.Stepper(problem, c, compiled=False) for c in controllers]
    random = np.random.default_rng(0)
    for _ in range(5):
        state = random.standard_normal(4)
        direct, demanded = (step.step(0.3, state, np.zeros(2), step.start())[0] for step in steps)
        np.testing.assert_allclose(demanded, direct, rtol=1e-10)


@pytest.mark.parametrize("gain", [0.1, 1.0, 1.9])
@pytest.mark.parametrize("widths", [(1.0, 1.0, 1.0, 1.0), (1.0, 10.0, 0.1, 5.0)])
def test_projection_shrinks_the_parameter_error(gain, widths):
    """|W^(-1/2) (p - p_hat)| falls at every step on exact data, whatever they are; to a tenth in 200 random steps."""
    random, bounds = np.random.default_rng(3), {f"p{k}": (-w / 2, w / 2) for k, w in enumerate(widths)}
    change = rule_step(fp.Projection(gain), bounds, rows=2)
    exact, estimate = random.uniform(-0.5, 0.5, 4) * widths, np.zeros(4)
    errors = [np.linalg.norm((exact - estimate) / widths)]
    for k in range(200):
        matrix = random.standard_normal((2, 4)) / widths if k % 10 else np.zeros((2, 4))
        estimate = estimate + change(matrix, matrix @ (exact - estimate)).full().ravel()
        errors.append(np.linalg.norm((exact - estimate) / widths))
    assert np.diff(errors).max() <= 1e-12
    assert errors[-1] < 0.1 * errors[0]


def test_dead_zone_ends_learning():
    """Below it nothing moves; beyond it the step grows from zero."""
    bounds = {"p0": (0.0, 1.0), "p1": (0.0, 1.0)}
    change = rule_step(fp.Projection(0.5, dead_zone=2.0), bounds, rows=1)
    matrix = np.array([[1.0, 2.0]])
    assert np.all(change(matrix, 1.99).full() == 0)
    full = rule_step(fp.Projection(0.5), bounds, rows=1)(matrix, 4.0).full()
    np.testing.assert_allclose(change(matrix, 4.0).full(), 0.5 * full, rtol=1e-9)


def rule_step(rule, bounds, rows):
    matrix, error = ca.SX.sym("G", rows, len(bounds)), ca.SX.sym("h", rows)
    evidence: Any = SimpleNamespace(equation=lambda: (matrix, error))  # all that the rule asks for
    return ca.Function("rule", [matrix, error], [rule.change(evidence, bounds, 1e-3)])


def test_mass_matrix_stays_positive_definite():
    """At every cycle of a run that drives estimates into their bounds, on a plant whose load is dropped."""
    problem = replace(fp.load_problem("planar_arm").problem, duration=1.5, measure_from=0.0)
    controllers: Any = fp.load_problem("planar_arm").controllers
    wild = replace(controllers["AID"], rule=fp.Projection(gain=1.9))
    run = fp.simulate(problem, wild, seed=0, compiled=False)
    ends = np.array(list(wild.bounds.values()))
    assert np.all((run["estimate"] >= ends[:, 0]) & (run["estimate"] <= ends[:, 1]))
    assert np.any((run["estimate"] == ends[:, 0]) | (run["estimate"] == ends[:, 1]))
    places = [problem.plant.parameter.elements.index(name) for name in wild.bounds]
    response, inputs = problem.plant.equations.response, np.eye(problem.plant.input.size)
    for k in range(0, run.cycles, 50):
        values = problem.plant.approximate.copy()
        values[places] = run["estimate"][k]
        rest, *moved = (response(run["state"][k], u, values).full()[:, 0] for u in (0 * inputs[0], *inputs))
        gain = np.array(moved).T - rest[:, None]  # the inverse of the mass matrix
        assert np.linalg.eigvalsh(0.5 * (gain + gain.T))[0] > 0


def test_while_the_command_is_clipped_a_gradient_waits_and_a_projection_learns():
    """The gradient assumes that the plant got the command; the projection knows the one that acted."""
    problem = replace(task(rich, 3.0), limits=fp.Limits(inputs={"u": (-8.0, 8.0)}))
    waits, run = (fp.simulate(problem, one, seed=0, compiled=False) for one in (AID, NLMS))
    clipped, changes = waits["clipped"][:-1, 0] > 0, np.abs(np.diff(waits["estimate"], axis=0)).max(axis=1)
    assert changes[clipped].max() == 0 < changes[~clipped].min()
    assert run["clipped"].mean() > 0.2
    exact = np.array([1.0, 0.5, 20.0, 3.0])
    errors = np.linalg.norm(exact - run["estimate"], axis=1)
    assert np.diff(errors).max() < 1e-9
    assert errors[-1] < 0.9 * errors[0]


# What does not fit is refused before the run.


def crossed():
    """The input named first pushes the second mass, which is three times as heavy."""
    return fp.Plant(
        coordinates={"x": "m", "y": "m"},
        inputs={"u": "N", "w": "N"},
        parameters={"m": fp.Parameter(1.0, 1.0, "kg")},
        response=lambda q, v, u, p: {"x": u.w / p.m, "y": u.u / (3 * p.m)},
    )


REFUSED = {
    "bounds that admit an indefinite mass matrix": (
        book((3.2, 1.2, 0.7, 0.7)),
        replace(BOOK, rule=fp.Projection(0.1), bounds={f"a{k}": (-5.0, 5.0) for k in range(1, 5)}),
        InvalidValue,
        "not positive definite.*at a1 = ",
    ),
    "an error that dead time makes late": (
        replace(task(), dead_time=fp.DeadTime(inputs={"u": 0.01})),
        AID,
        NotSupported,
        "use rule=Projection",
    ),
    "infinite bounds where M is inverted": (
        task(),
        replace(AID, bounds=BOX | {"m": FREE}),
        InvalidValue,
        "'m' enters the mass",
    ),
    "a first estimate outside": (
        task(),
        replace(AID, bounds=BOX | {"k": (20.0, 30.0)}),
        InvalidValue,
        "'k', 12 by.*outside",
    ),
    "not fully actuated": (
        "cart_pole",
        replace(AID, bounds={"m": (0.1, 1.0)}, rule=fp.Projection(0.1)),
        NotSupported,
        "fully actuated",
    ),
    "inputs that work along the other coordinate": (
        fp.Problem(crossed(), fp.Trajectory(lambda t: {"x": t, "y": t}), {"x": 0, "y": 0}, period=1e-3, duration=1.0),
        fp.rivals.SlotineLi(1.0, {"x": 1.0, "y": 1.0}, fp.Projection(0.1), {"m": (0.1, 2.0)}),
        NotSupported,
        "not symmetric",
    ),
    "nonlinear parameters": (
        fp.Problem(pendulum(), fp.Trajectory(lambda t: {"angle": t}), {"angle": 0}, period=1e-3, duration=1.0),
        replace(AID, bounds={"m": (0.1, 2.0), "l": (0.1, 2.0)}, rule=fp.Projection(0.1)),
        InvalidValue,
        "'l' enter.* nonlinearly",
    ),
}


@pytest.mark.parametrize("why", REFUSED)
def test_what_does_not_fit_is_refused_before_the_run(why):
    problem, controller, error, reason = REFUSED[why]
    shipped = fp.load_problem(problem).problem if isinstance(problem, str) else problem
    with pytest.raises(error, match=reason):
        fp.simulate(shipped, controller, seed=0, compiled=False)


@pytest.mark.parametrize("names", ["mbkc", "bk"])
@pytest.mark.parametrize("late", [{"measurement": 0.01}, {"inputs": {"u": 0.01}}])
def test_a_right_model_learns_nothing_behind_dead_time(late, names):
    """A late response belongs to the state that was measured with it and to the command that acted then."""
    right = task(rich, 0.3, believed=(1.0, 0.5, 20.0, 3.0))
    learner = replace(NLMS, bounds={name: BOX[name] for name in names})  # what is not learned is taken as it is
    run = fp.simulate(replace(right, dead_time=fp.DeadTime(**late)), learner, seed=0, compiled=False)
    np.testing.assert_allclose(run["estimate"], run["estimate"][:1].repeat(run.cycles, axis=0), rtol=1e-12)
