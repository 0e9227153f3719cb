"""One recommended gain: review, refusal and report name the same number, from the smallest limit of the whole loop, or none."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import abroad
import numpy as np

import fpirhc as fp

steering = cache(lambda: abroad.load("vehicle_steering"))
REFERENCED, PLAIN, TORQUE = "RHC+model-referenced", "RHC+FPI", "CTC+FPI"


def with_gain(name: str, effective: float):
    controller = steering().controllers[name]
    return controller.with_deformation(controller.deformation.with_effective_gain(effective))


def rms_and_movement(controller) -> tuple[float, float]:
    metrics = fp.measure(steering().problem, fp.simulate(steering().problem, controller, seed=0, compiled=False))
    return metrics.rms_error["y"], metrics["total_variation"]["delta"]


def test_with_the_recommended_gain_the_wheel_moves_as_without_adaptation():
    """The error is a fiftieth; towards the limit of the iteration by itself the wheel of the plain form chatters."""
    before, still = rms_and_movement(steering().controllers["RHC"])
    after, moved = rms_and_movement(with_gain(REFERENCED, 1.0))
    assert after < before / 40
    assert moved < 1.05 * still
    lost, chatter = rms_and_movement(with_gain(PLAIN, 2.4))  # effective gains below 2.5 pass the map's own limit
    assert lost > 4 * before
    assert chatter > 250 * still


def test_the_limit_of_the_poles_is_where_a_loop_of_the_box_loses_them():
    """The plant is the model, an end of the box: below its limit the wheel comes to rest after the lane change, above it never."""
    exact = steering().problem.with_exact(steering().problem.plant.approximate)
    problem = replace(exact, duration=16.0)
    sizes = []
    for effective in (1.6, 1.75):
        run = fp.simulate(problem, with_gain(TORQUE, effective), seed=0, compiled=False)
        sizes.append(float(np.abs(np.diff(run["command"][-50:, 0])).max()))
    assert sizes[0] < 1e-9
    assert sizes[1] > 1e-4
