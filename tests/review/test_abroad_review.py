"""What a review says of the reactor and of a cart behind a dead time with a user's own map, against runs."""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pytest
from abroad import load
from reviewed import answer

import fpirhc as fp
from fpirhc.review.questions.form import forms_of


def test_the_reactor_drifts_within_a_cycle():
    """0.43 of the jacket's pole passes in a cycle: with its exact model C_b is thousands of times worse with adaptation.

    Both questions about it are answered no. The model-referenced form leaves C_b as it is.
    """
    task = load("cstr")
    adaptive = task.controllers["RHC+FPI"]
    null = answer(task.problem, adaptive, "right model alone")
    assert null.verdict == "no"
    assert null.numbers["response_with"] > 1e-3
    assert null.numbers["without"] < 1e-4
    assert 0.3 < null.numbers["with"] < 0.6
    run = fp.simulate(task.problem, adaptive, seed=0, compiled=False)
    late = run["error.C_b"][run.time >= task.problem.measure_from]
    assert null.numbers["with"] == pytest.approx(float(np.sqrt(np.mean(late**2))), rel=0.01)
    assert "model-referenced form passes" in null.change
    assert answer(task.problem, adaptive, "lower the response error").verdict == "no"
    referenced = forms_of(task.problem, adaptive.deformation)["model-referenced"]
    assert answer(task.problem, adaptive.with_deformation(referenced), "right model alone").verdict == "yes"


@pytest.mark.parametrize(
    ("name", "verdict"), [("unpaired", "unknown"), ("RHC+FPI", "no"), ("RHC+FPI, increment", "yes")]
)
def test_a_map_of_one_s_own_behind_a_dead_time(name, verdict):
    """Unpaired its gain is beyond 2 sin(pi / 18); paired, the plain form is too slow for the plan; the increment converges.

    The loop of the unpaired map is asked where the map is saturated, so its poles decide nothing; the question about the gain
    does. The increment does not bear a dead time that is wrong by a cycle, because plans are made every four: a run says so.
    """
    task = load("own_map")
    unpaired = importlib.import_module("abroad.own_map").unpaired
    controller = task.controllers.get(name, unpaired)

    def about(words: str) -> fp.Answer:
        one: fp.Answer = answer(task.problem, controller, words)
        return one

    assert about("Does the deformation converge").verdict == verdict
    assert (about("right model alone").verdict == "yes") == (verdict == "yes")
    if name == "unpaired":
        gain = about("gain admissible")
        assert gain.verdict == "no"
        assert 1.5 * gain.numbers["linear_limit"] == pytest.approx(2 * np.sin(np.pi / 18), rel=0.1)
    if name == "RHC+FPI":
        assert about("keep up").verdict == "no"
    if verdict == "yes":
        assert about("wrong by a cycle").numbers["borne"] == 0
        later = fp.DeadTime(inputs={"F": task.problem.dead_time.inputs["F"] + task.problem.period})
        late = fp.simulate(replace(task.problem, dead_time=later), controller, seed=0, compiled=False)
        assert np.abs(late["realised"] - late["desired"])[-400:].max() > 20  # m/s^2; .53 with the dead time as it is
    run = fp.simulate(task.problem, controller, seed=0, compiled=False)
    sizes = np.abs(run["realised"] - run["desired"])[:, 0]
    assert (run.stop is None and sizes[-400:].max() < 0.5 * sizes[:400].max()) == (verdict == "yes")
