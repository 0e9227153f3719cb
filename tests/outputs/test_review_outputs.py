"""Reviews of plants with outputs: what is left of a push is the decay of a small deviation of the run."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.of_outputs import curve, hill, sedated
from helpers.plants import simulated
from helpers.reviewed import answers

import fpirhc as fp

LEVEL = 3.0  # mg/l
CONVERGED = fp.RecedingHorizon(fp.FixedPoint(iterations=8, tolerance=1e-9))


def resting(**settings: Any) -> fp.Problem:
    """The depth at rest, with a wrong curve and a new plan in every cycle."""
    still = float(curve(LEVEL, 4.0))
    cost = fp.Quadratic(outputs={"depth": 1.0, "depth'": 0.1}, rate={"u": 1e-2})
    changes: dict[str, Any] = {
        "reference": fp.Trajectory(lambda t: {"depth": still + 0 * t}),
        "start": {"C": LEVEL, "E": LEVEL},
        "period": 0.1,
        "duration": 7.0,
        "measure_from": 0.0,
        "cost": cost,
        "horizon": fp.Horizon(stages=12, step=0.1),
        "input_before": {"u": LEVEL},
    }
    return replace(sedated(hill(5.5)), **{**changes, **settings})


def test_the_factor_of_a_plan_is_the_decay_of_a_small_deviation() -> None:
    problem, controller = resting(), replace(CONVERGED, deformation=fp.ModelReferenced(fp.Affine(-1.0)))
    starts = ({**problem.start, "E": LEVEL + s} for s in (1e-3, -1e-3))
    one, other = (simulated(replace(problem, start=s), controller)["output.depth"] for s in starts)
    deviation = np.abs(one - other)
    decay = (deviation[60] / deviation[30]) ** (1 / 30)
    told = answers(problem, controller)["returns"]
    assert told.verdict == "yes"
    assert told.numbers["factor"] == pytest.approx(decay, abs=0.03)
