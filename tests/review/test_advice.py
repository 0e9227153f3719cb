"""Every change that a review names was run: a review of the loop with it passes, and asks for no other."""

import re
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from helpers import tasks
from helpers.plants import heavy
from helpers.reviewed import NOISY, answers, behind_an_actuator, heater, law, mass, motor, plans, pushed_away

import fpirhc as fp
from fpirhc.__main__ import main


def test_a_refusal_names_another_gain_than_the_one_that_is_refused():
    with pytest.raises(fp.FpirhcError) as refused:
        fp.compare(tasks.made(motor(), {"it": law(-9.0)}), seed=0, compiled=False)
    assert re.search(r"use 0 < \|gain\| < 1\.76, .* Set deformation\.gain to -1\.125\.$", str(refused.value))


@pytest.mark.parametrize("gain", [-0.125, -4.0])
def test_the_recommended_gain_is_not_that_of_the_file(gain):
    """Of gains whose errors differ by less than a tenth it is the one with which noise moves the command least."""
    known = {"K": fp.Parameter(1.0, 0.7, "1/s"), "push": fp.Parameter(0.0, 0.5, "1")}
    plant = fp.Plant({"q": "rad"}, {"u": "rad"}, known, lambda q, v, u, p: {"q": p.K * u.u - v.q + p.push})
    compass = fp.Sensing({"q": fp.Sensor(noise=fp.Noise(2e-4))}, fp.SavitzkyGolay(window=31, degree=2))
    wave, ends = fp.Trajectory(lambda t: {"q": 0.4 * ca.sin(t)}), fp.Limits(inputs={"u": (-9.0, 9.0)})
    shown = {"measure_from": 4.0, "limits": ends, "sensing": compass}
    ship = fp.Problem(plant, wave, {"q": 0.0}, period=1e-2, duration=12.0, **shown)
    own = fp.ComputedTorque(fp.Exponential(rate=3.0), fp.ModelReferenced(fp.Sigmoid(gain=gain)))
    assert answers(ship, own)["gain"].numbers["recommended_gain"] == -1.0


def test_a_lag_is_named_where_no_gain_helps():
    """An own run with the one that is named is nearer than with another, or without adaptation, and today's is the worst."""
    problem, own = behind_an_actuator(0.4), law(-1.5, 3.0)
    [lag] = re.findall(r"lag=(\S+) of ", answers(problem, own)["pays"].change)
    stated = [replace(own, deformation=replace(own.deformation, lag=one)) for one in (float(lag), 0.16)]  # both pass
    laws = *stated, own.with_deformation(fp.Identity()), own
    errors = [fp.measure(problem, fp.simulate(problem, c, seed=0, compiled=False)).rms_error["q"] for c in laws]
    assert errors == sorted(errors)


def test_a_filter_of_disturbances_is_named_where_no_gain_helps():
    """With the one that is named an own run follows more than twice as well."""
    task = tasks.leaking_tanks
    told = answers(task.problem, own := task.controllers["RHC"])["follows"].change
    [filter_] = re.findall(r"Estimating\(controller, (.*)\)\.$", told)
    laws = own, fp.Estimating(own, eval(f"fp.{filter_}"))
    runs = [fp.simulate(task.problem, one, seed=0, compiled=False) for one in laws]
    errors = [fp.measure(task.problem, run).rms_error["h2"] for run in runs]
    assert errors[1] < errors[0] / 2


def lift() -> fp.Problem:
    """It is pushed away from where it should be, and its mass is half as much again as in the model."""
    known = {"m": fp.Parameter(400.0, 650.0, "kg"), "k": fp.Parameter(0.0, 9000.0, "N/m")}
    moves = lambda q, v, u, p: {"h": (u.F + p.k * q.h - 1500 * v.h) / p.m - 9.81}  # noqa: E731
    plant = fp.Plant({"h": "m"}, {"F": "N"}, known, moves)
    wave = fp.Trajectory(lambda t: {"h": 0.5 - 0.4 * ca.cos(0.8 * t)})
    return fp.Problem(plant, wave, {"h": 0.1}, period=5e-3, duration=8.0, measure_from=2.0,
                      limits=fp.Limits(inputs={"F": (-2e4, 3e4)}))  # fmt: skip


def test_the_rate_that_is_named_is_the_one_that_passes():
    """Half and twice the rate are lost in own runs, four times is not; where every rate is, that is what is said."""
    errors = {}
    for rate in (1.0, 4.0, 8.0):
        run = fp.simulate(lift(), fp.ComputedTorque(fp.Exponential(rate, integral=False)), seed=0, compiled=False)
        errors[rate] = np.inf if run.stop else fp.measure(lift(), run).rms_error["h"]
    assert errors[8.0] < min(0.4, errors[1.0] / 2, errors[4.0] / 2)
    two, one = (fp.ComputedTorque(fp.Exponential(rate, integral=False)) for rate in (2.0, 0.5))
    told, vain = (answers(lift(), rate)["input_limits"].change for rate in (two, one))
    assert told == "Set the rate of the tracking law to 8."
    assert vain.startswith("None of the changes that were run helps, 6 in all: rate, speed (rate 0.25, 1, ")


@pytest.mark.parametrize("wrong", ["model", "reality", "map"])
def test_a_wrong_sign_is_called_so(wrong):
    """Of the model's parameter, of what moves, and of the map's gain."""
    problem, own = motor(-1.6 if wrong == "model" else 1.6), fp.ComputedTorque(fp.Exponential(8.0))
    if wrong == "reality":
        real = replace(problem.plant, response=lambda q, v, u, p: {"q": -p.gain * u.V - 2 * v.q})
        problem = replace(problem, reality=fp.Reality(real))
    found = answers(problem, law(0.5) if wrong == "map" else own)
    bad = {a.change for a in found.values() if a.verdict in ("caution", "no")}
    assert [" sign" in one for one in bad] == [True] * (1 + (wrong == "model"))  # which the problem has, too


def test_a_slip_of_units_is_named_where_a_controller_does_not_fit_and_where_it_is_lost():
    known, falls = {"m": fp.Parameter(5e-5, 0.05, "kg")}, lambda q, v, u, p: {"q": (u.u - v.q) / p.m}
    light = fp.Plant({"q": "m"}, {"u": "N"}, known, falls)
    problem = mass(plant=light, horizon=fp.Horizon(20, 0.02), cost=fp.Quadratic({"q": 1e2}, deviation={"u": 1e-2}))
    mend = "Mend m of the model: is it a slip of units?"
    [fits] = answers(problem, fp.RecedingHorizon(fp.FixedPointSolver())).values()  # it is all that is said
    assert (fits.key, fits.verdict, fits.change.startswith(f"{mend} FixedPointSolver")) == ("fits", "no", True)
    first, *others = (a for a in answers(problem).values() if a.change)
    assert (first.evidence, {a.change for a in others}) == ("In the model m is 0.001 times the plant's.", {mend})


def test_no_weight_is_named_with_which_a_noisy_loop_moves_more():
    """A plan that pays less for its command swings by itself, so that noise no longer doubles its movement."""
    known = {
        "m": fp.Parameter(1800.0, 1200.0, "1"),
        "dry": fp.Parameter(0.0, 400.0, "1"),
        "k": fp.Parameter(1e3, 3e3, "1"),
    }
    moves = lambda q, v, u, p: {"q": (u.M - 900 * v.q - p.dry * ca.tanh(v.q / 5e-3) - p.k * ca.sin(2 * q.q)) / p.m}  # noqa: E731
    blade, wave = (
        fp.Plant({"q": "rad"}, {"M": "N m"}, known, moves),
        fp.Trajectory(lambda t: {"q": 0.2 + 0.1 * ca.sin(t)}),
    )
    task = {"period": 5e-3, "duration": 12.0, "measure_from": 4.0, "limits": fp.Limits(inputs={"M": (-6e3, 6e3)})}
    task |= {"horizon": fp.Horizon(20, 0.03), "cost": fp.Quadratic({"q": 1e4, "q'": 1e2}, deviation={"M": 1e-5})}
    shown = fp.Sensing({"q": fp.Sensor(noise=fp.Noise(2e-4))}, fp.SavitzkyGolay(window=11, degree=2))
    own = fp.RecedingHorizon(fp.FixedPointSolver(), fp.ModelReferenced(fp.Sigmoid(gain=-0.5)))
    found = answers(fp.Problem(blade, wave, {"q": 0.2}, sensing=shown, **task), own)["noise"]
    assert found.verdict == "caution"
    assert "weight of the deviation" not in found.change


@pytest.mark.parametrize(("ratio", "slip"), [(9.9, False), (10.1, True), (0.101, False), (0.099, True)])
def test_a_parameter_ten_times_the_plants_is_a_slip(ratio, slip):
    told = (answer.evidence for answer in answers(mass(plant=heavy(ratio, 1.0), duration=0.5)).values())
    assert any("times the plant's" in one for one in told) == slip


def test_a_response_without_a_value_on_the_reference_is_named_with_its_place():
    plant = replace(heater().plant, response=lambda x, u, p: {"T": u.u - ca.sqrt(0.5 - x.T)})
    plan = {"horizon": fp.Horizon(5, 0.1), "cost": fp.Quadratic({"T": 1.0}, deviation={"u": 1.0}, rate={"u": 1.0})}
    [fits] = answers(replace(heater(), plant=plant, start={"T": 0.2}, **plan), plans()["RHC"]).values()
    told = "T = 1: no command gives the response that is needed; look at signs, roots and divisions in test_adv"
    assert told in fits.change


def test_a_forgotten_estimator_is_told():
    """Not where there is one, where a derivative has a sensor, or of a bias, which is in no derivative."""
    noisy, other = fp.Sensor(fp.Noise(1e-4)), (fp.Sensor(quantum=1e-4), fp.Sensor(fp.Step(0.0, 1e-4)))
    seen = [fp.Sensing({"q": one}) for one in (noisy, *other)]
    seen[2:2] = fp.Sensing({"q": noisy}, NOISY.estimator), fp.Sensing({"q": noisy, "q'": fp.Sensor()})
    found = [answers(motor(0.7, sensing=one, duration=1.5), law(1.0)).get("noiseless") for one in seen]
    assert [told and (told.verdict, told.of) for told in found] == [("caution", "q', q''")] * 2 + [None] * 3


def test_limits_are_named_where_a_push_is_lost_at_them():
    """It comes back from a tenth of its range alone with a larger force."""
    found = answers(pushed_away(0.2505), fp.ComputedTorque(fp.Exponential(rate=3.0)))
    assert found["returns"].numbers["at_a_limit"] > 0.2 > found["input_limits"].numbers["at_a_limit"]
    [force] = re.findall(r'Widen the limits of the inputs: Limits.*"u": \(-\S+, (\S+)\)}\)\.$', found["returns"].change)
    assert answers(pushed_away(float(force)), fp.ComputedTorque(fp.Exponential(rate=3.0)))["returns"].verdict == "yes"


def test_the_worked_review_of_the_page_is_what_the_command_prints(tmp_path: Path, monkeypatch, capsys):
    """From no to yes: what is advised is set, and nothing is left to do; --verbose has the rows that are yes."""
    page = (Path(__file__).parents[2] / "docs" / "review.md").read_text()
    shown = re.findall(r"```text\n(RHC.*?)```", page, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    assert main(["new", "my_plant"]) == 0
    text, told = Path("my_plant.py").read_text(), []
    for code, gain, options in ((1, "1.0", []), (0, "-0.05", []), (0, "-1", []), (0, "-1", ["--verbose"])):
        Path("my_plant.py").write_text(text.replace("gain=-1.0", f"gain={gain}"))
        assert main(["review", "my_plant.py", "-c", "RHC+FPI", *options]) == code
        told.append(" ".join(capsys.readouterr().out.split()))
    for text, one in zip(shown, told, strict=False):
        assert re.search(".*".join(re.escape(" ".join(part.split())) for part in text.split("...")), one)
    counts = told[0].count("->"), told[2].count("->"), told[3].count("yes Do"), told[2].count("recommended gain: -1 ")
    assert (len(shown), *counts) == (2, 2, 0, 7, 1)


def test_a_swing_that_grows_until_limits_hold_it_is_a_no_and_a_shorter_window_mends_it():
    seen = fp.Sensing({"q": fp.Sensor(fp.Noise(3e-5))}, fp.SavitzkyGolay(79, 2))
    told = answers(motor(1.0, sensing=seen), fp.ComputedTorque(fp.Exponential(8.0)))["returns"]
    assert (told.verdict, told.change[:43]) == ("no", "Take the estimator SavitzkyGolay(window=39,")


def test_a_window_that_harms_another_controller_is_named_with_its_harm():
    problem = motor(1.0, sensing=fp.Sensing({"q": fp.Sensor(noise=fp.Noise(2e-4))}, fp.SavitzkyGolay(5, 2)))
    laws = {name: fp.ComputedTorque(fp.Exponential(rate)) for name, rate in (("slow", 8.0), ("fast", 40.0))}
    told = {a.key: a for a in fp.review(problem, laws, mismatch=0.0, seed=0).answers["slow"]}["noise"].change
    assert re.match(r"Take the estimator SavitzkyGolay\(window=41, degree=2\)\..* But fast then gets a ", told)


def test_limits_that_are_too_small_are_one_row_of_the_problem():
    laws = {name: fp.ComputedTorque(fp.Exponential(rate)) for name, rate in (("slow", 3.0), ("fast", 6.0))}
    wave, ends = fp.Trajectory(lambda t: {"T": 2 + 1.6 * ca.sin(0.5 * t)}), fp.Limits({"u": (0.0, 2.0)})
    problem = replace(heater(), reference=wave, start={"T": 2.0}, duration=20.0, measure_from=3.0, limits=ends)
    found = fp.review(problem, laws, mismatch=0.0, seed=0).answers
    [cause] = found["problem"]
    assert (cause.key, cause.verdict) == ("input_limits", "no")
    assert {a.change for name in laws for a in found[name] if a.verdict in ("no", "caution")} == {cause.change}


def test_a_reality_with_more_states_is_no_exact_model_which_is_unknown():
    [told] = answers(behind_an_actuator(0.4), fp.ExactModel(law(-1.5))).values()
    assert (told.verdict, told.change[-20:]) == ("unknown", "leave ExactModel out")
