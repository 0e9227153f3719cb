"""Outputs y = h(x, p): what follows a reference may be an expression of the state.

Laws: a plant that is written by its states is the plant; an output by expression is the plant whose coordinate it is; the measured
outputs, and not those of a wrong model, are what a controller follows.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import tasks
from helpers.plants import simulated

import fpirhc as fp
from fpirhc.contracts import Controller
from fpirhc.errors import FpirhcError, InvalidProblem, NotInvertible
from fpirhc.simulation.loop import close_loop

TRACK = fp.Exponential(rate=6.0)
shortened = cache(lambda: replace(tasks.two_mass.problem, duration=0.4, measure_from=0.1))
SAME = {"q1": fp.Output("m", lambda q, v, p: q.q1), "q2": fp.Output("m", lambda q, v, p: q.q2)}


def on_outputs(problem: fp.Problem) -> fp.Problem:
    """The problem of two masses with its coordinates as outputs."""
    assert isinstance(problem.cost, fp.Quadratic)
    cost = replace(problem.cost, states={}, outputs=problem.cost.states)
    return replace(problem, plant=replace(problem.plant, outputs=SAME), cost=cost)


@pytest.mark.parametrize("name", ["CTC", "CTC+FPI (eq 6)"])
def test_outputs_that_are_coordinates_need_no_more_operations(name: str) -> None:
    """Operations of one cycle, which do not depend on the machine as times do."""
    plain, outputs = (
        close_loop(p, tasks.two_mass.controllers[name]).function for p in (shortened(), on_outputs(shortened()))
    )
    assert outputs.n_instructions() <= plain.n_instructions() + 5  # four outputs are written, a term is doubled


SENSING = {
    "estimated": fp.Sensing(estimator=fp.PositionDifference()),
    "noisy": fp.Sensing(sensors={"q1'": fp.Sensor(noise=fp.Noise(1e-4), dropout=0.1)}),
}


@pytest.mark.parametrize("sensing", SENSING)
def test_sensors_and_estimators_are_those_of_the_outputs(sensing: str) -> None:
    """The law and the map are given the same numbers; the inverse is given the state, which no sensor touches."""
    problem = replace(shortened(), sensing=SENSING[sensing], horizon=None, cost=None)
    outputs = replace(problem, plant=replace(problem.plant, outputs=SAME))
    controller = fp.ComputedTorque(TRACK)
    plain, run = (simulated(p, controller, seed=1) for p in (problem, outputs))
    assert not np.array_equal(run["output"], run["plant_output"])
    assert np.array_equal(run["state"], run["plant_state"])
    wrong, plainly = run["output"] - run["plant_output"], plain["state"] - plain["plant_state"]
    assert np.allclose(
        wrong, plainly, atol=0.2 * np.abs(plainly).max()
    )  # the same draws, around nearly the same motion
    assert np.abs(run["true_error"]).max() < 1.1 * np.abs(plain["true_error"]).max()


ARM = {"l1": 0.5, "l2": 0.4}  # m


def arm(mass: float = 1.0) -> fp.Plant:
    """Two links in a plane, decoupled drives, with the position of the hand as outputs."""

    def response(q: Any, v: Any, u: Any, p: Any) -> dict[str, Any]:
        return {"a": (u.A - 0.2 * v.a) / p.m, "b": (u.B - 0.1 * v.b) / (0.5 * p.m)}

    l1, l2 = ARM["l1"], ARM["l2"]
    return fp.Plant(
        coordinates={"a": "rad", "b": "rad"},
        inputs={"A": "N m", "B": "N m"},
        parameters={"m": fp.Parameter(approximate=1.4, exact=mass, unit="kg m^2")},
        response=response,
        outputs={
            "x": fp.Output("m", lambda q, v, p: l1 * ca.cos(q.a) + l2 * ca.cos(q.a + q.b)),
            "y": fp.Output("m", lambda q, v, p: l1 * ca.sin(q.a) + l2 * ca.sin(q.a + q.b)),
        },
    )


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


def circle(plant: fp.Plant, radius: float = 0.1, **settings: Any) -> fp.Problem:
    """The hand on a circle, from rest on it."""
    a, b, (l1, l2) = 0.4, 1.1, ARM.values()
    x0, y0 = l1 * math.cos(a) + l2 * math.cos(a + b), l1 * math.sin(a) + l2 * math.sin(a + b)

    def motion(t: Any) -> dict[str, Any]:
        return {
            "x": x0 - radius * (1 - ca.cos(2 * t)),
            "y": y0 + radius * ca.sin(2 * t) - 2 * radius * t * ca.exp(-5 * t),
        }

    start = {"a": a, "b": b}
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(motion),
        start=start,
        period=2e-3,
        duration=4.0,
        measure_from=1.0,
        **settings,
    )


def test_the_hand_of_an_arm_follows_a_circle_and_adaptation_helps() -> None:
    problem = circle(arm())
    plain, adaptive = fp.ComputedTorque(TRACK), fp.ComputedTorque(TRACK, fp.Affine(-0.5))
    errors = [max(fp.measure(problem, simulated(problem, c)).rms_error.values()) for c in (plain, adaptive)]
    assert errors[1] < 0.1 * errors[0]
    exact = max(fp.measure(problem, simulated(problem, fp.ExactModel(plain))).rms_error.values())
    assert exact < 0.1 * errors[0]


# A curve from the state to what is measured: two first-order parts and a Hill curve, as the depth of anaesthesia.

E0, STEEP = 93.0, 1.4


def curve(level: Any, half: Any) -> Any:
    return E0 / (1 + (level / half) ** STEEP)


def hill(believed: float) -> fp.Plant:
    """C' = u - C, E' = (C - E) / 2, depth = E0 / (1 + (E / half)^g), with a wrong half."""
    return fp.Plant.of_states(
        states={"C": "mg/l", "E": "mg/l"},
        inputs={"u": "mg/l/min"},
        parameters={"half": fp.Parameter(approximate=believed, exact=4.0, unit="mg/l")},
        rates=lambda x, u, p: {"C": u.u - x.C, "E": 0.5 * (x.C - x.E)},
        outputs={"depth": fp.Output("1", lambda x, p: curve(x.E, p.half))},
        time_unit="min",
    )


def by_hand(believed: float) -> fp.Plant:
    """The same plant with the depth as its coordinate: E is computed from the depth."""

    def response(q: Any, v: Any, u: Any, p: Any) -> dict[str, Any]:
        level, half = ca.SX.sym("E"), ca.SX.sym("half")
        slope_of = ca.Function("slope", [level, half], [ca.jacobian(curve(level, half), level)])
        bend_of = ca.Function("bend", [level, half], [ca.hessian(curve(level, half), level)[0]])
        at = p.half * (E0 / q.depth - 1) ** (1 / STEEP)
        slope, bend = slope_of(at, p.half), bend_of(at, p.half)
        speed = v.depth / slope
        drug = at + 2 * speed
        return {"depth": bend * speed**2 + slope * 0.5 * (u.u - drug - speed)}

    parameters = {"half": fp.Parameter(approximate=believed, exact=4.0, unit="mg/l")}
    return fp.Plant({"depth": "1"}, {"u": "mg/l/min"}, parameters, response, order=2, time_unit="min")


def sedated(plant: fp.Plant, **settings: Any) -> fp.Problem:
    """Depth from 74 to 50 and on to 40, smoothly, from rest."""
    first = curve(1.5, 4.0)

    def motion(t: Any) -> dict[str, Any]:
        return {"depth": 50 + (first - 50) * (1 + t / 2) * ca.exp(-t / 2) - 10 / (1 + ca.exp(10 - t))}

    start = {"C": 1.5, "E": 1.5} if plant.outputs else {"depth": first}
    limits = fp.Limits(inputs={"u": (0.0, 40.0)})
    return fp.Problem(
        plant=plant, reference=fp.Trajectory(motion), start=start, period=1 / 60, duration=20.0, measure_from=3.0,
        **{"limits": limits, **settings},
    )  # fmt: skip


def depth_error(problem: fp.Problem, controller: Controller) -> float:
    """Rms error of the depth."""
    return fp.measure(problem, simulated(problem, controller)).rms_error["depth"]


def test_an_output_by_expression_is_the_plant_whose_coordinate_it_is() -> None:
    """With the exact model both forms are one controller on one plant; their integrated states differ."""
    law = fp.ComputedTorque(fp.Exponential(rate=1.0))
    one, other = (simulated(sedated(p), law) for p in (hill(4.0), by_hand(4.0)))
    assert np.ptp(one["output.depth"]) > 30
    assert np.abs(one["output.depth"] - other["state.depth"]).max() < 2e-4
    assert set(hill(4.0).chains.values()) == {2}


def planned(**settings: Any) -> fp.Problem:
    """The depth with a horizon."""
    cost = fp.Quadratic(outputs={"depth": 1.0, "depth'": 0.1}, rate={"u": 1e-3})
    return sedated(hill(5.5), horizon=fp.Horizon(stages=16, step=0.25), **{"cost": cost, **settings})


OPTIMISER = fp.FixedPoint(iterations=3, tolerance=1e-2)


def test_a_plan_with_a_wrong_curve_ends_at_the_reference() -> None:
    """A plan that is compared with the model's own outputs would stay where the wrong curve says 40, at 46."""
    problem = planned()
    plain, adaptive = fp.RecedingHorizon(OPTIMISER), fp.RecedingHorizon(OPTIMISER, fp.Affine(-1.5))
    runs = [simulated(problem, c) for c in (plain, adaptive)]
    assert abs(runs[0]["true_error.depth"][-1]) < 0.05
    assert curve(5.5 * (E0 / 40 - 1) ** (1 / STEEP), 4.0) < 34
    errors = [fp.measure(problem, run).rms_error["depth"] for run in runs]
    assert errors[1] < 0.5 * errors[0]
    exact = depth_error(problem, fp.ExactModel(plain))
    assert exact < errors[1]


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


def test_a_plant_with_outputs_behind_a_lag_is_judged_at_its_own_outputs() -> None:
    """The pump lags; the depth that is measured and judged is the real one, with the real curve."""
    model, tau = hill(5.5), 0.02  # min
    real = fp.Plant.of_states(
        states={"C": "mg/l", "E": "mg/l", "pump": "mg/l/min"},
        inputs=dict(model.inputs),
        parameters={"half": fp.Parameter(approximate=4.0, exact=4.0, unit="mg/l")},
        rates=lambda x, u, p: {"C": x.pump - x.C, "E": 0.5 * (x.C - x.E), "pump": (u.u - x.pump) / tau},
        outputs=dict(model.outputs),
        time_unit="min",
    )
    settled = {"pump": float(sedated(model).inputs_before[0])}
    problem = replace(sedated(model), reality=fp.Reality(real, settled, fp.RungeKutta4(substeps=4)))
    law = fp.Exponential(rate=1.0)
    errors = [depth_error(problem, fp.ComputedTorque(law, map)) for map in (fp.Identity(), fp.Affine(-1.0))]
    assert errors[1] < 0.5 * errors[0]
    run = simulated(problem, fp.ComputedTorque(law))
    assert np.allclose(run["plant_output.depth"], curve(run["reality_state.E"], 4.0), rtol=1e-12)


# What is refused, and how

DOUBLE: dict[str, Any] = {
    "states": {"a": "m", "b": "m/s"},
    "inputs": {"u": "N"},
    "parameters": {},
    "rates": lambda x, u, p: {"a": x.b, "b": u.u},
}


def double(outputs: dict[str, fp.Output], **settings: Any) -> fp.Plant:
    """Two integrators with some outputs."""
    return fp.Plant.of_states(**{**DOUBLE, **settings}, outputs=outputs)


SQUARE = {"y": fp.Output("m^2", lambda x, p: x.a**2)}


def squared(motion: Callable[[Any], Any], **settings: Any) -> fp.Problem:
    """Y = a^2, whose gain 2 a vanishes at a = 0."""
    return fp.Problem(
        plant=double(SQUARE), reference=fp.Trajectory(lambda t: {"y": motion(t)}), start={"a": 1.0, "b": 0.0}, period=1e-2,
        duration=4.0, **settings,
    )  # fmt: skip


WRONG: dict[str, tuple[Callable[[], object], str]] = {
    "not reached": (lambda: double({"y": fp.Output("m", lambda x, p: 3.0 + 0 * x.a)}), "no input reaches 'y'"),
    "another expression": (lambda: double({"a": fp.Output("m", lambda x, p: 2 * x.a)}), "rename the output"),
    "arguments": (lambda: double({"y": fp.Output("m", lambda x: x.a)}), r"called as function\(x, p\)"),
    "name in it": (lambda: double({"y": fp.Output("m", lambda x, p: x.c)}), "state 'c' is unknown"),
    "controlled": (lambda: double(SQUARE, controlled=("z",)), "output 'z' is unknown. Valid: y"),
    "name of a state": (lambda: double(SQUARE, states={"a'": "m", "b": "m"}), "'a'' is not an identifier"),
    "name of an input": (lambda: double({"u": fp.Output("m", lambda x, p: x.a)}), "both an output and an input"),
    "no rate": (lambda: double(SQUARE, rates=lambda x, u, p: {"a": x.b}), "rates does not give the derivative b' of state 'b'"),
    "crossing": (lambda: squared(lambda t: ca.cos(t) ** 2), "vanishes .* at t = 1.57"),
    "reference": (lambda: replace(squared(lambda t: 1 + 0 * t), reference=fp.Trajectory(lambda t: {"yy": t})), "mean 'y'"),
    "judged": (lambda: squared(lambda t: 1 + 0 * t, judged=("z",)), "judged: output 'z' is unknown"),
    "states in the cost": (lambda: squared(lambda t: 1 + 0 * t, cost=fp.Quadratic(states={"a": 1.0})), "have no reference"),
    "both in the cost": (
        lambda: replace(shortened(), cost=fp.Quadratic(states={"q1": 1.0}, outputs={"q2": 1.0})),
        "states and outputs: both weigh errors",
    ),
    "reality": (lambda: replace(squared(lambda t: 1 + 0 * t), reality=fp.Reality(double({}))), "it has no output 'y'"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", WRONG)
def test_a_mistake_is_named(mistake: str) -> None:
    make, words = WRONG[mistake]
    with pytest.raises(InvalidProblem, match=words):
        make()


def test_a_plant_shows_its_outputs() -> None:
    plant = hill(5.5)
    assert "depth of relative order 2" in repr(plant)
    assert "output, relative order 2" in plant._repr_html_()


def test_fewer_inputs_than_outputs_need_the_controlled_ones() -> None:
    plant = double({**SQUARE, "b": fp.Output("m/s", lambda x, p: x.b)})
    with pytest.raises(NotInvertible, match=r"1 input.* cannot hold 2 outputs"):
        _ = plant.controlled_names


def test_a_gain_that_stays_away_from_zero_is_accepted() -> None:
    assert set(squared(lambda t: 1 + 0.2 * ca.sin(t)).plant.chains.values()) == {2}


def test_a_gain_that_vanishes_on_the_way_is_named_for_several_inputs_too() -> None:
    """The hand of a stretched arm cannot move outwards: the determinant is l1 l2 sin b."""
    with pytest.raises(InvalidProblem, match=r"determinant of the gain from A, B to x, y vanishes"):
        circle(arm(), radius=-0.2)


def test_a_stepper_is_given_the_outputs_and_does_what_the_loop_does() -> None:
    problem, controller = (
        replace(sedated(hill(5.5)), duration=1.0, measure_from=0.0),
        fp.ComputedTorque(TRACK, fp.Affine(-0.5)),
    )
    run = simulated(problem, controller)
    stepper = fp.Stepper(problem, controller, compiled=False)
    memory = stepper.start()
    for k in range(run.cycles):
        command, memory = stepper.step(
            run.time[k], run["state"][k], run["realised"][k], memory, output=run["output"][k]
        )
        assert np.array_equal(command, run["command"][k])
    command, _ = stepper.step_measured(
        run.time[0], np.concatenate([run[n][0] for n in ("state", "output", "realised")]), stepper.start()
    )
    assert np.array_equal(command, run["command"][0])
    with pytest.raises(FpirhcError, match="output"):
        stepper.step(0.0, run["state"][0], run["realised"][0], memory)


def test_set_points_of_an_output_are_filtered_and_followed() -> None:
    problem = sedated(hill(5.5))
    first = float(curve(1.5, 4.0))
    aims = fp.Setpoint({"depth": [(0.0, first), (2.0, 50.0)]}, rate=1.0)
    run = simulated(
        replace(problem, reference=aims, duration=20.0), fp.ComputedTorque(fp.Exponential(rate=1.0), fp.Affine(-1.5))
    )
    assert run["reference.depth"][-1] == pytest.approx(50.0, abs=1e-3)
    assert np.abs(run["true_error.depth"]).max() < 1.0
    planned_run = simulated(replace(planned(), reference=aims), fp.RecedingHorizon(OPTIMISER, fp.Affine(-1.5)))
    assert abs(planned_run["output.depth"][-1] - 50.0) < 0.05


def test_a_scale_that_is_chosen_covers_an_output() -> None:
    """The scale follows from the nominal run, because nobody gives references of the states."""
    law = fp.Exponential(rate=1.0)
    errors = [
        depth_error(sedated(hill(5.5)), fp.ComputedTorque(law, m)) for m in (fp.Identity(), fp.Sigmoid(gain=-3.5))
    ]
    assert errors[1] < 0.5 * errors[0]


def test_a_deviation_needs_references_of_all_states() -> None:
    cost = fp.Quadratic(outputs={"depth": 1.0}, deviation={"u": 1e-3})
    with pytest.raises(FpirhcError, match="needs the states C, E"):
        simulated(planned(cost=cost), fp.RecedingHorizon(OPTIMISER))


def test_the_patients_kinetics_conserve_the_drug() -> None:
    """What is infused is in the compartments or has been cleared: V1 C1 + V2 C2 + V3 C3 changes by u - CL C1."""
    age, weight, height = 61.0, 77.0, 175.0
    lean = 1.1 * weight - 128 * (weight / height) ** 2
    clearance = 1.89 + 0.0456 * (weight - 77) - 0.0681 * (lean - 59) + 0.0264 * (height - 177)
    volumes = np.array([4.27, 18.9 - 0.391 * (age - 53), 238.0])
    plant, x = fp.load_problem("anaesthesia").problem.plant, np.array([3.0, 1.0, 0.4, 2.0])
    rates = plant.equations.rate(x, 20.0, plant.exact).full().ravel()
    assert volumes @ rates[:3] == pytest.approx(20.0 - clearance * x[0], rel=1e-12)


# Reviews
