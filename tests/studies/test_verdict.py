"""The verdict says what happened, for adaptation that helps, does nothing, hurts, or diverges; one outcome decides its words."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from plants import linear, sine_of_three

import fpirhc as fp
from fpirhc.errors import NotSupported
from fpirhc.problem_files.pairs import pair_of
from fpirhc.problem_files.problem_file import Task
from fpirhc.report.html import asset, css_class
from fpirhc.report.terminal import STYLES
from fpirhc.simulation.metrics import Metrics, known_metrics
from fpirhc.studies.comparison.changes import Finding, Outcome
from fpirhc.studies.comparison.compare import compare
from fpirhc.studies.comparison.entry import Entry
from fpirhc.studies.comparison.pairwise import partners
from fpirhc.studies.comparison.timing import CycleTime, Price, measure_price, price_of
from fpirhc.studies.comparison.verdict import findings
from fpirhc.studies.scenarios.paired import ConfidenceInterval, Summary, verdict

TRACK = fp.Exponential(rate=6.0)


def case(deformation, gain=1.6, **changes):
    """Computed torque with and without this deformation on a linear plant."""
    problem = replace(sine_of_three(gain), **changes)
    controllers = {"plain": fp.ComputedTorque(TRACK), "adaptive": fp.ComputedTorque(TRACK, deformation)}
    return Task("case", Path("case.py"), "a case", "", problem, controllers)


def judged(deformation, gain=1.6, **changes):
    """The comparison of that case."""
    return compare(case(deformation, gain, **changes), seed=0, compiled=False)


def test_help_is_stated_with_numbers():
    """Which error, from what to what, by which factor, at which price."""
    sentences = judged(fp.Sigmoid(gain=-0.5, scale=10.0))
    assert sentences["adaptive"].pair == "plain"
    assert sentences.verdict[0].startswith("adaptive lowers the rms error of y from")
    assert "times less" in sentences.verdict[0]


@pytest.mark.parametrize(
    ("deformation", "cause"),
    [
        (fp.Sigmoid(gain=-0.5, scale=1e-3), "raise its scale S"),
        (fp.BeyondLimit(fp.Rotation(fraction=1.4, radius=1e4)), "is too large"),
    ],
    ids=["the desired response outruns the largest step", "beyond the linear limit"],
)
def test_causes_are_recognised(deformation, cause):
    assert cause in judged(deformation).verdict[0]


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
    comparison = compare(Task("case", Path("case.py"), "", "", problem, controllers), seed=0, compiled=False)
    assert "needs Problem(horizon=...)" in comparison.skipped["RHC"]
    assert comparison.verdict[-1].startswith("Not run: RHC")
    assert comparison.outcome is Outcome.NOT_COMPARABLE


def test_a_row_without_its_pair_is_judged_beside_itself_without_adaptation():
    """The same numbers, outcome and null test as beside a row; the sentence says that the other is no row."""
    task = case(fp.Sigmoid(gain=-0.5, scale=10.0))
    both, one = (compare(task, seed=0, compiled=False, controllers=names) for names in (None, ["adaptive"]))
    assert [e.name for e in one.entries] == ["adaptive"]
    assert one.outcome is both.outcome is Outcome.BETTER
    assert one.findings[0].ratios == both.findings[0].ratios
    assert one.findings[0].pair == ("adaptive without adaptation", "adaptive")
    assert one.verdict[0].endswith(" adaptive without adaptation is no row: it ran for this.")
    nulls: list[Any] = [one.null, both.null]
    assert [(test.before, test.after) for test in nulls[:1]] == [(test.before, test.after) for test in nulls[1:]]


def test_a_deformation_that_cannot_be_left_out_is_not_judged():
    class Bound(fp.ComputedTorque):
        def with_deformation(self, deformation):  # noqa: ARG002
            raise NotSupported("the map is part of the law")

    task = case(fp.Sigmoid(gain=-0.5, scale=10.0))
    bound = replace(task, controllers={"bound": Bound(TRACK, fp.Sigmoid(gain=-0.5, scale=10.0))})
    told = compare(bound, seed=0, compiled=False).verdict
    assert "bound is not judged: it cannot run without adaptation (the map is part of the law)." in told


def test_a_plant_outside_is_not_run_for_a_sentence():
    """It may be a machine: it runs for the rows that a user asked for, and the verdict names what is missing."""
    problem = case(fp.Identity()).problem
    outside = replace(
        problem, reality=fp.ExternalPlant(_Still(), measures={"y": "m", "y'": "m/s", "y''": "m/s^2"}), disturbances={}
    )
    row: Any = SimpleNamespace(name="adaptive", adaptive=True, pair=None)
    found, missing = partners(outside, [row], {}, seed=0, compiled=False)
    assert not found
    why = "it cannot run without adaptation (its pair is not among the controllers, and the plant is outside)"
    assert missing == {"adaptive": why}


class _Still:
    """A body that does not move."""

    def reset(self, seed):
        del seed
        return [0.0, 3.0, 0.0]

    def step(self, time, command):
        del time, command
        return [0.0, 3.0, 0.0]


def test_unknown_entry_offers_the_nearest():
    with pytest.raises(fp.FpirhcError, match="Did you mean 'plain'"):
        judged(fp.Sigmoid(gain=-0.5, scale=10.0))["plan"]


# --- Its numbers ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pair():
    """A controller without and one with adaptation; the tests give them errors and times of their own."""
    return judged(fp.Sigmoid(gain=-0.5, scale=10.0)).entries


def entry(source: Entry, micro: float = 5.0, **rms_error: float) -> Entry:
    """The entry with these errors, and with this median time of a cycle."""
    metrics = Metrics({"rms_error": rms_error}, {}, {m.name: m for m in known_metrics()})
    return replace(source, metrics=metrics, cycle=CycleTime(micro, micro, micro, micro, micro), price=None)


def said(pair, before, after, price=None) -> str:
    plain, adaptive = (entry(e, y=v) for e, v in zip(pair, (before, after), strict=True))
    return findings([plain, replace(adaptive, price=price)], {}, None)[0].text


def test_numbers_of_the_verdict(pair):
    """From 0.5 m to 0.1 m is five times less; 2.5 microseconds more than the pair, and no claim where they are within the noise."""
    assert said(pair, 0.5, 0.1, Price("plain", 2.5, 0.1)) == (
        "adaptive lowers the rms error of y from 0.5 to 0.1 m (5 times less) at 2.5 more microseconds per cycle."
    )
    assert said(pair, 0.5, 0.1, Price("plain", -1.0, 0.1)).endswith(" at 1 fewer microseconds per cycle.")
    noisy = said(pair, 0.5, 0.1, Price("plain", -1.0, 1.5))
    assert noisy.endswith("; the time per cycle differs by less than can be measured here (1.5 microseconds).")


def test_noise_of_the_machine_is_no_price():
    """40 rounds of 10 us with interruptions of milliseconds: 2.5 us more is a difference, 0.1 us more is none."""
    random = np.random.default_rng(3)
    times = 10 + random.normal(0, 0.5, (40, 2)) + np.where(random.random((40, 2)) < 0.1, 4000.0, 0.0)
    same, more, little = (price_of("plain", times + np.array([0.0, extra])) for extra in (0.0, 2.5, 0.1))
    assert abs(same.difference) <= same.noise < 1
    assert more.difference - more.noise < 2.5 < more.difference + more.noise
    assert more.difference > more.noise
    assert abs(little.difference) <= little.noise


def test_two_loops_are_timed_in_turn():
    """A price names the controller beside which it was measured; a run that is too short has none."""
    problem = fp.Problem(linear(1.6, 1.0), fp.Trajectory(lambda t: {"y": ca.sin(3 * t)}), {"y": 0.0}, 1e-3, 0.1)
    one = fp.ComputedTorque(TRACK)
    run = fp.simulate(problem, one, seed=0, compiled=False)
    stepper = fp.Stepper(problem, one, compiled=False)
    price = measure_price(problem, (stepper, run), (stepper, run))
    assert price is not None
    assert price.beside == "ComputedTorque"
    assert price.noise > 0
    short = replace(run, log=run.log[:9])
    assert measure_price(problem, (stepper, short), (stepper, short)) is None


@pytest.mark.parametrize(
    ("after", "words"),
    [
        (0.89, "lowers"),
        (0.91, "makes no clear difference"),
        (1.09, "makes no clear difference"),
        (1.11, "does not help"),
    ],
)
def test_a_tenth_more_or_less_is_a_difference(pair, after, words):
    """Below 0.9 of the error it helps, above 1.1 it does not."""
    assert said(pair, 1.0, after).startswith(f"adaptive {words}")


@pytest.mark.parametrize(
    ("after", "outcome", "words"),
    [
        (0.1, Outcome.BETTER, "adaptive lowers the rms error of y from 1 to 0.1 m (10 times less)"),
        (10.0, Outcome.WORSE, "adaptive does not help: it raises the rms error of y from 1 to 10 m (10 times more)"),
    ],
)
def test_a_coordinate_that_stays_is_named(pair, after, outcome, words):
    """Ten times less or more in one coordinate and nearly the same in the other: what stays is said, without a factor."""
    plain, adaptive = entry(pair[0], y=1.0, z=1.0), entry(pair[1], y=after, z=1.05)
    plain, adaptive = (replace(e, run=_with_second_error(e.run)) for e in (plain, adaptive))
    [only] = findings([plain, adaptive], {}, None)
    assert only.text == f"{words}; no clear change: z from 1 to 1.05 m."
    assert only.outcome is outcome


def _with_second_error(run):
    signals = tuple(
        replace(s, elements=("y", "z"), units=("m",)) if s.name == "error" else s for s in run.layout.signals
    )
    return replace(run, layout=type(run.layout)(signals))


def test_how_much_to_raise_the_scale_is_twice_what_is_needed():
    """The largest change of the desired response in a cycle over the map's largest step, with the spare that a review asks for."""
    deformation = fp.Sigmoid(gain=-0.5, scale=1e-3)
    sentences = judged(deformation)
    largest = np.abs(np.diff(sentences["plain"].run["desired.y"])).max()
    needed = largest / deformation.largest_step()
    assert f"changes by up to {largest:.3g} in one cycle" in sentences.verdict[0]
    assert f"raise its scale S at least {2 * needed:.2g} times" in sentences.verdict[0]
    assert "raise its scale" not in judged(replace(deformation, scale=1.25 * needed * 1e-3)).verdict[0]


@pytest.mark.slow
def test_steps_of_a_plan_are_followed_until_the_next_plan():
    """Two masses, a plan every 10 cycles: the scale that the sentence asks for is enough, and half of it is too."""
    task = fp.load_problem("two_mass")
    names = "RHC, stiff", "RHC+FPI, stiff, small S"
    text = compare(task, seed=0, controllers=list(names), compiled=False).verdict[0]
    desired = fp.simulate(task.problem, task.controllers[names[0]], seed=0, compiled=False)["desired"]
    largest = np.linalg.norm(desired[10:] - desired[:-10], axis=1).max() / 10
    more = 2 * largest / task.controllers[names[1]].deformation.largest_step()
    assert f"changes by up to {largest:.3g} per cycle from plan to plan" in text
    assert f"raise its scale S at least {more:.2g} times" in text
    for scale in (more, 0.5 * more):
        adaptive = task.controllers[names[0]].with_deformation(fp.Sigmoid(gain=-0.5, shift=0.3, scale=scale))
        errors = fp.measure(task.problem, fp.simulate(task.problem, adaptive, seed=0, compiled=False)).rms_error
        assert max(errors.values()) < 3e-4  # m; with the small one 5.8, without adaptation .02


def test_a_pair_has_the_same_formulas_where_several_controllers_have_the_same_settings():
    """Two costs that users wrote as functions look the same in a description of the settings."""
    task = fp.load_problem("two_mass")
    planner = task.controllers["RHC"].planner
    assert planner is not None

    def weighed(weight):
        return fp.CustomCost(terms=lambda v: {"error": weight * (v.state.q1 - v.reference.q1) ** 2 + v.input.Q1**2})

    heavy, light = (fp.RecedingHorizon(planner.optimiser, cost=weighed(w)) for w in (1e4, 1e2))
    controllers = {"heavy": heavy, "light": light, "light+FPI": replace(light, deformation=fp.Affine(-1.0))}
    assert pair_of(controllers, "light+FPI") == "light"


# One outcome decides words and colours, in comparisons and in studies of scenarios


def summary(name: str, interval: tuple[float, float] | None) -> Summary:
    """A controller whose error differs from the baseline's by this interval."""
    difference = None if interval is None else ConfidenceInterval(sum(interval) / 2, *interval)
    errors = np.full(5, 0.1)
    figures: dict[str, Any] = {
        "errors": errors,
        "values": errors,
        "mismatch": errors,
        "rank_error": 0.0,
        "median": 0.1,
        "worst": 0.1,
    }
    places: dict[str, Any] = {
        "median_scenario": 0,
        "worst_scenario": 0,
        "worst_name": "0",
        "first_ended": None,
        "scenarios": np.arange(5),
    }
    counts: dict[str, Any] = {"count": 6, "outcomes": {"finished": 6}, "statuses": {}, "better": 2, "equal": 0}
    metrics: dict[str, Any] = {"metrics": {"rms_error": {}}, "worst_metrics": {}}
    return Summary(name=name, difference=difference, ratio=1.0, **figures, **places, **counts, **metrics)


@pytest.mark.parametrize(
    ("interval", "outcome", "words"),
    [
        ((-0.2, -0.1), Outcome.BETTER, "has a smaller error than"),
        ((0.1, 0.2), Outcome.WORSE, "has a larger error than"),
        ((-0.1, 0.2), Outcome.NO_DIFFERENCE, "show no clear difference"),
    ],
)
def test_a_summary_is_what_its_interval_leaves_no_doubt_of(interval, outcome, words):
    """An interval with zero inside is no difference, whatever its middle."""
    baseline, rival = summary("RHC", None), summary("RHC+FPI", interval)
    assert baseline.outcome is None
    assert rival.outcome is outcome
    assert words in verdict([baseline, rival], {})[0]


def test_five_scenarios_have_no_interval_and_runs_that_all_ended_no_difference():
    """All of five smaller is chance in one of 16 samples; of nothing there is no median."""
    few = replace(summary("RHC+FPI", (-0.2, -0.1)), count=5)
    assert few.outcome is Outcome.NO_DIFFERENCE
    [told, *_] = verdict([replace(summary("RHC", None), count=5), few], {})
    assert told.startswith("RHC+FPI and RHC have too few scenarios for an interval (median difference")
    lost = replace(summary("RHC+FPI", (0.0, 0.0)), median=math.inf, equal=6)
    [told, *_] = verdict([summary("RHC", None), lost], {})
    assert told == "RHC+FPI and RHC cannot be compared: neither has a finite error in any of the scenarios."


def test_green_is_for_better_alone():
    """In the style sheet only the class of 'better' has the green ink, and the bare headline has the ordinary one."""
    css = asset("report.css")
    green = {
        s
        for rule, body in re.findall(r"([^{}]+)\{([^{}]*)\}", css)
        if "color:var(--accent)" in body
        for s in rule.split(",")
    }
    assert {s.strip() for s in green if "outcome" in s or "headline" in s} == {
        ".headline.outcome-better",
        "li.outcome-better",
    }
    assert [o for o in Outcome if "green" in STYLES[o]] == [Outcome.BETTER]
    assert css_class(None) == "remark"
    assert STYLES[None] == ""


def with_errors(pair, plain, adaptive) -> Finding:
    """The verdict on runs with these errors, of which the first is the larger one."""
    entries = []
    for source, error in zip(pair, (plain, adaptive), strict=True):
        columns = [source.run.layout.slice("true_error")]
        log = source.run.log.copy()
        log[:, columns[0]] = np.resize(error, (len(log), 1))
        entries.append(entry(replace(source, run=replace(source.run, log=log)), y=float(np.sqrt(np.mean(error**2)))))
    return findings(entries, {}, None)[0]


def test_a_loop_that_only_has_not_failed_yet_is_no_clear_success(pair):
    """An error that grows as an exponential is doubtful; one that grows as a power of time, or jumps once, is not."""
    t = np.linspace(0.0, 1.0, pair[0].run.cycles)
    swings = np.sin(60 * t)
    unstable, steady = 1e-3 * np.exp(5 * t) * swings, 0.1 * swings
    both = with_errors(pair, 10 * unstable, unstable)
    assert both.outcome is Outcome.DOUBTFUL
    assert both.text.startswith("The error of plain and adaptive grows from quarter to quarter of the run, ")
    alone = with_errors(pair, 10 * unstable, 1e-3 * steady)
    assert alone.outcome is Outcome.BETTER
    assert "The error of plain grows from quarter to quarter" in alone.text
    for calm in (1e-3 * steady, 1e-2 * t**4 * swings, 1e-2 * (1 + 30 * (t > 0.6)) * swings, 1e-2 * t * swings):
        assert "quarter" not in with_errors(pair, steady, calm).text
