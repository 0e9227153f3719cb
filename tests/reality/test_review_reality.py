"""What a comparison shows of a reality beside the belief."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_reality import lagged, task

import fpirhc as fp
from fpirhc.report.html import chart_data


def adapted(rate: float, gain: float) -> fp.ComputedTorque:
    """The increment form with an effective gain."""
    return fp.ComputedTorque(fp.Exponential(rate=rate), fp.Increment(fp.Affine(gain=-2 * gain), cycles=0))


def test_comparison_shows_belief_beside_reality():
    """The page's charts have the force that the model does not know; not so without a reality."""
    problem = task(reality=fp.Reality(lagged(), start={"F": 0.0}))
    pair = {"CTC": fp.ComputedTorque(fp.Exponential(rate=6.0)), "CTC+FPI": adapted(6.0, 0.1)}
    titles = {}
    for name, one in {"real": problem, "model": problem.of_model}.items():
        shipped = fp.load_problem("two_mass")
        file = replace(shipped, problem=one, controllers=pair, headline=("CTC", "CTC+FPI"))
        comparison = fp.compare(file, seed=0, compiled=False)
        titles[name] = [chart["title"] for chart in chart_data(comparison)["charts"]]
        factor = comparison.entries[1].metrics.values["contraction.predicted"][""]
        reached = 1 - np.exp(-1e-3 / 0.01) if name == "real" else 1.0
        assert factor == pytest.approx(1 - 0.1 * 2.0 * reached, abs=1e-6)
    assert "reality: F" in set(titles["real"]) - set(titles["model"])


def test_comparison_shows_the_responses_of_slots_that_a_reality_has():
    """Behind encoders the response of the slot on q1 is found from samples; it is drawn beside that of the controlled q2."""
    file = fp.load_problem("mass_spring_slots")
    sensing, real = fp.Sensing(estimator=fp.PositionDifference()), fp.Reality(file.problem.plant)
    problem = replace(
        file.problem, reality=real, sensing=sensing, horizon=None, cost=None, duration=0.5, measure_from=0.0
    )
    names = "slots", "slots+FPI"
    file = replace(file, problem=problem, controllers={n: file.controllers[n] for n in names}, headline=names)
    charts = chart_data(fp.compare(file, seed=0, compiled=False))["charts"]
    titles = {chart["title"] for chart in charts}
    assert {"slots+FPI: responses of q1", "slots+FPI: responses of q2"} < titles
