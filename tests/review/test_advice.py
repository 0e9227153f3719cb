"""Every change that a review names was run: a review of the loop with it passes, and asks for no other."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import tasks
from helpers.reviewed import answers, biased, heater, mass, plans, torque

import fpirhc as fp
from fpirhc.__main__ import main


def motor(stronger: float = 2.86, **settings: Any) -> fp.Problem:
    """A motor whose plant answers so many times as strongly as its model."""
    gain = fp.Parameter(3.5, 3.5 * stronger, "rad/s^2/V")
    plant = fp.Plant({"q": "rad"}, {"V": "V"}, {"gain": gain}, lambda q, v, u, p: {"q": p.gain * u.V - 2 * v.q})
    usual: dict[str, Any] = {"period": 2e-3, "duration": 4.0, "measure_from": 1.0}
    usual |= {"limits": fp.Limits(inputs={"V": (-12.0, 12.0)}), "start": {"q": 0.0, "q'": 2.0}}
    return fp.Problem(plant, fp.Trajectory(lambda t: {"q": ca.sin(2 * t)}), **(usual | settings))


def law(gain: float, rate: float = 8.0) -> fp.ComputedTorque:
    return fp.ComputedTorque(fp.Exponential(rate), fp.ModelReferenced(fp.Sigmoid(gain)))


NOISY = fp.Sensing({"q": fp.Sensor(noise=fp.Noise(3e-5))}, fp.SavitzkyGolay(window=21, degree=2))
OWN = (
    (motor(), law(-9.0)),
    (motor(1.2), law(0.01)),
    (motor(0.7, sensing=NOISY), law(2.0)),
    (mass(), torque(-20.0)),
    (motor(0.7, dead_time=fp.DeadTime({"V": 0.01})), fp.Predicted(law(1.0), inputs=0.01)),
)


@pytest.mark.parametrize(("problem", "own"), OWN)
def test_a_recommended_gain_is_admitted_helps_and_asks_for_no_other(problem, own):
    """Refused, too small, too large, and two of the wrong sign, one with a noisy encoder; set by the path that is named."""
    told = answers(problem, own)["gain"]
    [path] = re.findall(r"^Set (\S+) to -\S+\.", told.change)
    new = fp.with_settings(own, {path: told.numbers["recommended_gain"]})
    run, alone = (fp.simulate(problem, c, seed=0, compiled=False) for c in (new, new.with_deformation(fp.Identity())))
    assert fp.measure(problem, run).rms_error["q"] < fp.measure(problem, alone).rms_error["q"]  # and none is refused
    then = answers(problem, new)["gain"]
    assert (then.verdict, then.change, then.numbers["recommended_times"]) == ("yes", "", 1)


def test_a_refusal_names_another_gain_than_the_one_that_is_refused():
    with pytest.raises(fp.FpirhcError) as refused:
        fp.compare(tasks.made(motor(), {"it": law(-9.0)}), seed=0, compiled=False)
    assert re.search(r"use 0 < \|gain\| < 1\.76, .* Set deformation\.gain to -1\.125\.$", str(refused.value))


def behind_an_actuator(lag: float) -> fp.Problem:
    """A motor on whose actuator the model's torque acts at once."""
    response = lambda q, v, u, p: {"q": 5.6 * q.act - 4 * v.q, "act": (u.V - q.act) / lag}  # noqa: E731
    real = fp.Plant({"q": "rad", "act": "V"}, {"V": "V"}, {}, response, order={"q": 2, "act": 1})
    return motor(1.0, period=5e-3, duration=6.0, reality=fp.Reality(real, start={"act": 0.0}))


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
    assert vain.startswith("None of the changes that were run helps, 7 in all: rate, limits, speed (rate 0.25, 1, ")


@pytest.mark.parametrize(
    ("limit", "noise", "own", "window"),
    [(12, 2e-4, fp.SavitzkyGolay(5, 2), 41), (1.75, 1e-3, fp.PositionDifference(), 31)],
)
def test_another_estimator_is_named_where_noise_moves_the_command(limit, noise, own, window):
    """Not wider limits where it stands at them by noise alone."""
    problem = motor(1.0, sensing=fp.Sensing({"q": fp.Sensor(noise=fp.Noise(noise))}, own))
    found = answers(replace(problem, limits=fp.Limits({"V": (-limit, limit)})), fp.ComputedTorque(fp.Exponential(8.0)))
    told = found["noise" if limit > 6 else "input_limits"]
    assert told.change.startswith(f"Take the estimator SavitzkyGolay(window={window}, degree=2).")
    assert limit > 6 or "in 0 % without noise" in told.evidence


def test_what_passes_at_twice_the_error_is_named_with_its_price():
    seen = fp.Sensing({"x": fp.Sensor(noise=fp.Noise(9e-3)), "x'": fp.Sensor(noise=fp.Noise(6e-2))})
    told = answers(replace(biased(0.0), sensing=seen, duration=4.0), plans(iterations=3)["RHC"])["noise"].change
    assert re.search(r'rate={"F": 1\.0}\)\. The error is then 1\.8\d times as large\.$', told)


def heated(limits: fp.Limits, swing: float = 1.0) -> fp.Problem:
    """A room that needs 0.9 to 3.7 K/s, or with another swing more."""
    wave = fp.Trajectory(lambda t: {"T": 2 + swing * ca.sin(0.5 * t)})
    return replace(heater(), reference=wave, start={"T": 2.0}, duration=20.0, measure_from=3.0, limits=limits)


ENDS = ("0.0, 2.0", "0.0, 4.9"), ("1.8, 12.0", "0.0, 12.0"), ("-4.0, 1.5", "-4.0, 4.9"), ("2.0, inf", "0.0, math.inf")


@pytest.mark.parametrize(("ends", "wider"), ENDS)
def test_limits_are_widened_at_the_end_where_commands_stand_and_not_beyond_zero(ends, wider):
    low, high = map(float, ends.split(","))
    found = answers(heated(fp.Limits({"u": (low, high)}), 1.6), fp.ComputedTorque(fp.Exponential(3.0)))
    assert found["input_limits"].change == f'Widen the limits of the inputs: Limits(inputs={{"u": ({wider})}}).'


def test_a_change_with_which_a_no_is_a_caution_is_said_to_be_no_yes():
    limits, form = fp.Limits({"u": (-9.0, 9.0)}, rates={"u": (-0.2, 0.2)}), fp.ModelReferenced(fp.Affine(-0.5))
    told = answers(heated(limits), fp.ComputedTorque(fp.Exponential(3.0), form))["input_limits"]
    assert (told.verdict, told.change[-41:]) == ("no", "It helps, but the answer is then caution.")


@pytest.mark.parametrize("wrong", ["model", "reality", "both", "map"])
def test_a_wrong_sign_is_called_so(wrong):
    """Of the model's parameter, of what moves, of an input that is positive, and of the map's gain."""
    problem, own = motor(-1.6 if wrong == "model" else 1.6), fp.ComputedTorque(fp.Exponential(8.0))
    if wrong == "reality":
        real = replace(problem.plant, response=lambda q, v, u, p: {"q": -p.gain * u.V - 2 * v.q})
        problem = replace(problem, reality=fp.Reality(real))
    if wrong == "both":
        cooled = replace(heater().plant, response=lambda x, u, p: {"T": -u.u - p.a * x.T})
        problem = replace(heater(), plant=cooled, reference=fp.Trajectory(lambda t: {"T": 2 + ca.sin(t)}))
    found = answers(problem, law(0.5) if wrong == "map" else own)
    bad = {a.change for a in found.values() if a.verdict in ("caution", "no")}
    assert [" sign" in one for one in bad] == [True] * (1 + (wrong == "model"))  # which the problem has, too


def test_a_slip_of_units_is_named_where_a_controller_does_not_fit_and_where_it_is_lost():
    known, falls = {"m": fp.Parameter(5e-5, 0.05, "kg")}, lambda q, v, u, p: {"q": (u.u - v.q) / p.m}
    light = fp.Plant({"q": "m"}, {"u": "N"}, known, falls)
    problem = mass(plant=light, horizon=fp.Horizon(20, 0.02), cost=fp.Quadratic({"q": 1e2}, deviation={"u": 1e-2}))
    mend = "Mend m of the model: is it a slip of units?"
    [fits] = answers(
        problem, fp.RecedingHorizon(fp.FixedPointSolver())
    ).values()  # that it does not fit is all that is said
    assert (fits.key, fits.verdict, fits.change.startswith(f"{mend} FixedPointSolver")) == ("fits", "no", True)
    first, *others = (a for a in answers(problem).values() if a.change)
    assert (first.evidence, {a.change for a in others}) == ("In the model m is 0.001 times the plant's.", {mend})


KILO = "Divide the reference by 1 000: is it a slip of units?"
LESS = "Set the noise of q to 0.005 m: is it a slip of units?"
SLIPS = (
    ({"reference": fp.Trajectory(lambda t: {"q": 500 * ca.cos(t)}), "start": {"q": 0.5}}, "reference of q begins at", KILO),
    ({"reference": fp.Trajectory(lambda t: {"q": 500 * ca.sin(t)})}, "reference needs 112 times the limits of u.", KILO),
    ({"sensing": fp.Sensing({"q": fp.Sensor(fp.Noise(5.0))}, fp.SavitzkyGolay(15, 2))}, "noise of q is 5 m, and its", LESS),
    ({"sensing": fp.Sensing({"q": fp.Sensor(fp.Noise(5e3))}, fp.SavitzkyGolay(15, 2))}, "noise of q is 5 000 m, and its", LESS),
    ({"plant": replace(mass().plant, coordinates={"q": "rad"}), "reference": fp.Trajectory(lambda t: {"q": 50 * ca.sin(t)})},
     "reference needs 11.2 times the limits of u.", "Divide the reference by 57.3: is it a slip of units?"),
)  # fmt: skip


@pytest.mark.parametrize(("fields", "told", "change"), SLIPS)
def test_other_units_are_named_first_and_are_what_mends_a_loop_that_does_not_follow(fields, told, change):
    problem = mass(**fields, limits=fp.Limits(inputs={"u": (-20.0, 20.0)}))
    (key, first), *others = answers(problem, fp.ComputedTorque(fp.Exponential(6.0))).items()
    assert (key, first.evidence[: 4 + len(told)], first.change) == ("sizes", f"The {told}", change)
    assert [a.change for key, a in others if key == "follows"] == [change] * ("noise" not in told)  # it hides all else


def test_a_response_without_a_value_on_the_reference_is_named_with_its_place():
    plant = replace(heater().plant, response=lambda x, u, p: {"T": u.u - ca.sqrt(0.5 - x.T)})
    plan = {"horizon": fp.Horizon(5, 0.1), "cost": fp.Quadratic({"T": 1.0}, deviation={"u": 1.0}, rate={"u": 1.0})}
    [fits] = answers(replace(heater(), plant=plant, start={"T": 0.2}, **plan), plans()["RHC"]).values()
    assert (
        "T = 1: no command gives the response that is needed; look at signs, roots and divisions in test_adv"
        in fits.change
    )


def test_a_forgotten_estimator_is_told():
    """Not where there is one, where a derivative has a sensor, or of a bias, which is in no derivative."""
    noisy, biased = {"q": fp.Sensor(fp.Noise(1e-4))}, {"q": fp.Sensor(fp.Step(0.0, 1e-4))}
    seen = (
        fp.Sensing(noisy),
        fp.Sensing({"q": fp.Sensor(quantum=1e-4)}),
        fp.Sensing(noisy, NOISY.estimator),
        fp.Sensing(noisy | {"q'": fp.Sensor()}),
        fp.Sensing(biased),
    )
    found = [answers(motor(0.7, sensing=one, duration=1.5), law(1.0)).get("noiseless") for one in seen]
    assert [told and (told.verdict, told.of) for told in found] == [("caution", "q', q''")] * 2 + [None] * 3


def pushed_away(force: float, **settings: Any) -> fp.Problem:
    """A mass that a spring pushes away, which at most this force holds."""
    known = {name: fp.Parameter(value, value, "1") for name, value in (("k", 4.0), ("b", 1.0))}
    plant = fp.Plant({"q": "m"}, {"u": "N"}, known, lambda q, v, u, p: {"q": p.k * q.q + p.b * u.u})
    wave, ends = fp.Trajectory(lambda t: {"q": 0.05 * ca.sin(t)}), fp.Limits(inputs={"u": (-force, force)})
    return fp.Problem(plant, wave, {"q": 0.0, "q'": 0.05}, period=1e-2, duration=10.0, limits=ends, **settings)


def test_limits_are_named_where_a_push_is_lost_at_them():
    """It comes back from a tenth of its range alone with a larger force."""
    found = answers(pushed_away(0.2505), fp.ComputedTorque(fp.Exponential(rate=3.0)))
    assert found["returns"].numbers["at_a_limit"] > 0.2 > found["input_limits"].numbers["at_a_limit"]
    assert found["returns"].change.endswith('the limits of the inputs: Limits(inputs={"u": (-0.501, 0.501)}).')
    assert answers(pushed_away(0.501), fp.ComputedTorque(fp.Exponential(rate=3.0)))["returns"].verdict == "yes"


@pytest.mark.parametrize(
    ("force", "late", "rate", "key", "words"),
    [(1e3, 0.31, 1.2, "input_gain", "With 0.7 and 1.4"), (0.252, 0.17, 3.0, "box", "4 of 4 trial plants: one with")],
)
def test_what_bears_nothing_is_said_so(force, late, rate, key, words):
    """By a late command it swings with more gain, and falls with less; a little force holds no other plant."""
    problem = pushed_away(force, dead_time=fp.DeadTime({"u": late}))
    own = fp.ComputedTorque(fp.Exponential(rate, integral=False))
    assert words in answers(problem, own, mismatch=40.0)[key].evidence


def test_the_model_is_a_trial_plant_with_a_mismatch_and_without_and_is_named():
    """A spring of 6 N/m pulls with more than the largest force."""
    problem, own = pushed_away(0.28), fp.ComputedTorque(fp.Exponential(rate=3.0))
    known = {**problem.plant.parameters, "k": fp.Parameter(6.0, 4.0, "1")}
    problem = replace(problem, plant=replace(problem.plant, parameters=known))
    for wide, count in ((0.0, 2), (5.0, 6)):
        told = answers(problem, own, mismatch=wide)["box"].evidence
        assert told.startswith(f"It is lost on 1 of {count} trial plants: the model itself, ")


def test_the_worked_review_of_the_page_is_what_the_command_prints(tmp_path: Path, monkeypatch, capsys):
    """From no to yes: what is advised is set, and nothing is left to do; --verbose has the rows that are yes."""
    page = (Path(__file__).parents[2] / "docs" / "review.md").read_text()
    [shown] = re.findall(r"```text\n(RHC.*?)```", page, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    assert main(["new", "my_plant"]) == 0
    text, told = Path("my_plant.py").read_text(), []
    for code, gain, options in ((1, "1.0", []), (0, "-1", []), (0, "-1", ["--verbose"])):
        Path("my_plant.py").write_text(text.replace("gain=-1.0", f"gain={gain}"))
        assert main(["review", "my_plant.py", "-c", "RHC+FPI", *options]) == code
        told.append(" ".join(capsys.readouterr().out.split()))
    assert re.search(".*".join(re.escape(" ".join(part.split())) for part in shown.split("...")), told[0])
    counts = told[0].count("->"), told[1].count("->"), told[2].count("yes Do"), told[1].count("recommended gain: -1 ")
    assert counts == (2, 0, 7, 1)


def test_a_review_ends_where_a_gain_mends_another_row_than_its_own():
    seen, late = fp.Sensing({"q''": fp.Sensor(fp.Noise(0.3))}), fp.DeadTime({"u": 0.01})
    found = answers(mass(period=5e-3, sensing=seen, dead_time=late, measure_from=2.0), torque(-0.1))
    assert ["None of the changes" in found[key].change for key in ("gain", "model")] == [True, False]


def test_rows_of_one_controller_agree_on_its_gain():
    """By itself one row would lower the gain and another leave adaptation out, which mends both."""
    plan = {"horizon": fp.Horizon(15, 2e-2), "cost": fp.Quadratic({"q": 1e2, "q'": 1.0}, deviation={"u": 1e-2})}
    ends = fp.Limits(inputs={"u": (-30.0, 30.0)}, states={"q'": (-1.0, 1.0)}, prices={"q'": 1e4})
    fast = {"reference": fp.Trajectory(lambda t: {"q": 0.5 * ca.sin(5 * t)}), "start": {"q": 0.3}, "period": 5e-3}
    own = fp.RecedingHorizon(fp.FixedPointSolver(), fp.ModelReferenced(fp.Sigmoid(-1.0)))
    told = answers(mass(limits=ends, measure_from=1.0, **plan, **fast), own)
    assert {told[key].change for key in ("follows", "pays")} == {"Leave the deformation out."}
