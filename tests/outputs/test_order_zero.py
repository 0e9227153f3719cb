"""Outputs of order 0: the command moves them at once, and an iteration on targets makes up for a wrong static map."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.of_outputs import affine
from helpers.plants import simulated
from scipy.optimize import least_squares

import fpirhc as fp
from fpirhc.contracts import Controller

STATIC = fp.FeedforwardOnly()
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


def rms_of(problem: fp.Problem, run: fp.Run, name: str) -> float:
    return float(fp.measure(problem, run).rms_error[name])


def rms(problem: fp.Problem, controller: Controller) -> float:
    return rms_of(problem, simulated(problem, controller), "power")


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

OPTIMISER = fp.FixedPointSolver(iterations=20, tolerance=1e-10)
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
    run = simulated(planned_power(), fp.RecedingHorizon(OPTIMISER))
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


REFUSED: dict[str, tuple[Callable[[], object], str]] = {
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
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_has_no_meaning_for_order_zero_is_refused(name: str) -> None:
    make, words = REFUSED[name]
    with pytest.raises(fp.FpirhcError, match=words):
        make()
