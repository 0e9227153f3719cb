"""The table of a review: its keys and names, its exit code, and what it asks of whom."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.line import line_text
from helpers.reviewed import PERIOD, answers, biased, heater, heavy, mass, plans, torque

import fpirhc as fp
from fpirhc.__main__ import main

LIMITS = fp.Limits(inputs={"u": (-20.0, 20.0)})


def test_a_limit_that_is_left_has_the_numbers_of_the_run():
    """By how much it is left, in its unit and of its range, when, and in which share of the cycles."""
    fast = mass(limits=fp.Limits(states={"q'": (-1.0, 1.0)}))
    speed = np.abs(fp.simulate(fast, torque(), seed=0, compiled=False)["plant_state.q'"])
    worst, most = int(speed.argmax()), speed.max() - 1
    wanted = {"excess": most, "beyond": most / 2, "time_of_it": worst * PERIOD, "share_of_cycles": np.mean(speed > 1)}
    assert answers(fast)["limits"].numbers == pytest.approx(wanted, rel=5e-3)


def test_a_start_and_a_reference_outside_hard_limits_are_named_first_and_as_the_cause():
    """By what they are and the limits; what has a price, and what keeps its limits, is not named."""
    ends = fp.Limits(states={"q": (0.1, 0.4), "q'": (-2.0, 2.0)})
    first, *others = answers(mass(limits=ends)).values()
    assert {a.change for a in others if a.verdict in ("no", "caution")} == {first.change}
    ends_of = "outside its hard limits of 0.1 and 0.4 m"
    assert first.evidence == f"The start of q is 0 m, {ends_of}; the reference of q is -0.5 m, {ends_of}."
    for kept in (replace(ends, prices={"q": 1.0}), fp.Limits(states={"q": (-0.5, 0.5)})):
        assert "inside" not in answers(mass(limits=kept))


def test_the_plants_of_the_box_are_drawn_by_its_mismatch():
    """The same seed has the same answers, and another one other noise; without a mismatch they are on the way to the model."""
    ways = (30.0, 1), (30.0, 1), (0.0, 1), (0.0, 2)
    told = [fp.review(noisy(0.1), {"it": torque()}, mismatch=wide, seed=seed).answers["it"] for wide, seed in ways]
    one, same, none, other = ({a.key: a for a in some} for some in told)
    assert one == same
    assert none["noise"].numbers != other["noise"].numbers
    assert one["box"] != none["box"]
    assert one["returns"] == none["returns"]


def noisy(size: float, name: str = "q''") -> fp.Problem:
    return mass(limits=LIMITS, sensing=fp.Sensing({name: fp.Sensor(noise=fp.Noise(size))}), measure_from=2.0)


@pytest.mark.parametrize(
    ("size", "gain", "remedy"), [(0.1, -0.5, "Set deformation.gain to -"), (0.2, -0.05, "Filtered(map, pole=")]
)
def test_what_is_recommended_under_noise_is_calm_in_a_run(size, gain, remedy):
    """Own runs with the noise: less than twice the movement without adaptation, where today's has more, and a smaller error."""
    problem, told = noisy(size), answers(noisy(size), torque(gain))["gain"]
    assert remedy in told.change
    poles = [float(one) for one in re.findall(r"pole=(.*)\)", told.change)] or [0.0]
    best = fp.Filtered(fp.Sigmoid(gain=told.numbers.get("recommended_gain", gain), scale=20.0), pole=poles[0])
    laws = [replace(torque(gain), deformation=one) for one in (best, fp.Identity(), torque(gain).deformation)]
    made = [fp.measure(problem, fp.simulate(problem, law, seed=0, compiled=False)) for law in laws]
    calm, without, today = ((one["total_variation"]["u"], one.rms_error["q"]) for one in made)
    shaken = [fp.measure(problem, fp.simulate(problem, laws[-1], seed=k, compiled=False)) for k in range(3)]
    assert told.numbers["movement"] == pytest.approx(max(one["total_variation"]["u"] for one in shaken))
    assert calm[0] < 2 * without[0] < today[0]
    assert calm[1] < without[1]


def test_a_remedy_is_what_the_loop_has():
    """No gain is lowered and no map filtered where there is no map."""
    law = answers(noisy(0.02, "q'"), fp.ComputedTorque(fp.Exponential(rate=60.0)))
    plan = {a.key: a for a in fp.review(biased(1.0), {"it": plans()["RHC"]}, mismatch=0.0, seed=0).answers["it"]}
    said = "None of the changes that were run helps, 4 in all: rate (rate 30, 120, 15, 240)."
    assert law["noise"].change == f"Measure the response with less noise. {said}"
    assert not [one for one in (*law.values(), *plan.values()) if "gain" in one.change or "Filtered" in one.change]


@pytest.mark.parametrize(
    ("limit", "rate", "verdict"), [(0.3, 1e6, "no"), (20, 1e6, "yes"), (20, 2, "no"), (2e3, 1e6, "yes")]
)
def test_limits_of_inputs_that_do_not_fit_are_told(limit, rate, verdict):
    """Ten times too small, right, too slow, and far away; shares are those of an own run; 1.5 kg need more."""
    limits = fp.Limits(inputs={"u": (-limit, limit)}, rates={"u": (-rate, rate)})
    problem = mass(plant=heavy(1.0, 1.5, (10.0, 6.0)), limits=limits)
    told, run = answers(problem)["input_limits"], fp.simulate(problem, torque(), seed=0, compiled=False)
    wanted = fp.measure(problem, run)["at_limit"][""], 3.75 / limit, -limit, limit
    names = "at_a_limit", "needed", "lower", "upper"
    assert (told.verdict, *map(told.numbers.get, names)) == (verdict, *map(pytest.approx, wanted))


def test_the_limit_cycle_of_an_encoder_is_no_answer_to_a_push():
    """Its quantum is as large as the push, whose rest is that of the loop with a right sensor."""
    both = {"q": fp.Sensor(quantum=0.01)}, {}
    told, right = (answers(mass(limits=LIMITS, sensing=fp.Sensing(one)))["returns"] for one in both)
    assert (told.verdict, told.numbers["factor"]) == ("yes", pytest.approx(right.numbers["factor"], rel=1e-3))


@pytest.mark.parametrize("level", [0.0, 0.3])
def test_a_set_point_is_judged_beside_the_plant_that_is_left_alone(level):
    """A room starts .1 K off, and the sun heats it by 2.5 K: laws leave 1.4, .94 and .2 K of that."""
    still = {"reference": fp.Trajectory(lambda t: {"T": level + 0 * t}), "start": {"T": level + 0.1}}
    still |= {"limits": fp.Limits(), "input_before": {"u": 1.2 * level}}
    problem = replace(heater(), **still, measure_from=5.0, disturbances={"u": fp.Step(at=1.0, size=3.0)})
    for rate, verdict in ((2.0, "no"), (3.0, "caution"), (15.0, "yes")):
        told = answers(problem, fp.ComputedTorque(fp.Exponential(rate, integral=False)))["follows"]
        wanted = pytest.approx(2.5, rel=0.01), pytest.approx((3 - 0.2 * level) / (rate + 0.2), rel=0.02)
        assert (told.verdict, told.numbers["size"], told.numbers["rms_error"]) == (verdict, *wanted)


@pytest.mark.parametrize(("gain", "code"), [(-0.5, 0), (0.5, 1)])
def test_the_command_writes_fixed_names_and_says_no_by_its_exit_code(tmp_path: Path, gain: float, code: int, capsys):
    """A gain of the wrong sign is a no."""
    (tmp_path / "mine.py").write_text(line_text("period=1e-3, duration=2.0", f"fp.Affine(gain={gain})"))
    assert main(["review", str(tmp_path / "mine.py"), "--json"]) == code
    told = json.loads(capsys.readouterr().out)
    assert told["ready"] is (code == 0)
    for answer in (a for some in told["answers"].values() for a in some):
        assert set(answer) == {"key", "question", "verdict", "numbers", "of", "change", "evidence"}
        assert re.fullmatch(r"([A-Z0-9][^()]*\.)?", answer["evidence"])
        assert answer["key"] != "gain" or (answer["numbers"]["recommended_times"] < 0) is (code == 1)
