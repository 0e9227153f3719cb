"""Realities and foreign bodies of a model with outputs: they have these by name, and states of their own."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

import fpirhc as fp

PERIOD = 1 / 12  # min
TRACK = fp.ComputedTorque(fp.Exponential(rate=1.5))
FPI = fp.Sigmoid(gain=-2.0, shift=0.3, scale=20.0)
PLAN = fp.RecedingHorizon(fp.FixedPointSolver(iterations=3, tolerance=1e-1))
FILTER = fp.KalmanFilter(measured={"bis": 1.0}, noise={"c": 0.01, "e": 0.01})
BELIEVED = fp.Sensing(observer=FILTER)
FIRST = {"C1": 2.0, "C2": 0.6, "C3": 0.1, "Ce": 1.5}
START = 93.0 / (1 + (1.5 / 4.1) ** 1.36)
RATES = (1.9 + 1.1 + 0.84, 1.1, 0.84, 4.27, 16.0, 238.0)  # clearances, l/min, and volumes, l


def depth(site: Any, p: Any, top: float) -> Any:
    """Depth of anaesthesia by the concentration at the effect site."""
    return top / (1 + (site / p.C50) ** p.steepness)


def constants(half: float, steepness: float, speed: float) -> dict[str, fp.Parameter]:
    return {
        "C50": fp.Parameter(half, half, "mg/l"),
        "steepness": fp.Parameter(steepness, steepness, "1"),
        "ke0": fp.Parameter(speed, speed, "1/min"),
    }


def model(one: str = "c", site: str = "e") -> fp.Plant:
    """One compartment and an effect site, under free names."""

    def rates(x: Any, u: Any, p: Any) -> dict[str, Any]:
        return {one: -0.3 * x[one] + u.u / 8, site: p.ke0 * (x[one] - x[site])}

    return fp.Plant.of_states(
        states={one: "mg/l", site: "mg/l"},
        inputs={"u": "mg/min"},
        parameters=constants(4.5, 1.5, 0.3),
        rates=rates,
        outputs={"bis": fp.Output("1", lambda x, p: depth(x[site], p, 92.0))},
        time_unit="min",
    )


def moved(x: Any, u: Any, ke0: Any) -> list[Any]:
    """Rates of the patient, of numbers and of expressions: three compartments and an effect site."""
    out, fast, slow, blood, muscle, fat = RATES
    return [
        (-out * x[0] + fast * x[1] + slow * x[2] + u) / blood,
        fast / muscle * (x[0] - x[1]),
        slow / fat * (x[0] - x[2]),
        ke0 * (x[0] - x[3]),
    ]


def patient(unit: str = "1", output: str = "bis") -> fp.Plant:
    """Three compartments and an effect site, with another curve."""
    return fp.Plant.of_states(
        states=dict.fromkeys(FIRST, "mg/l"),
        inputs={"u": "mg/min"},
        parameters=constants(4.1, 1.36, 0.2),
        rates=lambda x, u, p: dict(zip(FIRST, moved([x[n] for n in FIRST], u.u, p.ke0), strict=True)),
        outputs={output: fp.Output(unit, lambda x, p: depth(x.Ce, p, 93.0))},
        time_unit="min",
    )


def lightly(t: Any) -> dict[str, Any]:
    """From light sedation to 50, and to 45."""
    return {"bis": 50 + (START - 50) * (1 + t / 1.5) * ca.exp(-t / 1.5) - 5 / (1 + ca.exp(-2 * (t - 12)))}


def task(**changes: Any) -> fp.Problem:
    """The patient, of whom the bis is measured, with the model of one compartment."""
    settings: dict[str, Any] = {
        "plant": model(),
        "reference": fp.Trajectory(lightly),
        "start": {"c": 1.5, "e": 1.5},
        "period": PERIOD,
        "duration": 20.0,
        "reality": fp.Reality(patient(), start=FIRST),
        "sensing": BELIEVED,
        "limits": fp.Limits(inputs={"u": (0.0, 400.0)}),
        "horizon": fp.Horizon(stages=10, step=3 * PERIOD),
        "cost": fp.Quadratic(outputs={"bis": 1.0, "bis'": 0.1}, rate={"u": 1e-5}),
    }
    return fp.Problem(**(settings | changes))


def run(problem: fp.Problem, controller: Any = TRACK) -> fp.Run:
    return fp.simulate(problem, controller, seed=0, compiled=False)


# A reality


def test_it_moves_as_scipy_says():
    """The commands, held over every cycle, move the patient's own equations alike; the bis is the patient's curve."""
    result = run(task(duration=2.0), replace(TRACK, deformation=FPI))
    x, states = np.array(list(FIRST.values())), []
    for u in np.asarray(result["command"]).ravel():
        states.append(x)
        x = solve_ivp(lambda t, x, u=u: moved(x, u, 0.2), (0, PERIOD), x, rtol=1e-11, atol=1e-13).y[:, -1]
    np.testing.assert_allclose(result["reality_state"], states, rtol=2e-6)
    np.testing.assert_allclose(result["output.bis"], 93 / (1 + (np.array(states)[:, 3] / 4.1) ** 1.36), rtol=2e-6)
