"""The verdict says what happened, for adaptation that helps, does nothing, hurts, or diverges."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import pytest
from plants import linear

import fpirhc as fp
from fpirhc.problem_files.problem_file import Task
from fpirhc.studies.comparison.compare import compare

TRACK = fp.Exponential(rate=6.0)


def judged(deformation, gain=1.6, **changes):
    """Compare computed torque with and without this deformation on a linear plant."""
    problem = fp.Problem(
        plant=linear(gain, 1.0),
        reference=fp.Trajectory(lambda t: {"y": ca.sin(3 * t)}),
        start={"y": 0.0, "y'": 3.0},
        period=1e-3,
        duration=3.0,
        measure_from=1.0,
        **changes,
    )
    controllers = {"plain": fp.ComputedTorque(TRACK), "adaptive": fp.ComputedTorque(TRACK, deformation)}
    task = Task("case", Path("case.py"), "a case", "", problem, controllers)
    return compare(task, seed=0, compiled=False)


def test_help_is_stated_with_numbers():
    """Which error, from what to what, by which factor, at which price."""
    found = judged(fp.Sigmoid(gain=-0.5, scale=10.0))
    assert found["adaptive"].pair == "plain"
    assert found.verdict[0].startswith("adaptive lowers the rms error of y from")
    assert "times less" in found.verdict[0]


def test_too_small_a_scale_is_recognised():
    """The desired response outruns the map's step limit: the verdict names S and by how much to raise it."""
    found = judged(fp.Sigmoid(gain=-0.5, scale=1e-3))
    assert "raise its scale S" in found.verdict[0]


def test_too_large_a_gain_is_recognised():
    """Beyond the linear limit the iteration is no contraction; the verdict says so and gives admissible gains."""
    found = judged(fp.Rotation(fraction=1.4, radius=1e4))
    assert "is too large" in found.verdict[0]
    assert found["adaptive"].contraction.predicted > 1


def test_no_difference_is_said():
    """With an exact model there is nothing to gain."""
    found = judged(fp.Sigmoid(gain=-0.5, scale=10.0), gain=1.0)
    assert "no clear difference" in found.verdict[0] or "does not help" in found.verdict[0]


def test_controller_that_cannot_serve_is_skipped_with_its_reason():
    """A receding horizon without a horizon is not run, and the verdict says so."""
    problem = fp.Problem(
        plant=linear(1.0, 1.0),
        reference=fp.Trajectory(lambda t: {"y": 0 * t}),
        start={"y": 0.0},
        period=1e-3,
        duration=0.1,
    )
    controllers = {
        "CTC": fp.ComputedTorque(TRACK),
        "RHC": fp.RecedingHorizon(fp.ReducedGradient(iterations=5, tolerance=1e-6)),
    }
    found = compare(Task("case", Path("case.py"), "", "", problem, controllers), seed=0, compiled=False)
    assert "needs Problem(horizon=...)" in found.skipped["RHC"]
    assert found.verdict[-1].startswith("Not run: RHC")


def test_unknown_entry_offers_the_nearest():
    """A comparison is read by name."""
    with pytest.raises(fp.FpirhcError, match="Did you mean 'plain'"):
        judged(fp.Sigmoid(gain=-0.5, scale=10.0))["plan"]
