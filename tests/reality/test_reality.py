"""A reality that is not the model: what moves, what the controller is given, and what "exact" then means."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.plants import linear, pendulum
from scipy.linalg import expm

import fpirhc as fp
from fpirhc.controllers.check import checked
from fpirhc.describe import describe
from fpirhc.errors import InvalidProblem, NotContractive, NotSupported
from fpirhc.sensing.base import response_names

TRACK = fp.Exponential(rate=6.0)
PERIOD = 1e-3  # s
TAU = 0.01  # s, lag of the actuator
FPI = fp.Sigmoid(gain=-0.5, scale=50.0)

CONTROLLERS = {
    "computed torque": fp.ComputedTorque(TRACK),
    "plain form": fp.ComputedTorque(TRACK, FPI),
    "model-referenced form": fp.ComputedTorque(TRACK, fp.ModelReferenced(FPI)),
    "receding horizon": fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-3), FPI),
}
SENSING: dict[str, dict[str, Any]] = {
    "ideal": {},
    "estimated": {"sensing": fp.Sensing(estimator=fp.PositionDifference())},
    "noisy": {"sensing": fp.Sensing(sensors={"y'": fp.Sensor(noise=fp.Noise(1e-4), dropout=0.1)})},
    "late": {"dead_time": fp.DeadTime(measurement=2.5 * PERIOD), "disturbances": {"y": fp.Sine(0.1, 2.0)}},
}


def parameters(gain: float = 2.0) -> dict[str, fp.Parameter]:
    """The gain of the linear plant; the model believes in 1."""
    return {"b": fp.Parameter(approximate=1.0, exact=gain, unit="1/kg")}


def lagged(tau: float = TAU, gain: float = 2.0) -> fp.Plant:
    """Y'' = b F behind an actuator, tau F' = u - F."""
    return fp.Plant(
        coordinates={"y": "m", "F": "N"},
        inputs={"u": "N"},
        order={"y": 2, "F": 1},
        parameters=parameters(gain) | {"tau": fp.Parameter(approximate=tau, exact=tau, unit="s")},
        response=lambda q, v, u, p: {"y": p.b * q.F, "F": (u.u - q.F) / p.tau},
    )


def slow_sensor(tau: float = TAU) -> fp.Plant:
    """Y'' = b u, measured through tau s' = y - s."""
    return fp.Plant(
        coordinates={"y": "m", "s": "m"},
        inputs={"u": "N"},
        order={"y": 2, "s": 1},
        parameters=parameters(),
        response=lambda q, v, u, p: {"y": p.b * u.u, "s": (q.y - q.s) / tau},
    )


def task(**changes) -> fp.Problem:
    """The linear plant along a sine."""
    settings: dict[str, Any] = {
        "plant": linear(2.0, 1.0),
        "reference": fp.Trajectory(lambda t: {"y": ca.sin(3 * t)}),
        "start": {"y": 0.1},
        "period": PERIOD,
        "duration": 0.3,
        "limits": fp.Limits(inputs={"u": (-50.0, 50.0)}),
        "horizon": fp.Horizon(stages=5, step=1e-2),
        "cost": fp.Quadratic(states={"y": 1e3, "y'": 1.0}, effort={"u": 1e-3}),
    }
    return fp.Problem(**{**settings, **changes})


def run(problem: fp.Problem, controller: Any = CONTROLLERS["computed torque"]) -> fp.Run:
    """A run in the virtual machine."""
    return fp.simulate(problem, controller, seed=0, compiled=False)


# What moves


# The twin meets every way of sensing, every controller noisy sensors.
PAIRS = [("model-referenced form", s) for s in SENSING] + [(c, "noisy") for c in CONTROLLERS if "referenced" not in c]


@pytest.mark.parametrize(("controller", "sensing"), PAIRS)
def test_reality_equal_to_the_model_changes_no_bit(controller, sensing):
    """A reality is the same plant under another name here, so every signal of the run is the same number."""
    problem = task(**SENSING[sensing])
    one = run(problem, CONTROLLERS[controller])
    other = run(replace(problem, reality=fp.Reality(problem.plant)), CONTROLLERS[controller])
    judged = {"contraction"}  # with a reality it is that of a whole cycle
    for name in set(one.layout.names) - judged:
        assert np.array_equal(one[name], other[name]), name
    assert set(other.layout.names) == {*one.layout.names, "reality_state"}


@pytest.mark.parametrize("name", ["two_mass", "noisy_motor", "leaking_tanks", "turbojet", "fishery"])
def test_model_as_what_moves_shows_its_own_outputs_and_responses(name):
    problem = fp.load_problem(name).problem
    plant = problem.plant
    assert problem.truth.plant is plant
    generator = np.random.default_rng(0)
    x, u = problem.start_state * generator.uniform(0.9, 1.1, plant.state.size), problem.inputs_before
    at = x, u, problem.real_parameters
    calm = np.zeros(len(plant.names))
    shown = problem.truth.function(plant.output.elements)(*at, calm)
    np.testing.assert_array_equal(shown, plant.equations.output(*at, calm))
    answered = problem.truth.function(response_names(plant))(*at, calm)
    np.testing.assert_array_equal(answered, plant.equations.controlled_response(*at))


def test_no_reality_is_no_setting():
    """A problem without one is described as before, so that its baselines stay valid."""
    assert "reality" not in describe(task())
    assert describe(task(reality=fp.Reality(lagged(), start={"F": 0.0})))["reality"]["is"] == "Reality"


def test_table_of_a_problem_names_the_reality():
    """A reader of a notebook sees what moves."""
    assert "y of order 2, F of order 1" in task(reality=fp.Reality(lagged(), start={"F": 0.0}))._repr_html_()


def test_lagged_reality_moves_as_the_matrix_exponential_says():
    """The commands of the run, held over each cycle, move the exact discretisation of y'' = b F, tau F' = u - F alike."""
    reality = fp.Reality(lagged(), start={"F": 0.0}, integrator=fp.RungeKutta4(substeps=4))
    result = run(task(reality=reality), CONTROLLERS["plain form"])
    a = np.array([[0, 1, 0], [0, 0, 2.0], [0, 0, -1 / TAU]])
    whole = expm(np.block([[a, np.array([[0], [0], [1 / TAU]])], [np.zeros((1, 4))]]) * PERIOD)
    x, states = np.array([0.1, 0.0, 0.0]), []
    for u in np.asarray(result["command"]).ravel():
        states.append(x)
        x = whole[:3, :3] @ x + whole[:3, 3] * u
    exact = np.array(states)[:, [0, 2, 1]]  # the reality's state is derivative-major: y, F, y'
    assert result.layout["reality_state"].elements == ("y", "F", "y'")
    assert np.abs(result["reality_state"] - exact).max() < 3e-9 * np.abs(exact).max()
    assert np.array_equal(result["state"], result["reality_state"][:, [0, 2]])
    assert np.allclose(result["realised.y"], 2.0 * result["reality_state.F"], rtol=1e-15)


def test_slow_sensor_is_seen_and_the_true_coordinate_is_judged():
    """The controller is given s, s' and s''; the error that counts is that of y."""
    result = run(task(reality=fp.Reality(slow_sensor(), start={"s": 0.1}, seen={"y": "s"})), CONTROLLERS["plain form"])
    y, s, speed = (result[f"reality_state.{name}"] for name in ("y", "s", "y'"))
    assert np.array_equal(result["state.y"], s)
    assert np.allclose(result["state.y'"], (y - s) / TAU, rtol=1e-12, atol=1e-15)
    assert np.allclose(result["realised.y"], (speed - (y - s) / TAU) / TAU, rtol=1e-12, atol=1e-12)
    assert np.array_equal(result["plant_state.y"], y)
    assert np.array_equal(result["true_error.y"], result["reference.y"] - y)


@pytest.mark.parametrize("sensing", [fp.Sensing(), fp.Sensing(estimator=fp.PositionDifference())])
def test_a_sensor_in_place_of_an_output_stands_beside_the_model_s_own_state(sensing):
    """State, output and response are all shown: the state as it is, the other two as the sensor has them."""
    model = fp.Plant(
        coordinates={"a": "m"},
        inputs={"u": "m/s"},
        order=1,
        parameters=parameters(),
        response=lambda q, u, p: {"a": p.b * u.u - q.a},
        outputs={"y": fp.Output("m", lambda q, p: 2 * q.a)},
    )
    sensed = replace(
        model,
        coordinates={"a": "m", "s": "m"},
        response=lambda q, u, p: {"a": p.b * u.u - q.a, "s": (2 * q.a - q.s) / TAU + u.u},
        controlled=("y",),
    )
    reality = fp.Reality(sensed, start={"s": 0.1}, seen={"y": "s"})
    shared: dict[str, Any] = {"plant": model, "reality": reality, "horizon": None, "cost": None, "sensing": sensing}
    result = run(task(**shared, start={"a": 0.05}), CONTROLLERS["plain form"])
    assert np.array_equal(result["state.a"], result["reality_state.a"])
    assert np.array_equal(result["output.y"], result["reality_state.s"])
    assert np.allclose(result["plant_output.y"], 2 * result["reality_state.a"])
    assert not np.allclose(result["output.y"], result["plant_output.y"], atol=1e-3)


def test_states_of_its_own_start_as_stated_and_the_others_as_the_model():
    assert task(reality=fp.Reality(lagged(), start={"F": -2.0})).real_start.tolist() == [0.1, -2.0, 0.0]
    elsewhere = fp.Reality(lagged(), start={"F": 0.0, "y'": 0.5})
    assert task(reality=elsewhere).real_start.tolist() == [0.1, 0.0, 0.5]


def test_disturbance_of_a_state_that_the_model_does_not_have():
    """A push on the actuator's force is attached by the reality's name; the model's own plant leaves it out."""
    problem = task(reality=fp.Reality(lagged(), start={"F": 0.0}), disturbances={"F": fp.Step(0.0, 100.0)})
    calm = replace(problem, disturbances={})
    assert run(problem)["reality_state.F"][5] > run(calm)["reality_state.F"][5] + 0.3
    assert problem.of_model.disturbances == {}
    assert problem.of_model.reality is None


# What "exact" means


def test_exact_model_is_refused_where_the_reality_has_other_coordinates():
    """The controller is given y and y' only, so it cannot have a model with a force."""
    with pytest.raises(NotSupported, match="the coordinate F, which the controller is not given"):
        run(task(reality=fp.Reality(lagged(), start={"F": 0.0})), fp.ExactModel(CONTROLLERS["computed torque"]))


def test_contraction_is_that_of_a_whole_cycle():
    """Behind the lag a request has done b / b^ (1 - exp(-T / tau)) to the response by the end of its cycle."""
    result = run(task(reality=fp.Reality(lagged(), start={"F": 0.0})), fp.ComputedTorque(TRACK, FPI))
    expected = 1 - FPI.effective_gain() * 2.0 * (1 - np.exp(-PERIOD / TAU))
    assert np.allclose(result["contraction"], expected, atol=1e-6)


def test_gain_of_the_wrong_sign_is_refused_behind_a_lag():
    """The command has no effect at once, but its sign is known at the end of the cycle."""
    problem = task(reality=fp.Reality(lagged(gain=-2.0), start={"F": 0.0}))
    with pytest.raises(NotContractive):
        checked(problem, CONTROLLERS["plain form"])
    checked(task(reality=fp.Reality(lagged(), start={"F": 0.0})), CONTROLLERS["plain form"])


# Mistakes


def missing() -> fp.Plant:
    """A plant without y."""
    return replace(linear(2.0, 1.0), coordinates={"z": "m"}, response=lambda q, v, u, p: {"z": p.b * u.u})


MISTAKES = {
    "no output": (lambda: fp.Reality(missing()), "no coordinate 'y', which the model has"),
    "other unit": (
        lambda: fp.Reality(replace(linear(2.0, 1.0), coordinates={"y": "mm"})),
        "in mm, the model's 'y' in m;",
    ),
    "other input": (
        lambda: fp.Reality(replace(linear(2.0, 1.0), inputs={"F": "N"}, response=lambda q, v, u, p: {"y": p.b * u.F})),
        "inputs are F, the model's are u",
    ),
    "other unit of an input": (lambda: fp.Reality(replace(linear(2.0, 1.0), inputs={"u": "kN"})), "'u' is in kN"),
    "other time": (lambda: fp.Reality(replace(linear(2.0, 1.0), time_unit="ms")), "time is in ms, the model's in s"),
    "lower order": (
        lambda: fp.Reality(fp.Plant({"y": "m"}, {"u": "N"}, parameters(), lambda q, u, p: {"y": p.b * u.u}, order=1)),
        "y' jumps with the command",
    ),
    "out of reach": (
        lambda: fp.Reality(replace(lagged(), response=lambda q, v, u, p: {"y": -q.y, "F": (u.u - q.F) / p.tau})),
        "no input reaches its coordinate 'y'",
    ),
    "unknown start": (
        lambda: fp.Reality(lagged(), start={"force": 1.0}),
        "start: state 'force' is unknown. Valid: y, F, y'",
    ),
    "unknown sensor": (
        lambda: fp.Reality(lagged(), start={"F": 0.0}, seen={"y": "Y"}),
        "coordinate of the reality 'Y' is unknown",
    ),
    "no start": (lambda: fp.Reality(lagged()), r"does not have: F; give .* Reality\(start=\{'F': ...\}\)"),
    "stiff": (
        lambda: fp.Reality(lagged(tau=1e-4), start={"F": 0.0}),
        r"pole -1e\+04 1/s, .* is 10, .*RungeKutta4\(substeps=5\)",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_named(mistake):
    make, message = MISTAKES[mistake]
    with pytest.raises(InvalidProblem, match=f"(?s){message}"):
        task(reality=make())


def test_the_named_sub_steps_would_do():
    """With five sub-steps the stiff lag moves as its exact discretisation, and the run is finite."""
    reality = fp.Reality(lagged(tau=1e-4), start={"F": 0.0}, integrator=fp.RungeKutta4(substeps=5))
    result = run(task(reality=reality))
    assert result.stop is None
    assert np.allclose(result["reality_state.F"][1:], np.asarray(result["command"])[:-1, 0], rtol=1e-3, atol=1e-3)


def test_plant_in_place_of_a_reality_is_named():
    """`Problem(reality=plant)` is refused with the class that is expected."""
    with pytest.raises(InvalidProblem, match="Reality"):
        task(reality=pendulum())
