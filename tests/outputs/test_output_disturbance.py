"""Disturbances of outputs: y = h(x, p) + d(t) is what is measured, judged and followed."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.of_outputs import curve, hill, sedated
from helpers.plants import simulated

import fpirhc as fp

LAW = fp.Exponential(rate=1.0)
WAVE = fp.Formula(lambda t: 2.0 * ca.sin(2 * np.pi * 0.1 * t + 0.3))
FORMULA = fp.Formula(lambda t: 2.0 * ca.sin(0.2 * ca.pi * t + 0.3))


def with_clock(believed: float) -> fp.Plant:
    """The wave as a part of the output, by the plant's own clock."""
    plain = hill(believed)
    return fp.Plant.of_states(
        states={**plain.coordinates, "clock": "min"},
        inputs=plain.inputs,
        parameters=plain.parameters,
        rates=lambda x, u, p: {"C": u.u - x.C, "E": 0.5 * (x.C - x.E), "clock": 1.0 + 0 * x.C},
        outputs={"depth": fp.Output("1", lambda x, p: curve(x.E, p.half) + FORMULA.expression(x.clock))},
        time_unit="min",
    )


@pytest.mark.parametrize("wave", [WAVE, FORMULA])
@pytest.mark.parametrize("adaptive", [False, True])
def test_a_disturbed_output_is_the_output_with_the_disturbance_in_it(wave: Any, adaptive: bool) -> None:
    """A controller that knows the clock has the wave in its model; the other one sees it in what is measured."""
    plain = sedated(hill(4.0), disturbances={"depth": wave})
    clock = replace(plain, plant=with_clock(4.0), start={**plain.start, "clock": 0.0}, disturbances={})
    law = fp.ComputedTorque(LAW, fp.Affine(-1.0) if adaptive else fp.Identity())
    run, other = (simulated(p, law) for p in (plain, clock))
    assert np.allclose(run["output_disturbance.depth"], FORMULA.values(run.time, np.random.default_rng(0)), atol=1e-12)
    # At the same states both measure the same y, y' and, under the same command, the same y''.
    x = np.column_stack([run["plant_state"], run.time])
    u, p, calm = run["command"], [4.0], np.zeros(3)
    of = clock.plant.equations.output.map(run.cycles)
    y = np.asarray(of(x.T, u.T, np.tile(p, (run.cycles, 1)).T, np.tile(calm, (run.cycles, 1)).T).full()).T
    assert np.allclose(run["output"], y, atol=1e-9)
    second = clock.plant.equations.controlled_response.map(run.cycles - 1)
    r = np.asarray(second(x[1:].T, u[:-1].T, np.full((1, run.cycles - 1), 4.0)).full()).ravel()
    assert np.allclose(run["realised.depth"][1:], r, atol=1e-9)
    # The controller that does not know the wave follows nearly as well once it adapts.
    errors = [np.sqrt(np.mean(one["true_error.depth"][900:] ** 2)) for one in (run, other)]
    if adaptive:
        assert errors[0] < 0.01
    else:
        assert errors[0] > 0.1
        assert errors[1] < 0.005
