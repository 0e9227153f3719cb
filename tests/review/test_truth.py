"""What a review says beside the truth: small plants on which answers of a theory were false, and runs of the loop are right.

A case has a problem, controllers, and what is said of them: verdicts by name and key, and numbers with what they must be near.
Truths are closed forms or runs by `fpirhc.simulate` of another start, gain or model.
"""

import json
import math
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from abroad import load
from helpers import reviewed
from helpers.kinds import slow_but
from helpers.reviewed import NOISY, answers, ball, biased, heated, heater, law, mass, motor, plans, torque, turntable

import fpirhc as fp

KEPT = Path(__file__).parents[1] / "data" / "reviews.json"
UNWRAP = "Unwrap the angle that jumps by a whole turn, or weigh 1 - cos of its error."
SEVEN = "Take the estimator SavitzkyGolay(window=7, degree=1)."
Pick = Callable[[], tuple[fp.Problem, dict[str, Any]]]
LEAVE = "Leave the deformation out."
MORE = "Give the optimiser more iterations, or a smaller tolerance, before anything else."


@dataclass(frozen=True)
class Case:
    """Who is asked, and what is said."""

    task: Pick
    verdicts: dict[tuple[str, str], str] = field(default_factory=dict)  # by whom it is about, and the key
    numbers: dict[tuple[str, str, str], tuple[float, float]] = field(default_factory=dict)  # value, its tolerance
    never: tuple[str, ...] = ()  # about whom there is no no
    changes: dict[tuple[str, str], str] = field(default_factory=dict)
    told: dict[tuple[str, str], str] = field(default_factory=dict)  # how the evidence begins
    mismatch: float = 0.0


def of(task: Callable[[], tuple[fp.Problem, Any]], *rows: str, mismatch: float = 0.0) -> Case:
    """A case of one controller: (key, advice) and (key, how the evidence begins), each 'key: words' or 'key = words'."""
    both: dict[str, dict[tuple[str, str], str]] = {": ": {}, " = ": {}}
    for row in rows:
        sign = ": " if ": " in row.strip().partition(" ")[0] + " " else " = "
        key, _, words = row.partition(sign)
        both[sign]["problem" if key in ("sizes", "inside", " input_limits") else "it", key.strip()] = words
    return Case(lambda: ((made := task())[0], {"it": made[1]}), changes=both[": "], told=both[" = "], mismatch=mismatch)


def shipped(name: str, *controllers: str, of: Callable[[str], Any] = fp.load_problem) -> Pick:
    def made() -> tuple[fp.Problem, dict[str, Any]]:
        task = of(name)
        return task.problem, {n: task.controllers[n] for n in controllers}

    return made


def foreign(name: str, *controllers: str, variant: str = "problem") -> Pick:
    return shipped(name, *controllers, of=lambda n: load(n, variant))


sigmoid = lambda gain: fp.RecedingHorizon(fp.FixedPointSolver(), fp.ModelReferenced(fp.Sigmoid(gain=gain)))  # noqa: E731
LOADED = lambda q, v, u, p: {"q": u.u, "load": 100 * (q.q - q.load) - 0.3 * v.load}  # noqa: E731
PLANT = fp.Plant({"q": "rad", "load": "rad"}, {"u": "rad/s^2"}, {}, LOADED, controlled=["q"])
SINES = fp.Trajectory(lambda t: {"q": ca.sin(t), "load": ca.sin(t)})
SWINGING = fp.Problem(PLANT, SINES, {"q": 0.0, "load": 0.0}, period=2e-3, duration=4.0)
SERVO = -1.0, -1.97, -2.12
DERIVED = fp.SavitzkyGolay(15, 2)
KILO = "Divide the reference by 1 000: is it a slip of units?"
LESS = "Set the noise of q to 0.005 m: is it a slip of units?"
LATE = fp.DeadTime({"V": 0.01})
OWN = {
    "a gain that is refused": lambda: (motor(), law(-9.0)),
    "a gain that is too small": lambda: (motor(1.2), law(0.01)),
    "a gain of the wrong sign behind a noisy encoder": lambda: (motor(0.7, sensing=NOISY), law(2.0)),
    "a gain that is too large": lambda: (mass(), torque(-20.0)),
    "a gain of the wrong sign behind a prediction": lambda: (motor(0.7, dead_time=LATE), fp.Predicted(law(1.0), 0.01)),
}


LONG_RUNS = {  # and how many seconds of them are run
    "a run of more than 4000 cycles": (lambda: mass(duration=5.0), 4.0),
    "errors that count late in a long run": (lambda: mass(duration=9.0, measure_from=3.0), 5.0),
}


def within(ends: tuple[float, float], rates: dict[str, Any] | None = None) -> fp.Problem:
    return heated(fp.Limits({"u": ends}, rates=rates or {}), 1.0 if rates else 1.6)


def follower(rate: float, **more: Any) -> fp.ComputedTorque:
    return fp.ComputedTorque(fp.Exponential(rate, **more))


def units(**fields: Any) -> tuple[fp.Problem, Any]:
    return mass(**fields, limits=fp.Limits(inputs={"u": (-20.0, 20.0)})), follower(6.0)


def seen(limit: float, noise: float, own: Any) -> tuple[fp.Problem, Any]:
    """A right model behind a noisy encoder."""
    sensing = fp.Sensing({"q": fp.Sensor(noise=fp.Noise(noise))}, own)
    return motor(1.0, sensing=sensing, limits=fp.Limits({"V": (-limit, limit)})), follower(8.0)


def stiff(force: float) -> fp.Problem:
    """The spring of the model pulls with 6 N/m."""
    one = reviewed.pushed_away(force)
    known = {**one.plant.parameters, "k": fp.Parameter(6.0, 4.0, "1")}
    return replace(one, plant=replace(one.plant, parameters=known))


CTC6, PAIRED = "CTC+FPI (eq 6)", "CTC+FPI paired"
CASES: dict[str, Case] = {
    "a room that comes back with the time constant of its loss": Case(
        lambda: (reviewed.slow_room(), {"RHC": plans(iterations=1)["RHC"]}),
        {("RHC", "returns"): "yes"},
        {("RHC", "returns", "factor"): (np.exp(-5e-4), 2e-5), ("RHC", "returns", "left"): (np.exp(-1.35), 0.1)}),
    "a limit of a rate": Case(
        lambda: (reviewed.limited_rate(), plans()),
        {("RHC", "limits"): "yes", ("RHC+FPI", "limits"): "yes", ("RHC+FPI", "pays"): "no"},
        {("RHC", "limits", "share_of_cycles"): (0, 0), ("RHC+FPI", "pays", "error_without"): (0.637, 0.01)},
        never=("problem",),
        changes={("RHC+FPI", "follows"): LEAVE}),
    "an angle that wraps": Case(
        lambda: (turntable(lambda t: ca.atan2(ca.sin(t), ca.cos(t))), plans(iterations=2)),
        {("problem", "turns"): "no"},
        {("problem", "turns", "jumps"): (1, 0)},
        changes={("problem", "turns"): UNWRAP, ("RHC+FPI", "input_limits"): UNWRAP, ("RHC+FPI", "pays"): UNWRAP}),
    "an angle that goes on": Case(
        lambda: (turntable(lambda t: t), plans(iterations=2)),
        {("problem", "turns"): "yes", ("RHC+FPI", "pays"): "yes", ("RHC+FPI", "returns"): "yes"},
        never=("problem", "RHC", "RHC+FPI")),
    "capped plans that lose the ball": Case(
        lambda: (ball(0.011), plans(iterations=1, tolerance=1e-2)),
        {("RHC", "plans"): "no", ("RHC", "follows"): "no"},
        changes={("RHC", "follows"): MORE}),
    "a servo and its recommended gain": Case(
        lambda: (reviewed.servo(), {str(g): plans(iterations=None, tolerance=None, gain=g)["RHC+FPI"] for g in SERVO}),
        {("-1.0", key): "no" for key in ("gain", "returns", "pays")},
        {(g, "pays", "error_with"): (e, 0.05 * e) for g, e in zip(map(str, SERVO), (0.0130, 2.28e-4, 2.27e-4), strict=True)},
        never=("problem", "-1.97", "-2.12"),
        changes={("-1.0", "returns"): "Set deformation.gain to -2."}),
    "a heater that would have to cool": Case(
        lambda: (reviewed.heater(), {"it": fp.ComputedTorque(fp.Exponential(3.0, integral=False))}),
        {("it", "input_limits"): "caution"},
        {("it", "input_limits", f"needed_{end}"): (u, 1e-3) for end, u in (("least", -1.13238), ("most", 3.53238))},
        changes={("it", "input_limits"): "Slow the reference to a quarter of its speed."}),
    "a map that swings while plans converge": Case(
        lambda: (reviewed.lift(), {"it": sigmoid(-1.0)}),
        {("it", "plans"): "yes", ("it", "gain"): "caution", ("it", "horizon"): "yes"},
        changes={("it", "gain"): "Set deformation.gain to -4."}),
    "a dead time that no gain makes up for": Case(
        lambda: (reviewed.tank(), {"it": sigmoid(-0.3), "predicted": fp.Predicted(sigmoid(-0.6), inputs=1.5)}),
        {("it", "gain"): "no", ("predicted", "gain"): "yes", ("predicted", "returns"): "caution"},
        {("it", "gain", "error_without"): (0.0865, 1e-3), ("it", "gain", "error"): (0.0956, 1e-3)},
        changes=dict.fromkeys([("it", "gain"), ("it", "pays")], SEVEN)),
    "a map of a right model behind a window that is too long": Case(
        lambda: (replace(reviewed.lift(), sensing=fp.Sensing({}, fp.SavitzkyGolay(41, 3))), {"it": sigmoid(-2.0)}),
        {("it", "model"): "no"},
        changes={("it", "model"): "Set deformation.gain to -0.0625."}),
    "the published iteration of two masses": Case(
        shipped("two_mass", "CTC", CTC6),
        {("CTC", "follows"): "no", (CTC6, "returns"): "yes", (CTC6, "pays"): "yes", (CTC6, "gain"): "yes"},
        {(CTC6, "returns", "factor"): (0.9964, 1e-3), (CTC6, "pays", "divided_by"): (80.0, 15.0)},
        never=("problem", CTC6)),
    "a gain that is too small for its pairing": Case(
        shipped("delayed_mass", PAIRED),
        {(PAIRED, "gain"): "no", (PAIRED, "pays"): "no"},
        changes={(PAIRED, "follows"): "Set deformation.gain to -2."}),
    "a biased sensor": Case(
        lambda: (biased(1.0), plans()),
        {("RHC+FPI", "pays"): "no"},
        changes={("RHC+FPI", "pays"): "Mend the sensors: without their noise and bias it passes."}),
    "upper tanks that move by themselves": Case(
        foreign("quadruple_tank", "RHC", "CTC+FPI"),
        {("CTC+FPI", "inner"): "yes"},
        {("CTC+FPI", "inner", "rate_with_outputs_held"): (-0.018, 4e-3)},  # Johansson's slower zero
        never=("RHC", "CTC+FPI")),
    "upper tanks of the other point": Case(
        foreign("quadruple_tank", "CTC+FPI", variant="nonminimum"),
        {("CTC+FPI", "inner"): "no"},
        {("CTC+FPI", "inner", "rate_with_outputs_held"): (0.013, 4e-3)}),
    "an own map behind a dead time": Case(
        foreign("own_map", "RHC+FPI", "RHC+FPI, increment"),
        {("RHC+FPI", key): "no" for key in ("returns", "model")}
        | {("RHC+FPI, increment", key): "yes" for key in ("returns", "model")} | {("RHC+FPI, increment", "latency"): "caution"}),
    "a load on a spring, a swing of which leaves exp(-2 pi .015) of the last": Case(
        lambda: (SWINGING, {"CTC": fp.ComputedTorque(fp.Exponential(8.0))}),
        {("CTC", "returns"): "caution"},
        {("CTC", "returns", "swing"): (0.910, 5e-3), ("CTC", "returns", "period"): (0.628, 3e-3)}),
    "twice as many of its swings": of(lambda: (replace(SWINGING, duration=8.0), follower(8.0))),
    "an effort that keeps a room cold": Case(
        lambda: (replace(reviewed.slow_room(), cost=fp.Quadratic({"T": 1e-2}, effort={"u": 1.0})), plans()),
        changes={("RHC", "follows"): "Move the weights of effort to deviation: it leaves out what holds the plant."}),
    "tanks that leak, whose plans end elsewhere": Case(
        shipped("leaking_tanks", "RHC+FPI"),
        {("RHC+FPI", "inner"): "yes", ("RHC+FPI", "follows"): "caution", ("RHC+FPI", "pays"): "caution"},
        changes={("RHC+FPI", "pays"): LEAVE}),
    "slots": Case(
        shipped("crane_slots", "slots+FPI"),
        {("slots+FPI", "follows"): "yes", ("slots+FPI", "pays"): "yes"},
        never=("slots+FPI",)),
    "a cascade whose target cures more than it spoils": Case(
        shipped("heat_exchanger", "Cascade, last target"),
        {("Cascade, last target", "model"): "yes", ("Cascade, last target", "pays"): "yes"},
        {("Cascade, last target", "model", "error_with"): (0.135, 1e-3)},
        never=("Cascade, last target",)),
    **{name: of(task) for name, task in OWN.items()},
    "an actuator that the model lacks": of(lambda: (reviewed.behind_an_actuator(0.4), law(-1.5, 3.0))),
    "an encoder that moves the command": of(lambda: seen(12, 2e-4, fp.SavitzkyGolay(5, 2)),
        "noise: Take the estimator SavitzkyGolay(window=41, degree=2). The error is then 6.3 times as large."),
    "an encoder that moves the command to its limits": of(lambda: seen(1.75, 1e-3, fp.PositionDifference()),
        "input_limits: Take the estimator SavitzkyGolay(window=31, degree=2)."),
    "what passes at twice the error": of(lambda: (
        replace(biased(0.0), duration=4.0, sensing=fp.Sensing(
            {"x": fp.Sensor(noise=fp.Noise(9e-3)), "x'": fp.Sensor(noise=fp.Noise(6e-2))})), plans(iterations=3)["RHC"]),
        'noise: Weigh the changes of the inputs: Quadratic(..., rate={"F": 1.0}). The error is then 1.84 times as large.'),
    "rates of an input that are far too low": of(
        lambda: (within((-9.0, 9.0), {"u": (-0.2, 0.2)}), replace(follower(3.0), deformation=fp.ModelReferenced(fp.Affine(-0.5)))),
        "input_limits: Slow the reference to a quarter of its speed. It helps, but the answer is then caution."),
    **{
        f"limits of {low} and {high}": of(
            lambda ends=(low, high): (within(ends), follower(3.0)),
            " " * (low < 1) + f'input_limits: Widen the limits of the inputs: Limits(inputs={{"u": ({wider})}}).',
        )
        for low, high, wider in (
            (0.0, 2.0, "0.0, 4.9"), (1.8, 12.0, "0.0, 12.0"), (-4.0, 1.5, "-4.0, 4.9"), (2.0, math.inf, "0.0, math.inf"),
            (0.0, 0.8, "0.0, 4.9"),
        )
    },
    "a reference that begins in millimetres": of(
        lambda: units(reference=fp.Trajectory(lambda t: {"q": 500 * ca.cos(t)}), start={"q": 0.5}),
        "sizes = The reference of q begins at", f"sizes: {KILO}", f"follows: {KILO}"),
    "a reference in millimetres": of(
        lambda: units(reference=fp.Trajectory(lambda t: {"q": 500 * ca.sin(t)})),
        "sizes = The reference needs 112 times the limits of u.", f"sizes: {KILO}", f"follows: {KILO}"),
    "noise in millimetres": of(
        lambda: units(sensing=fp.Sensing({"q": fp.Sensor(fp.Noise(5.0))}, DERIVED)),
        "sizes = The noise of q is 5 m, and its", f"sizes: {LESS}"),
    "noise in micrometres": of(
        lambda: units(sensing=fp.Sensing({"q": fp.Sensor(fp.Noise(5e3))}, DERIVED)),
        "sizes = The noise of q is 5 000 m, and its", f"sizes: {LESS}"),
    "an angle in degrees": of(
        lambda: units(plant=replace(mass().plant, coordinates={"q": "rad"}),
                      reference=fp.Trajectory(lambda t: {"q": 50 * ca.sin(t)})),
        "sizes = The reference needs 11.2 times the limits of u.", "sizes: Divide the reference by 57.3: is it a slip of units?"),
    "a late command that swings with more gain and falls with less": of(
        lambda: (reviewed.pushed_away(1e3, dead_time=fp.DeadTime({"u": 0.31})), follower(1.2, integral=False)),
        "input_gain = With 0.7 and 1.4", mismatch=40.0),
    "a little force that holds no other plant": of(
        lambda: (reviewed.pushed_away(0.252, dead_time=fp.DeadTime({"u": 0.17})), follower(3.0, integral=False)),
        "box = It is lost on 4 of 4 trial plants: one with k 40 % larger, b 40 % larger; one with k 40 % larger, b 40 % smaller; "
        "one with k 40 % smaller, b 40 % smaller; one with k 40 % smaller, b 40 % larger", mismatch=40.0),
    "a spring of the model that pulls with more than the largest force": of(
        lambda: (stiff(0.28), follower(3.0)), "box = It is lost on 1 of 2 trial plants: the model itself, "),
    "that spring among plants of the box": of(
        lambda: (stiff(0.28), follower(3.0)), "box = It is lost on 1 of 6 trial plants: the model itself, ", mismatch=5.0),
    "a gain that mends another row than its own": of(lambda: (
        mass(period=5e-3, sensing=fp.Sensing({"q''": fp.Sensor(fp.Noise(0.3))}), dead_time=fp.DeadTime({"u": 0.01}),
             measure_from=2.0), torque(-0.1)), "model: Set deformation.gain to -0.2."),
    **{name: of(lambda make=make: (make(), torque())) for name, (make, _) in LONG_RUNS.items()},
    "too much noise": of(
        lambda: seen(12, 0.02, fp.SavitzkyGolay(15, 2)),
        "noise: Measure the response with less noise. None of the changes that were run helps, 9 in all: estimator, rate "
        "(estimator window 7, window 3, window 31, window 61, window 121; rate 4, 16, 2, 32)."),
    "a level that is held once": of(lambda: (
        replace(heater(), reference=fp.Trajectory(lambda t: {"T": 1.0 + 0 * t}), start={"T": 0.9}, limits=fp.Limits()),
        replace(follower(3.0, integral=False), deformation=fp.ModelReferenced(fp.Affine(-0.5))))),
}  # fmt: skip


@cache
def said(name: str) -> dict[tuple[str, str], Any]:
    """All answers of a case, by whom they are about and their key."""
    problem, controllers = CASES[name].task()
    found = fp.review(problem, controllers, mismatch=CASES[name].mismatch, seed=0).answers
    return {(about, a.key): a for about, some in found.items() for a in some}


LONG = "a map", "a servo", "an own", "a limit of", "a dead"  # 4 s and more


def kept(name: str, rows: dict[str, list[Any]]) -> dict[str, list[Any]]:
    """What was said of a case before: answers, changes and numbers, which FPIRHC_RENEW=1 renews."""
    every = json.loads(KEPT.read_text())
    if os.environ.get("FPIRHC_RENEW"):
        every[name] = rows
        KEPT.write_text("{" + ",\n".join(f"{json.dumps(n)}: {json.dumps(one)}" for n, one in every.items()) + "}\n")
    return every[name]


@pytest.mark.parametrize("name", slow_but(CASES, *(n for n in CASES if not n.startswith(LONG))))
def test_what_is_said_is_true(name):
    """It is what was said before, too; numbers of a loop that is lost are nobody's, but their names are read by scripts."""
    case, found = CASES[name], said(name)
    rows = {f"{about} {key}": [a.verdict, a.change, dict(a.numbers)] for (about, key), a in found.items()}
    before = kept(name, rows)
    assert {k: [*row[:2], {*row[2]}] for k, row in rows.items()} == {k: [*r[:2], {*r[2]}] for k, r in before.items()}
    for key, (verdict, _, numbers) in rows.items():
        was = before[key][2] if verdict in ("yes", "caution") else numbers
        assert numbers == pytest.approx(was, rel=5e-4, abs=1e-6, nan_ok=True), key
    assert {key: found[key].verdict.value for key in case.verdicts} == case.verdicts
    assert not [(k, a) for k, a in found.items() if k[0] in case.never and a.verdict == "no"]
    for (about, key, number), (value, tolerance) in case.numbers.items():
        assert found[about, key].numbers[number] == pytest.approx(value, abs=tolerance), (about, key, number)
    assert {key: found[key].change for key in case.changes} == case.changes
    assert {key: found[key].evidence[: len(words)] for key, words in case.told.items()} == case.told
    grows = [a for a in found.values() if "most_left" in a.numbers and a.numbers["left"] <= 0.5]
    assert all("of one ten times as large " in a.evidence for a in grows)
    good = {k: a for k, a in found.items() if a.verdict == "yes"}
    assert {k for k, a in found.items() if not a.change} == {*good}
    way_back = [a.numbers.items() for (_, key), a in good.items() if key in ("returns", "box")]
    assert all(v < 1 for numbers in way_back for n, v in numbers if "factor" in n or n.startswith("left"))


# Own runs beside the answers


@pytest.mark.parametrize("name", LONG_RUNS)
def test_of_a_long_run_4000_cycles_are_run_or_2000_in_which_errors_count(name):
    make, lasts = LONG_RUNS[name]
    problem = replace(make(), duration=lasts)
    run = fp.simulate(problem, torque(), seed=0, compiled=False)
    assert said(name)["it", "follows"].numbers["rms_error"] == pytest.approx(
        fp.measure(problem, run).rms_error["q"], rel=1e-9
    )


@pytest.mark.parametrize("name", OWN)
def test_a_recommended_gain_is_admitted_helps_and_asks_for_no_other(name):
    """Refused, too small, too large, and two of the wrong sign, one with a noisy encoder; set by the path that is named."""
    (problem, own), told = OWN[name](), said(name)["it", "gain"]
    [path] = re.findall(r"^Set (\S+) to -\S+\.", told.change)
    new = fp.with_settings(own, {path: told.numbers["recommended_gain"]})
    run, alone = (fp.simulate(problem, c, seed=0, compiled=False) for c in (new, new.with_deformation(fp.Identity())))
    assert fp.measure(problem, run).rms_error["q"] < fp.measure(problem, alone).rms_error["q"]  # and none is refused
    then = answers(problem, new)["gain"]
    assert (then.verdict, then.change, then.numbers["recommended_times"]) == ("yes", "", 1)


def test_a_plant_outside_is_asked_by_its_model():
    """What fails on the model is told; what works there is unknown of the body, with a stated lag too, and no gain is advised."""

    class Body:
        def step(self, *_: Any) -> list[float]:
            raise AssertionError("a review does not run it")

        reset = step

    outside = fp.ExternalPlant(Body(), measures={"x": "m", "x'": "m/s", "x''": "m/s^2"})
    problem, law = replace(biased(0.0), sensing=fp.Sensing(), reality=outside), fp.Exponential(6.0)
    adapted = {"CTC+FPI": fp.ComputedTorque(law, fp.ModelReferenced(fp.Affine(-0.8)))}
    for lag in ({"F": 0.03}, {}):
        told = fp.review(replace(problem, reality=replace(outside, lag=lag)), adapted, mismatch=0.0, seed=0).answers
        known = {a.key: str(a.verdict) for some in told.values() for a in some if a.verdict != "unknown"}
        assert known == {"model": "yes"}
    unknown = {(a.change, len(a.numbers)) for a in told["CTC+FPI"] if a.verdict == "unknown"}
    assert unknown == {("Only the model was run, and not the plant outside: fpirhc probe asks that one.", 0)}
    late, away = fp.DeadTime({"F": 0.05}), replace(problem, start={"x": 0.0, "x'": 5.0})
    model = reviewed.answers(replace(problem, dead_time=late), fp.ComputedTorque(law, fp.Affine(-0.8)))["model"]
    assert model.verdict == "caution"  # the plant may be another one
    lost = reviewed.answers(away, fp.ComputedTorque(fp.Exponential(1e-3)))["follows"]
    assert (lost.verdict, lost.change.partition("1/4). ")[2]) == ("no", "(run on the model alone)")


def test_a_gain_that_corrects_nothing_is_not_tested():
    """Where the model is right every gain has the same error; where its sign is wrong, the model is what is to be changed."""
    law = fp.ComputedTorque(fp.Exponential(6.0), fp.ModelReferenced(fp.Affine(-0.8)))
    told = reviewed.answers(reviewed.mass(plant=reviewed.heavy(1.0, 1.0)), law)["gain"]
    assert (told.verdict, told.change[:10], told.numbers) == ("unknown", "Every gain", {})
    told = reviewed.answers(biased(0.0).with_exact(np.array([-1.3])), sigmoid(-0.8))["follows"]
    assert "mass of the plant and of the model differ in sign: every cycle enlarges the error of Model" in told.change
