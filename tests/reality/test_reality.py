"""A reality that is not the model: what moves, what the controller is given, outputs, signals, and what "exact" then means."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import drives
from helpers.drives import CONTROLLERS, FPI, PAIRS, PERIOD, SENSING, TAU, TRACK, lagged, parameters, run, task
from helpers.of_outputs import curve, hill, sedated
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import fpirhc as fp
from fpirhc.errors import NotContractive


@pytest.mark.parametrize(("controller", "sensing"), PAIRS)
def test_reality_equal_to_the_model_changes_no_bit(controller, sensing):
    """A reality is the same plant under another name here, so every signal of the run is the same number."""
    problem = task(**SENSING[sensing])
    one = run(problem, CONTROLLERS[controller])
    other = run(replace(problem, reality=fp.Reality(problem.plant)), CONTROLLERS[controller])
    for name in one.layout.names:
        assert np.array_equal(one[name], other[name]), name
    assert set(other.layout.names) == {*one.layout.names, "reality_state"}


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
    real = fp.Reality(drives.slow_sensor(), start={"s": 0.1}, seen={"y": "s"})
    result = run(task(reality=real), CONTROLLERS["plain form"])
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


def test_contraction_is_that_of_a_whole_cycle():
    """Behind the lag a request has done b / b^ (1 - exp(-T / tau)) to the response by the end of its cycle."""
    problem = task(reality=fp.Reality(lagged(), start={"F": 0.0}))
    factor = fp.measure(problem, run(problem, fp.ComputedTorque(TRACK, FPI)))["contraction.predicted"][""]
    expected = 1 - FPI.effective_gain() * 2.0 * (1 - np.exp(-PERIOD / TAU))
    assert factor == pytest.approx(expected, abs=1e-6)


def test_gain_of_the_wrong_sign_is_refused_behind_a_lag():
    """The command has no effect at once, but its sign is known at the end of the cycle."""
    with pytest.raises(NotContractive):
        run(task(reality=fp.Reality(lagged(gain=-2.0), start={"F": 0.0})), CONTROLLERS["plain form"])


# A reality with other states than the model needs only what is measured, controlled or judged; the rest is believed
STEP, PARAMETERS = 0.05, {"b": fp.Parameter(approximate=1.0, exact=1.3, unit="1/l")}
FILTER = fp.KalmanFilter(measured={"c1": 1e-4}, noise={"c1": 1.0, "c2": 0.01})
BELIEVED = fp.Sensing(measured=["c1", "c1'"], observer=FILTER)
BLOOD = fp.ComputedTorque(fp.Exponential(rate=1.0))
DRUG = fp.Sigmoid(gain=-0.8, scale=20.0)


def compartments(deep: str = "c2") -> fp.Plant:
    """A drug in blood and in a tissue, whose name is free."""

    def response(q: Any, u: Any, p: Any) -> dict[str, Any]:
        return {"c1": p.b * u.u - 0.5 * q.c1 + 0.2 * q[deep], deep: 0.3 * q.c1 - 0.2 * q[deep]}

    return fp.Plant(
        coordinates={"c1": "mg/l", deep: "mg/l"},
        inputs={"u": "mg/min"},
        order=1,
        controlled=("c1",),
        parameters=PARAMETERS,
        response=response,
        time_unit="min",
    )


def infusion(**changes: Any) -> fp.Problem:
    """Blood along a sine; the tissue is nobody's to measure."""
    settings: dict[str, Any] = {
        "plant": compartments(),
        "reference": fp.Trajectory(lambda t: {"c1": 2 + 0.3 * ca.sin(t / 2), "c2": 3 + 0 * t}),
        "start": {"c1": 2.0, "c2": 3.0},
        "period": STEP,
        "duration": 20.0,
        "sensing": BELIEVED,
        "limits": fp.Limits(inputs={"u": (0.0, 20.0)}),
        "horizon": fp.Horizon(stages=8, step=5 * STEP),
        "cost": fp.Quadratic(states={"c1": 10.0}, rate={"u": 1e-3}),
    }
    return fp.Problem(**(settings | changes))


@pytest.mark.parametrize(
    "controller",
    [replace(BLOOD, deformation=DRUG), fp.RecedingHorizon(fp.FixedPointSolver(iterations=2, tolerance=1e-4), DRUG)],
    ids=["computed torque", "receding horizon"],
)
def test_what_nobody_measures_may_have_any_name(controller):
    """The same equations with the tissue under another name: the controller is given the same, so every signal is the same."""
    whole = run(infusion(duration=3.0, reality=fp.Reality(compartments())), controller)
    renamed = run(infusion(duration=3.0, reality=fp.Reality(compartments("deep"), start={"deep": 3.0})), controller)
    for name in set(renamed.layout.names) - {"plant_state", "reality_state", "cost"}:
        np.testing.assert_array_equal(renamed[name], whole[name], err_msg=name)
    assert renamed.layout["plant_state"].elements == ("c1",)
    np.testing.assert_array_equal(renamed["plant_state.c1"], whole["plant_state.c1"])


def test_no_cost_of_states_that_do_not_exist():
    """A plan has the believed tissue; a run is judged by its error, and its cost is left out."""
    other = infusion(duration=0.5, reality=fp.Reality(compartments("deep"), start={"deep": 3.0}))
    costs = [fp.measure(one, run(one, BLOOD))["cost"] for one in (other, infusion(duration=0.5))]
    assert [bool(one) for one in costs] == [False, True]


# A model with outputs: a reality has these by name, and states of its own
PATIENT = {"C1": 2.0, "C2": 0.6, "C3": 0.1, "site": 1.5}  # mg/l


def distributed(x: Any, u: Any) -> list[Any]:
    """Rates of three compartments and an effect site, of numbers and of expressions."""
    out, fast, slow = 0.9 * x[0], 0.26 * (x[0] - x[1]), 0.2 * (x[0] - x[2])
    return [u - out - fast - slow, 4 * fast, slow / 60, 0.2 * (x[0] - x[3])]


def test_it_moves_as_scipy_says():
    """The commands, held over every cycle, move the patient's own equations alike; the depth is the patient's curve."""
    patient = fp.Plant.of_states(
        states=dict.fromkeys(PATIENT, "mg/l"),
        inputs={"u": "mg/l/min"},
        parameters={},
        rates=lambda x, u, p: dict(zip(PATIENT, distributed([x[n] for n in PATIENT], u.u), strict=True)),
        outputs={"depth": fp.Output("1", lambda x, p: curve(x.site, 4.1))},
        time_unit="min",
    )
    believed = fp.Sensing(observer=fp.KalmanFilter(measured={"depth": 1.0}, noise={"C": 0.01, "E": 0.01}))
    problem = sedated(hill(5.5), reality=fp.Reality(patient, start=PATIENT), sensing=believed)
    law = fp.ComputedTorque(fp.Exponential(rate=1.5), fp.Sigmoid(gain=-2.0, shift=0.3, scale=20.0))
    result = run(replace(problem, duration=2.0, measure_from=0.0), law)
    x, states = np.array(list(PATIENT.values())), []
    for u in np.asarray(result["command"]).ravel():
        states.append(x)
        x = solve_ivp(lambda t, x, u=u: distributed(x, u), (0, 1 / 60), x, rtol=1e-11, atol=1e-13).y[:, -1]
    np.testing.assert_allclose(result["reality_state"], states, rtol=2e-6)
    np.testing.assert_allclose(result["output.depth"], curve(np.array(states)[:, 3], 4.1), rtol=2e-6)
    assert np.ptp(result["command"]) > 0.1


# A signal acts in every step of what moves with the value in its middle
MEAL = 5.0
INTEGRAL = fp.ComputedTorque(fp.Exponential(rate=0.01))


def pulse(t):
    """10 units in two minutes, from 7 to 9; their cycle is that from 5 to 10."""
    return 5.0 * ca.logic_and(t >= 7.0, t < 9.0)


def stored(step):
    """A map that stores what comes in."""
    return fp.Plant.discrete(
        states={"x": "g", "y": "g"},
        inputs={"u": "g/min"},
        next=lambda x, u, p: {"x": x.x + step * p.eaten, "y": x.y + step * u.u},
        step=step,
        outputs={"y": fp.Output("g", lambda x, p: x.y)},
        time_unit="min",
        parameters={"eaten": fp.outside(nominal=0.0, unit="g/min")},
    )


def flowing():
    """The same as differential equations."""
    return fp.Plant.of_states(
        states={"x": "g", "y": "g"},
        inputs={"u": "g/min"},
        rates=lambda x, u, p: {"x": p.eaten, "y": u.u},
        parameters={"eaten": fp.outside(nominal=0.0, unit="g/min")},
        outputs={"y": fp.Output("g", lambda x, p: x.y)},
        time_unit="min",
    )


def eating(plant, reality, signal=pulse, **more):
    return fp.Problem(
        plant=plant,
        reality=reality,
        reference=fp.Trajectory(lambda t: {"y": 0 * t}),
        start={"x": 0.0, "y": 0.0},
        period=MEAL,
        duration=60.0,
        signals={"eaten": fp.Unknown(signal)},
        **more,
    )


@pytest.mark.parametrize(
    "task",
    [
        eating(stored(MEAL), fp.Reality(stored(1.0))),
        eating(flowing(), fp.Reality(flowing(), integrator=fp.RungeKutta4(substeps=5))),
        eating(flowing(), fp.Reality(flowing(), integrator=fp.Collocation(substeps=5))),
    ],
    ids=["map", "Runge-Kutta", "collocation"],
)
def test_what_is_stated_is_what_arrives(task):
    """All 10 units, in the cycle in which they come; the signal that is shown is the mean over the cycle."""
    run = fp.simulate(task, INTEGRAL, seed=0, compiled=False)
    assert run.stop is None
    x = run["reality_state"][:, 0]
    assert x == pytest.approx(np.where(run["time"].ravel() > 7.0, 10.0, 0.0), abs=1e-12)
    assert run["signals.eaten"].sum() * MEAL == pytest.approx(10.0, abs=1e-12)
