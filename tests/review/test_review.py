"""The table of a review: its keys and names, its exit code, and what it asks of whom."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.reviewed import answers, mass, torque

import fpirhc as fp
from fpirhc.__main__ import main

LIMITS = fp.Limits(inputs={"u": (-20.0, 20.0)})
NAMES = {  # of numbers by key, which scripts read
    "turns": {"jumps"},
    "posed": {"share_finite"},
    "orders": {"order", "stated"},
    "inverse": {"condition"},
    "ranges": {"without", "of"},
    "plans": {"not_converged", "error", "error_with_more_iterations"},
    "gain": {"error", "error_at_half", "error_at_twice", "error_at_four_times", "error_turned", "recommended_times"},
    "follows": {"error", "at_a_limit", "left_with_more_iterations"},
    "returns": {"left", "left_of_ten_times", "factor", "largest_factor", "mean_step", "left_with_more_iterations"},
    "horizon": {"error", "error_with_twice_the_horizon"},
    "box": {"share_that_come_back", "left", "error"},
    "input_gain": {"most", "least"},
    "latency": {"cycles_borne", "left", "error", "error_without", "mean_step", "mean_step_without"},
    "limits": {"beyond", "share_of_cycles"},
    "inner": {"rate_with_outputs_held", "left"},
    "noise": {"rms_step", "error_without_noise", "error"},
    "bias": {
        "error_per_bias",
        "bias_that_costs_the_gain",
        "share_of_the_response",
        "error_with_right_sensors",
        "error",
    },
    "model": {"error_without", "error_with", "added"},
    "pays": {"error_without", "error_with", "added", "divided_by", "share_without", "share_with"},
}


def test_a_good_problem_is_ready():
    """Every answer about a mild mismatch is yes, in the form that suits the problem and in the plain one."""
    plain = torque()
    for controller in (plain, replace(plain, deformation=fp.ModelReferenced(plain.deformation))):
        found = answers(mass(limits=LIMITS), controller)
        assert "no" not in {a.verdict for a in found.values()}
        assert found["returns"].verdict == found["pays"].verdict == "yes"


def test_a_wrong_sign_is_found_before_the_run():
    found = answers(mass(), torque(gain=0.5))
    assert found["pays"].verdict == "no"
    assert "no" in {found["returns"].verdict, found["follows"].verdict}


@pytest.mark.parametrize("wrong", [-1.0, 100.0, math.nan])
def test_a_mismatch_that_makes_no_sense_is_refused(wrong):
    with pytest.raises(ValueError, match="mismatch"):
        fp.review(mass(), {}, mismatch=wrong, seed=0)


def test_the_plants_of_the_box_are_drawn_by_its_mismatch():
    """The same seed has the same answers; without a mismatch they are on the way to the model."""
    one, same, none = (
        {a.key: a for a in fp.review(mass(), {"it": torque()}, mismatch=wide, seed=1).answers["it"]}
        for wide in (30.0, 30.0, 0.0)
    )
    assert one == same
    assert one["box"] != none["box"]
    assert one["returns"] == none["returns"]


def test_a_controller_that_does_not_fit_is_a_no_with_its_reason():
    task = fp.load_problem("crane_slots")
    controller = task.controllers["slots+FPI"]
    wrong = replace(controller, slots=(replace(controller.slots[0], order=3), controller.slots[1]))
    found = fp.review(task.problem, {"it": wrong}, mismatch=0.0, seed=0)
    assert [a.key for a in found.answers["it"]] == ["fits"]
    assert not found.ready
    assert found.to_do[0][1].change


def test_a_noisy_sensor_is_asked_about():
    """The chatter is that of two runs, with the noise and without it."""
    noisy = mass(limits=LIMITS, sensing=fp.Sensing({"q''": fp.Sensor(noise=fp.Noise(1.0))}), duration=1.0)
    found = fp.review(noisy, {"it": torque()}, mismatch=0.0, seed=0).answers["it"]
    [noise] = [a for a in found if a.key == "noise"]
    assert noise.of == "u"
    assert noise.numbers["rms_step"] > 1e-3


def test_an_optimiser_says_whether_it_has_iterations():
    """Two settings bound the work of the fixed point; one bounds IPOPT's."""
    assert fp.FixedPoint(iterations=3, tolerance=1e-3).longer(4) == fp.FixedPoint(
        iterations=12, tolerance=1e-3, most_iterations=400
    )
    assert fp.Ipopt(tolerance=1e-3).longer(2) == fp.Ipopt(tolerance=1e-3, iterations=400)


FILE = """
import casadi as ca
import fpirhc as fp

plant = fp.Plant({{"q": "m"}}, {{"u": "N"}}, {{"m": fp.Parameter(1.5, 1.0, "kg")}}, lambda x, v, u, p: {{"q": u.u / p.m}})
reference = fp.Trajectory(lambda t: {{"q": 0.5 * ca.sin(3 * t)}})
problem = fp.Problem(plant, reference, {{"q": 0.0}}, period=1e-3, duration=2.0, limits=fp.Limits(inputs={{"u": (-20.0, 20.0)}}))
controllers = {{"CTC+FPI": fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Affine(gain={gain}))}}
"""


@pytest.mark.parametrize(("gain", "code"), [(-0.5, 0), (0.5, 1)])
def test_the_command_writes_fixed_names_and_says_no_by_its_exit_code(tmp_path: Path, gain: float, code: int, capsys):
    """A gain of the wrong sign is a no."""
    (tmp_path / "mine.py").write_text(FILE.format(gain=gain))
    assert main(["review", str(tmp_path / "mine.py"), "--json"]) == code
    told = json.loads(capsys.readouterr().out)
    assert told["ready"] is (code == 0)
    for answer in (a for some in told["answers"].values() for a in some):
        assert set(answer) == {"key", "question", "verdict", "numbers", "of", "change"}
        assert set(answer["numbers"]) <= NAMES[answer["key"]]
        assert answer["key"] != "gain" or (answer["numbers"]["recommended_times"] < 0) is (code == 1)
