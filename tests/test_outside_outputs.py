"""Signals from outside beside outputs: allowed where no derivative of the signal stands in those of an output."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.errors import InvalidProblem


def room(**settings: Any) -> fp.Plant:
    """C T' = u - k (T - ambient): a heated room."""
    return fp.Plant(
        coordinates={"T": "K"},
        inputs={"u": "W"},
        parameters={
            "k": fp.Parameter(approximate=1.5, exact=1.0, unit="W/K"),
            "ambient": fp.outside(nominal=280.0, unit="K"),
        },
        response=lambda q, u, p: {"T": (u.u - p.k * (q.T - p.ambient)) / 100.0},
        order=1,
        **settings,
    )


def heated(plant: fp.Plant, name: str, motion: Any, **settings: Any) -> fp.Problem:
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {name: motion(t)}),
        start={"T": 290.0},
        period=1.0,
        duration=200.0,
        signals={"ambient": fp.Known(lambda t: 280 + 5 * ca.sin(t / 20))},
        **settings,
    )


def rising(t: Any) -> Any:
    return 293 - 3 * ca.exp(-t / 50)


@pytest.mark.parametrize("form", [fp.Identity(), fp.ModelReferenced(fp.Affine(-1.0))])
def test_a_signal_beside_an_output_that_is_a_coordinate_changes_no_signal(form: Any) -> None:
    controller = fp.ComputedTorque(fp.Exponential(rate=0.05), form)
    plants = room(), room(outputs={"T": fp.Output("K", lambda q, p: q.T)})
    one, other = (fp.simulate(heated(p, "T", rising), controller, seed=0, compiled=False) for p in plants)
    assert [n for n in one.layout.names if not np.array_equal(one[n], other[n])] == []


def test_an_output_of_order_zero_may_depend_on_a_signal() -> None:
    """The loss of heat k (T - ambient) + u / 10: the signal of the cycle is in the response, and no derivative of it."""
    loss = fp.Output("W", lambda q, u, p: p.k * (q.T - p.ambient) + u.u / 10)
    problem = heated(room(outputs={"loss": loss}), "loss", lambda t: 20 + 0 * t, input_before={"u": 10.0})
    run = fp.simulate(problem, fp.ExactModel(fp.FeedforwardOnly()), seed=0, compiled=False)
    assert np.abs(run["error.loss"][2:]).max() < 1.0
    state, ambient = run["state.T"], 280 + 5 * np.sin((run.time - 0.5) / 20)
    expected = 1.0 * (state - ambient) + np.append(10.0, run["command.u"][:-1]) / 10
    assert run["output.loss"][1:] == pytest.approx(expected[1:], abs=1e-9)


def test_an_output_whose_derivative_has_that_of_a_signal_is_refused() -> None:
    difference = replace(room(), outputs={"d": fp.Output("K", lambda q, p: q.T - p.ambient)})
    with pytest.raises(
        InvalidProblem, match=r"signals: ambient from outside .* choose an output that depends on the state"
    ):
        heated(difference, "d", rising)
