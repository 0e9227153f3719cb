"""A cascade on outputs that are expressions of the state, and its way back from a limit."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from test_cascade import STATIC, affine, linear
from test_outputs import OPTIMISER, hill, planned, sedated

import fpirhc as fp
from fpirhc.errors import NotSupported

LAW = fp.ComputedTorque(fp.Exponential(rate=1.0))


def simulated(problem: fp.Problem, controller: Any) -> fp.Run:
    """A run in the virtual machine."""
    return fp.simulate(problem, controller, seed=1, compiled=False)


@pytest.mark.parametrize("inner", ["computed torque", "receding horizon"])
def test_a_cascade_around_a_controller_of_an_output_takes_its_error_away(inner: str) -> None:
    """The depth of a patient with a wrong curve: a law and a plan leave errors that a shifted target lowers."""
    problem, controller = {
        "computed torque": (sedated(hill(5.5)), LAW),
        "receding horizon": (planned(), fp.RecedingHorizon(OPTIMISER)),
    }[inner]
    cascade = fp.Cascade(controller, affine(0.3), fp.ThroughModel(lag=1.0))
    errors = [fp.measure(problem, simulated(problem, c)).rms_error["depth"] for c in (controller, cascade)]
    assert errors[1] < 0.75 * errors[0]


def test_a_controller_inside_that_does_not_cover_outputs_is_named() -> None:
    """An error of the depth would add up without feedback."""
    cascade = fp.Cascade(fp.FeedforwardOnly(), affine(0.3), fp.ThroughModel(lag=1.0))
    with pytest.raises(NotSupported, match="FeedforwardOnly does not cover outputs"):
        simulated(sedated(hill(5.5)), cascade)


@pytest.mark.parametrize(("offset", "aim", "command"), [(2.0, 3.0, 1.0), (-2.0, -1.0, 1.0)])
def test_a_wrong_model_that_asks_for_too_much_is_led_back_from_the_limit(
    offset: float, aim: float, command: float
) -> None:
    """Y' = (u + o - y) / 5, modelled without o: the model asks for a command beyond the limits, and u = 1 is right."""
    plain = linear(1.0)
    rate = plain.plant.response
    plant = replace(
        plain.plant,
        response=lambda q, u, p: {"y": rate(q, u, p)["y"] + p.offset / 5.0},
        parameters={**plain.plant.parameters, "offset": fp.Parameter(approximate=0.0, exact=offset, unit="K")},
    )
    problem = replace(
        plain,
        plant=plant,
        duration=400.0,
        limits=fp.Limits(inputs={"u": (0.0, 2.0)}),
        reference=fp.Trajectory(lambda t: {"y": aim + 0 * t}),
    )
    run = simulated(problem, fp.Cascade(STATIC, affine(0.5)))
    assert run["clipped"][1] == 1
    assert run["command.u"][-1] == pytest.approx(command, abs=1e-6)
    assert run["error.y"][-1] == pytest.approx(0.0, abs=1e-6)
