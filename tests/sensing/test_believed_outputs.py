"""Outputs that are measured while the states behind them are believed; steppers that are given raw measurements of outputs.

Laws: the right model believes what is; a filter of an output is the filter of the books; outputs that are coordinates and known
change no signal; raw measurements of a run give its commands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import tasks
from helpers.filters import extended_filter, runge_kutta
from helpers.plants import simulated as run

import fpirhc as fp
from fpirhc.contracts import StateObserver
from fpirhc.errors import FpirhcError, InvalidProblem, NotSupported

LAW = fp.Exponential(rate=1.0)
PLAIN, FPI = fp.ComputedTorque(LAW), fp.ComputedTorque(LAW, fp.Affine(-1.0))
E0, STEEP = 93.0, 1.4
FILTER = fp.KalmanFilter(
    measured={"depth": 0.3}, noise={"C": 0.05, "E": 0.05, "R": 0.02}, start={"C": 0.2, "E": 0.2, "R": 0.1}
)


def curve(level: Any, half: Any) -> Any:
    return E0 / (1 + (level / half) ** STEEP)


def drug(believed: float = 4.0) -> fp.Plant:
    """C' = u - C - (C - R) / 2, R' = (C - R) / 10, E' = (C - E) / 2, depth = E0 / (1 + (E / half)^g)."""
    return fp.Plant.of_states(
        states={"C": "mg/l", "R": "mg/l", "E": "mg/l"},
        inputs={"u": "mg/l/min"},
        parameters={"half": fp.Parameter(approximate=believed, exact=4.0, unit="mg/l")},
        rates=lambda x, u, p: {"C": u.u - x.C - 0.5 * (x.C - x.R), "R": 0.1 * (x.C - x.R), "E": 0.5 * (x.C - x.E)},
        outputs={"depth": fp.Output("1", lambda x, p: curve(x.E, p.half))},
        time_unit="min",
    )


def sedated(observer: StateObserver | None, believed: float = 4.0, **changes: Any) -> fp.Problem:
    """The depth from 74 to 50 and on to 40; it alone is measured."""
    plant, first = drug(believed), curve(1.5, 4.0)

    def motion(t: Any) -> dict[str, Any]:
        return {"depth": 50 + (first - 50) * (1 + t / 2) * ca.exp(-t / 2) - 10 / (1 + ca.exp(10 - t))}

    settings: dict[str, Any] = {
        "sensing": fp.Sensing({}, fp.PositionDifference(), measured=["depth"], observer=observer),
        "limits": fp.Limits(inputs={"u": (0.0, 40.0)}),
        "start": {"C": 1.5, "R": 1.5, "E": 1.5},
        "period": 1 / 12,
        "duration": 20.0,
        "measure_from": 3.0,
    }
    return fp.Problem(plant=plant, reference=fp.Trajectory(motion), **(settings | changes))


# What is believed


@pytest.mark.parametrize("late", [0.0, 2 / 12], ids=["at once", "two cycles late"])
@pytest.mark.parametrize("observer", [FILTER], ids=str)
def test_a_right_model_believes_what_is(observer: StateObserver, late: float) -> None:
    """With exact parameters the states are the plant's, as late as the measurement is; the outputs are estimated."""
    problem = sedated(observer, dead_time=fp.DeadTime(inputs={"u": 1.5 / 12}, measurement=late), duration=6.0)
    result, cycles = run(problem, PLAIN), round(late * 12)
    believed, true = result["state"], result["plant_state"]
    assert np.ptp(true, axis=0).min() > 0.5
    np.testing.assert_allclose(believed[cycles:], true[: len(true) - cycles], atol=1e-11)
    difference = np.diff(result["plant_output.depth"])[:5] * 12
    np.testing.assert_allclose(result["output.depth'"][1 + cycles : 6 + cycles], difference, atol=1e-9)


def test_a_filter_of_an_output_is_that_of_the_books() -> None:
    """Against a recursion in numpy with a wrong curve: rates by hand, Jacobians by the complex step, to 1e-10."""
    sensors = {"depth": fp.Sensor(noise=fp.Noise(0.3))}
    sensing = fp.Sensing(sensors, fp.PositionDifference(), measured=["depth"], observer=FILTER)
    problem = sedated(FILTER, believed=5.0, sensing=sensing, duration=8.0)
    result = run(problem, PLAIN)

    def rate(x: Any, u: float, w: Any) -> Any:
        c, r, e = x
        return np.array([u - c - 0.5 * (c - r), 0.1 * (c - r), 0.5 * (c - e)]) + w

    start, noise = (np.full(3, 1.5), np.array([0.2, 0.1, 0.2])), np.array([0.05, 0.02, 0.05])  # C, R, E
    states, _ = extended_filter(result, runge_kutta(rate, 1 / 12), lambda x: curve(x[2:], 5.0), start, noise, 0.3)
    np.testing.assert_allclose(result["state"], states, atol=1e-10)
    assert np.abs(result["state"] - result["plant_state"]).max() > 0.3


COMPARTMENTS = fp.KalmanFilter(
    measured={"bis": 0.5},
    noise={"C1": 0.3, "C2": 0.02, "C3": 0.02, "Ce": 0.1},
    start={"C1": 0.3, "C2": 0.1, "C3": 0.1, "Ce": 0.3},
)
BELIEFS: dict[str, Any] = {"known": None, "filter": COMPARTMENTS}
NAMES = ("CTC", "CTC+FPI", "RHC", "RHC+FPI")


@pytest.fixture(scope="module")
def bis_errors() -> dict[tuple[str, str], float]:
    """Rms error of the depth by what is known of the compartments, and controller; the bis alone is measured."""
    errors = {}
    for known, observer in BELIEFS.items():
        measured = None if observer is None else ["bis"]
        sensing = fp.Sensing({}, fp.PositionDifference(), measured=measured, observer=observer)
        problem = replace(tasks.anaesthesia.problem, sensing=sensing)
        for name in NAMES:
            result = run(problem, tasks.anaesthesia.controllers[name])
            errors[known, name] = fp.measure(problem, result).rms_error["bis"]
    return errors


@pytest.mark.parametrize("known", ["filter"])
def test_adaptation_works_with_believed_compartments(bis_errors: dict[tuple[str, str], float], known: str) -> None:
    """The bis is measured and the compartments are those of a wrong patient: FPI helps as with known ones, .021 beside .022."""
    assert bis_errors[known, "CTC+FPI"] < 0.35 * bis_errors[known, "CTC"]
    assert bis_errors[known, "CTC+FPI"] < 1.02 * bis_errors["known", "CTC+FPI"]


FIGURES = {"known": (0.117, 0.0217, 0.356, 0.0178), "filter": (0.070, 0.0207, 0.279, 0.0197)}


@pytest.mark.parametrize("known", FIGURES)
def test_figures(bis_errors: dict[tuple[str, str], float], known: str) -> None:
    """Rms errors of the bis by what is known of the compartments behind it."""
    assert [bis_errors[known, name] for name in NAMES] == pytest.approx(FIGURES[known], rel=0.015)


# What is known before a run


def integrating(measured: str) -> fp.Problem:
    """Y' = u measured; the state z = the integral of y shows nowhere and stays."""
    plant = fp.Plant.of_states(
        states={"y": "m", "z": "m s"},
        inputs={"u": "m/s"},
        parameters={},
        rates=lambda x, u, p: {"y": u.u, "z": x.y},
        outputs={"y": fp.Output("m", lambda x, p: x.y)},
    )
    observer = fp.KalmanFilter(measured={measured: 0.1}, noise={"y": 1.0})
    return fp.Problem(
        plant=plant, reference=fp.Trajectory(lambda t: {"y": ca.sin(t)}), start={"y": 0.0, "z": 0.0}, period=0.1, duration=2.0,
        sensing=fp.Sensing({}, fp.PositionDifference(), measured=["y"], observer=observer),
    )  # fmt: skip


WRONG: dict[str, tuple[Callable[[], object], type[FpirhcError], str]] = {


    "state without an observer": (
        lambda: sedated(None, sensing=fp.Sensing({}, fp.PositionDifference(), measured=["depth", "C"])),
        InvalidProblem,
        "C is given as it is to controllers of a plant with outputs, unless an observer is stated",
    ),

    "filter of what is not measured": (
        lambda: sedated(replace(FILTER, measured={"C": 0.1})),
        InvalidProblem,
        "no sensor shows 'C'; those of .* are depth",
    ),
    "not observed": (
        lambda: run(integrating("y"), PLAIN),
        NotSupported,
        "KalmanFilter: z cannot be observed along the reference from y",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_mistakes_are_named(what: str) -> None:
    make, kind, message = WRONG[what]
    with pytest.raises(kind, match=f"(?s){message}"):
        make()
