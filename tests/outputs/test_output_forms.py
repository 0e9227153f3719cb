"""The three forms of the iteration on outputs, under computed torque and receding horizons, and rivals on outputs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.of_outputs import ARM, arm, circle
from helpers.plants import simulated

import fpirhc as fp
from fpirhc.contracts import Controller, Deformation

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


# Two plants from other fields: a stirred tank reactor by its conversion, and four tanks by the sums of their levels.


def reactor(believed: float = 7.2e10) -> fp.Problem:
    """Conversion of an exothermic reaction, by the temperature of the jacket (Seborg et al., Process Dynamics and Control, ch. 2).

    c' = q/V (cf - c) - k c,  T' = q/V (Tf - T) + 209.2 k c + 2.092 (Tc - T),  k = k0 exp(-8750 / T); conversion 1 - c / cf.
    """

    def rates(x: Any, u: Any, p: Any) -> dict[str, Any]:
        k = p.k0 * ca.exp(-8750 / x.T)
        return {"c": 1.0 - x.c - k * x.c, "T": 350 - x.T + 209.2 * k * x.c + 2.092 * (u.jacket - x.T)}

    plant = fp.Plant.of_states(
        states={"c": "mol/l", "T": "K"},
        inputs={"jacket": "K"},
        parameters={"k0": fp.Parameter(approximate=believed, exact=7.2e10, unit="1/min")},
        rates=rates,
        outputs={"conversion": fp.Output("1", lambda x, p: 1 - x.c)},
        time_unit="min",
    )
    cost = fp.Quadratic(outputs={"conversion": 100.0, "conversion'": 5.0}, rate={"jacket": 1e-5})
    first = 0.5
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"conversion": first + 0.1 * (1 - ca.cos(1.2 * t))}),
        start={"c": 1 - first, "T": 350.0},
        period=0.01,
        duration=4.0,
        measure_from=2.0,
        horizon=fp.Horizon(stages=15, step=0.04),
        cost=cost,
        input_before={"jacket": 300.0},
    )


def four_tanks(believed: float = 1.0) -> fp.Problem:
    """Levels of the quadruple tank (Johansson, IEEE Trans. CST 8, 2000), of which the sums left and right are followed."""
    area, hole, gain, split = (28.0, 32.0, 28.0, 32.0), (0.071, 0.057, 0.071, 0.057), (3.33, 3.35), (0.7, 0.6)

    def rates(x: Any, u: Any, p: Any) -> dict[str, Any]:
        out = [a * ca.sqrt(2 * 981 * h) for a, h in zip(hole, (x.h1, x.h2, x.h3, x.h4), strict=True)]
        pumps = p.k * gain[0] * u.v1, p.k * gain[1] * u.v2
        inflow = (
            out[2] + split[0] * pumps[0],
            out[3] + split[1] * pumps[1],
            (1 - split[1]) * pumps[1],
            (1 - split[0]) * pumps[0],
        )
        return {f"h{k + 1}": (inflow[k] - out[k]) / area[k] for k in range(4)}

    plant = fp.Plant.of_states(
        states=dict.fromkeys(("h1", "h2", "h3", "h4"), "cm"),
        inputs={"v1": "V", "v2": "V"},
        parameters={"k": fp.Parameter(approximate=believed, exact=1.0, unit="1")},
        rates=rates,
        outputs={"left": fp.Output("cm", lambda x, p: x.h1 + x.h3), "right": fp.Output("cm", lambda x, p: x.h2 + x.h4)},
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"left": 14 + ca.sin(0.02 * t), "right": 14.2 + ca.sin(0.03 * t)}),
        start={"h1": 12.3, "h2": 12.8, "h3": 1.7, "h4": 1.4},
        period=1.0,
        duration=200.0,
        measure_from=80.0,
        horizon=fp.Horizon(stages=10, step=4.0),
        cost=fp.Quadratic(outputs={"left": 1.0, "right": 1.0}, rate={"v1": 1e-3, "v2": 1e-3}),
        input_before={"v1": 3.0, "v2": 3.0},
    )


PLANTS = {"reactor": (reactor, 5.0e10, 4.0), "four tanks": (four_tanks, 0.7, 0.05)}


def controllers(rate: float) -> dict[str, Controller]:
    return {
        "CTC": fp.ComputedTorque(fp.Exponential(rate=rate, integral=False)),
        "RHC": fp.RecedingHorizon(fp.FixedPoint(iterations=3, tolerance=1e-3)),
    }


@pytest.mark.parametrize("kind", ["CTC", "RHC"])
@pytest.mark.parametrize("name", PLANTS)
def test_every_form_lowers_the_error_of_a_wrong_model(name: str, kind: str) -> None:
    make, wrong, rate = PLANTS[name]
    problem, controller = make(wrong), controllers(rate)[kind]

    def error(one: Controller) -> float:
        run = simulated(problem, one)
        assert run.stop is None
        return max(fp.measure(problem, run).rms_error.values())

    bare = error(controller)
    errors = {form: error(controller.with_deformation(map_)) for form, map_ in FORMS.items()}
    assert errors["plain"] < 0.75 * bare  # it takes the plant's drift within a cycle for an error of the model
    assert max(errors["increment"], errors["model-referenced"]) < 0.2 * bare


# Rivals on plants with outputs: those whose idea is about errors follow outputs; the others say why they do not


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
