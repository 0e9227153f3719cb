"""Every sentence of the verdict, word by word, from entries that were made by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hand_made_runs import CYCLES, SOLVE

import fpirhc as fp
from fpirhc.simulation.metrics import Metrics, known_metrics
from fpirhc.simulation.metrics.base import Metric
from fpirhc.simulation.run import Run
from fpirhc.studies.comparison.causes import Yardstick, _slew_cause, limit_cause
from fpirhc.studies.comparison.changes import Finding, Outcome
from fpirhc.studies.comparison.entry import Entry, no_bound_because
from fpirhc.studies.comparison.optimality import Optimality
from fpirhc.studies.comparison.timing import CycleTime, Price
from fpirhc.studies.comparison.verdict import findings
from fpirhc.studies.objective import Objective
from fpirhc.symbolic.layout import Layout, Signal

STOP = "signal 'x' is not finite"
EFFORT = (
    " Its cost weighs the absolute effort, so the optimum of the wrong model trades tracking against a wrong effort and "
    "adaptation realises that plan faithfully. Weigh the deviation from the model's feedforward, or the input's rate."
)


def entry(name: str, pair: str | None = None, *, micro: float | None = 5.0, errors=None, **changes: Any) -> Entry:
    """An entry with these errors of y [m], z [rad]; `changes` are its other fields and what its run holds."""
    signals = [Signal("error", ("y", "z"), ("m", "rad")), Signal("desired", ("y", "z"), ("m/s2", "rad/s2"))]
    values = [np.zeros((CYCLES, 2)), np.broadcast_to(changes.get("desired", 0.0), (CYCLES, 2))]
    signals += [Signal("command", ("u",), ("N",)), Signal("reference", ("y",), ("m",))]
    values += [
        np.asarray(changes.get(n, np.arange(CYCLES) % 2), dtype=float)[:, None] for n in ("command", "reference")
    ]
    signals, values = (
        [*signals, Signal("true_error", ("y", "z"), ("m", "rad"))],
        [*values, np.asarray(changes.get("true_error", values[0]))],
    )
    if changes.get("planning"):
        signals, values = [*signals, Signal("solve", SOLVE)], [*values, np.zeros((CYCLES, len(SOLVE)))]
    log = np.hstack(values)[: changes.get("cycles", CYCLES)]
    settings = {"step_limit": None, **changes.get("settings", {})}
    made = Run("case", name, 0, 0.1, Layout(tuple(signals)), log, changes.get("stop"), False, settings)
    numbers = {"rms_error": errors or {"y": 1.0}, **changes.get("measured", {})}
    metrics = Metrics(numbers, {}, {m.name: m for m in (*known_metrics(), *changes.get("metrics", ()))})
    factor = changes.get("factor")
    growing = changes.get("growing", float((factor or 0.0) >= 1))
    report = SimpleNamespace(
        predicted=factor,
        growing=growing,
        report=SimpleNamespace(text=changes.get("advice", "Lower the gain.")),
        spectrum=SimpleNamespace(eigenvalues=np.array(changes.get("slopes", [1.0]))),
    )
    cycle = None if micro is None else CycleTime(micro, micro, micro, micro, micro)
    contraction = cast(Any, None if factor is None else report)
    return Entry(name, made, metrics, cycle, pair is not None, pair, contraction, **changes.get("facts", {}))


def said(*entries: Entry, skipped=None, headline=None) -> tuple[str, ...]:
    return tuple(finding.text for finding in findings(entries, skipped or {}, headline))


def first(*entries: Entry, scales=None, **against: Any) -> Finding:
    return findings(entries, {}, None, Yardstick(scales or {}, **against))[0]


def no_difference(**adaptive: Any) -> str:
    """What is said beside 'no clear difference'."""
    plain = adaptive.pop("plain", None) or entry("RHC")
    [sentence] = said(plain, entry("FPI", "RHC", **adaptive))
    begin = "FPI makes no clear difference: it changes the rms error of y from 1 to 1 m."
    assert sentence.startswith(begin)
    return sentence.removeprefix(begin)


# What happened


def test_who_finishes():
    """The adaptive run ended, the plain one, or both: the adaptive one is told first."""
    assert said(entry("RHC"), entry("FPI", "RHC", stop=STOP)) == (f"FPI does not finish: {STOP}.",)
    assert said(entry("RHC", stop=STOP), entry("FPI", "RHC")) == (f"FPI finishes where RHC does not ({STOP}).",)
    assert said(entry("RHC", stop="b"), entry("FPI", "RHC", stop="a")) == (
        "Neither FPI nor RHC finishes. FPI: a. RHC: b.",
    )
    outcomes = [
        first(entry("RHC", stop=a), entry("FPI", "RHC", stop=b)).outcome
        for a, b in ((None, "b"), ("a", None), ("a", "b"))
    ]
    assert outcomes == [Outcome.WORSE, Outcome.BETTER, Outcome.NOT_COMPARABLE]


def test_the_headline_comes_first():
    """Of two pairs the headline is the first, in whatever order they ran; without one the order is that of the rows."""
    rows = [entry("a"), entry("a+", "a"), entry("b"), entry("b+", "b")]
    assert said(*rows, headline=("b", "b+"))[0].startswith("b+")
    assert said(*rows)[0].startswith("a+")


def test_a_run_without_adaptation_that_is_no_row_is_told():
    """It ran for its pair alone; a row needs no such sentence."""
    plain, adaptive = entry("CTC"), entry("CTC+FPI", "CTC")
    told = " CTC is no row: it ran for this."
    apart, row = findings([adaptive], {}, None, partners=[plain])[0], findings([plain, adaptive], {}, None)[0]
    assert apart.text == row.text + told


def test_where_nobody_finishes_every_end_is_told():
    assert said(entry("a", stop="x is not finite"), entry("b", stop="the plan is not finite"))[0] == (
        "No controller finished its run: a: x is not finite; b: the plan is not finite."
    )


ALONE = "; no controller is here both with and without adaptation, so adaptation itself is not judged."


@pytest.mark.parametrize(
    ("figure", "rows", "said_of_it"),
    [
        (None, {"A": (1.0, 0.2), "B": (0.5, 0.4)}, "A has a relative error, rms over range, of 0.158, the smallest"),
        (None, {"A": (1.0,)}, "A has an rms error of y of 1 m"),
        ("larger", {"A": (1.0,), "B": (2.0,)}, "B has loss 2 N, the largest"),
    ],
)
def test_without_a_pair_the_best_row_is_named(figure, rows, said_of_it):
    """Errors of a metre and of a radian count over their ranges; a figure ranks where there is one; one row is no smallest."""
    loss = Metric("loss", lambda problem, run: 0.0, better=figure or "smaller", unit="N")
    entries = [
        entry(n, errors=dict(zip("yz", e, strict=False)), measured={"loss": {"": e[0]}}, metrics=[loss])
        for n, e in rows.items()
    ]
    aim = Objective(loss, unit="N") if figure else None
    [told] = findings(entries, {}, None, Yardstick({"y": 10.0, "z": 1.0}), figure=aim)
    assert told.text == said_of_it + ALONE


JUDGED = "FPI {} loss ({:g} N after {:g} N without adaptation; {} is better)."
ASIDE = "By loss FPI and RHC cannot be set side by side: {} none."


@pytest.mark.parametrize(
    ("better", "before", "after", "outcome", "said_of_it"),
    [
        ("smaller", 4.0, 2.0, Outcome.BETTER, JUDGED.format("improves", 2, 4, "smaller")),
        ("larger", 4.0, 2.0, Outcome.WORSE, JUDGED.format("worsens", 2, 4, "larger")),
        ("larger", -4.0, -2.0, Outcome.BETTER, JUDGED.format("improves", -2, -4, "larger")),
        ("larger", -1.0, 1.0, Outcome.BETTER, JUDGED.format("improves", 1, -1, "larger")),
        ("smaller", 4e-10, 2e-10, Outcome.BETTER, JUDGED.format("improves", 2e-10, 4e-10, "smaller")),
        ("smaller", 4.0, 4.0, Outcome.NO_DIFFERENCE, JUDGED.format("does not clearly change", 4, 4, "smaller")),
        ("smaller", math.nan, 2.0, Outcome.BETTER, ASIDE.format("RHC has")),
        ("smaller", 4.0, math.nan, Outcome.WORSE, ASIDE.format("FPI has")),
        ("larger", math.nan, math.nan, Outcome.NOT_COMPARABLE, ASIDE.format("both have")),
    ],
)
def test_the_figure_that_a_problem_is_judged_by(better, before, after, outcome, said_of_it):
    """Two numbers, which of them is better by its own direction, and who has none; the errors follow in a sentence of their own."""
    loss = Metric("loss", lambda problem, run: 0.0, better=better, unit="N")
    rows = [
        entry(name, pair, measured={"loss": {"": value}}, metrics=[loss])
        for name, pair, value in (("RHC", None, before), ("FPI", "RHC", after))
    ]
    figure = Objective(loss, unit="N")
    one, other, *_ = findings(rows, {}, None, None, figure=figure)
    assert (one.outcome, one.text) == (outcome, said_of_it)
    assert math.isnan(one.ratios.get("loss", math.nan)) or one.ratios["loss"] == after / before
    assert other.text.startswith("FPI makes no clear difference: it changes the rms error of y")


@pytest.mark.parametrize(
    ("better", "rival", "said_of_it"),
    [
        ("smaller", 1.0, ["By loss PID is better than this pair: 1 N (RHC 4 N, FPI 2 N)."]),
        ("smaller", 1.9, []),
        ("smaller", 3.0, []),
        ("larger", 5.0, ["By loss PID is better than this pair: 5 N (RHC 4 N, FPI 2 N)."]),
        ("larger", math.nan, []),
    ],
)
def test_a_row_is_better_by_the_figure_and_not_by_its_error(better, rival, said_of_it):
    """The error of the row is a hundredth, which a problem that is judged by a figure does not ask for."""
    loss = Metric("loss", lambda problem, run: 0.0, better=better, unit="N")
    rows = [
        entry(name, pair, measured={"loss": {"": value}}, metrics=[loss], errors={"y": 0.01 if name == "PID" else 1.0})
        for name, pair, value in (("RHC", None, 4.0), ("FPI", "RHC", 2.0), ("PID", None, rival))
    ]
    sentences = findings(rows, {}, None, None, figure=Objective(loss, unit="N"))
    assert [one.text for one in sentences if "PID" in one.text] == said_of_it
    assert "PID is far better than this pair" in findings(rows, {}, None)[-1].text


def test_several_coordinates():
    """Each has its numbers, unit and factor, the worst first; better and worse together are mixed."""
    plain, adaptive = entry("RHC", errors={"y": 1.0, "z": 2.0}), entry("FPI", "RHC", errors={"y": 0.2, "z": 1.0})
    assert said(plain, adaptive) == (
        "FPI lowers the rms error of z from 2 to 1 rad (2 times less), y from 1 to 0.2 m (5 times less).",
    )
    worse = entry("FPI", "RHC", errors={"y": 1.5, "z": 4.0})
    assert said(plain, worse) == (
        "FPI does not help: it raises the rms error of z from 2 to 4 rad (2 times more), y from 1 to 1.5 m (1.5 times more).",
    )
    mixed = entry("FPI", "RHC", errors={"y": 0.1, "z": 4.0})
    assert said(plain, mixed) == (
        "FPI has mixed results: it raises the rms error of z from 2 to 4 rad (2 times more) and lowers that of y from 1 to 0.1 m "
        "(10 times less).",
    )
    assert [first(plain, e).outcome for e in (adaptive, worse, mixed)] == [Outcome.BETTER, Outcome.WORSE, Outcome.MIXED]
    assert first(plain, mixed).ratios == {"z": 2.0, "y": 0.1}


def test_errors_count_relative_to_their_scale():
    """A rise from 1 to 2 m in a range of 1000 m does not count beside half of another range; in a range of 1 m it does."""
    plain, adaptive = entry("RHC", errors={"y": 1.0, "z": 0.5}), entry("FPI", "RHC", errors={"y": 2.0, "z": 0.3})
    assert first(plain, adaptive, scales={"y": 1000.0, "z": 1.0}).text == (
        "FPI lowers the rms error of z from 0.5 to 0.3 rad (1.67 times less). Too small beside them to count: y from 1 to 2 m."
    )
    assert first(plain, adaptive, scales={"y": 1.0, "z": 1.0}).outcome is Outcome.MIXED


def test_only_what_the_cost_weighs_is_judged():
    """The weighed y is 245 000 times worse, the unweighed z nine times better: that does not help."""
    plain = entry("RHC", errors={"y": 1.79e-6, "z": 9.0})
    adaptive = entry("FPI", "RHC", errors={"y": 0.438, "z": 1.0}, facts={"weighed": frozenset({"y"})})
    assert first(plain, adaptive) == Finding(
        "FPI does not help: it raises the rms error of y from 1.79e-6 to 0.438 m (245 000 times more). The cost does not weigh, "
        "so the verdict leaves out: z from 9 to 1 rad.",
        Outcome.WORSE,
        ("RHC", "FPI"),
        {"y": 0.438 / 1.79e-6},
    )


def test_an_error_that_was_zero():
    """From zero to something is worse, and has no factor; two errors of rounding are no difference; a tiny error has a ratio."""
    zero, some = entry("RHC", errors={"y": 0.0}), entry("FPI", "RHC", errors={"y": 0.1})
    assert said(zero, some) == ("FPI does not help: it raises the rms error of y from 0 to 0.1 m.",)
    rounding = entry("RHC", errors={"y": 1e-16}), entry("FPI", "RHC", errors={"y": 1e-15})
    assert first(*rounding).outcome is Outcome.NO_DIFFERENCE
    assert first(zero, entry("FPI", "RHC", errors={"y": 0.0})).outcome is Outcome.NO_DIFFERENCE
    tiny = entry("RHC", errors={"y": 1e-3}), entry("FPI", "RHC", errors={"y": 1e-4})
    assert "(10 times less)" in said(*tiny)[0]


def test_factors_are_written_as_people_write_them():
    """No powers of ten, no inf: what is left of an error may be rounding, and beyond a million the digits say nothing."""
    before = entry("RHC", errors={"y": 0.0537})
    for after, words in (
        (1e-12, "(to rounding)"),
        (1e-320, "(to rounding)"),
        (0.0, "(to rounding)"),
        (0.0537 / 2.4e6, "(more than a million times less)"),
        (0.0537 / 245_120, "(245 000 times less)"),
        (0.0537 / 1234, "(1 230 times less)"),
        (0.0537 / 12.34, "(12.3 times less)"),
    ):
        assert said(before, entry("FPI", "RHC", errors={"y": after}))[0].endswith(f"{words}.")


def test_an_error_that_is_no_number_is_not_compared():
    """NaN is neither better nor worse."""
    lost = first(entry("RHC"), entry("FPI", "RHC", errors={"y": float("nan")}))
    assert lost.outcome is Outcome.NOT_COMPARABLE
    assert lost.text == "FPI and RHC cannot be compared: the error of y is no number."


@pytest.mark.parametrize(
    ("price", "words"),
    [
        (Price("RHC", 2.5, 0.1), " at 2.5 more microseconds per cycle."),
        (Price("RHC", -0.4, 0.1), " at 0.4 fewer microseconds per cycle."),
        (Price("RHC", 0.4, 0.5), "; the time per cycle differs by less than can be measured here (0.5 microseconds)."),
        (Price("RHC", 9.94, 0.1), " at 9.9 more microseconds per cycle."),
        (Price("RHC", -1.6e3, 0.1), "."),
        (Price("RHC", 2.0, 140.0), "."),
        (Price("another", 2.5, 0.1), "."),
        (None, "."),
    ],
)
def test_price(price, words):
    """Only a difference beyond the noise has a sign; nothing where both were not timed in turn.

    Both cycles take 5 microseconds, so a difference of more than 10 was not theirs, and one that needs to be as large is not told.
    """
    plain, adaptive = entry("RHC"), entry("FPI", "RHC", errors={"y": 0.5}, facts={"price": price})
    assert said(plain, adaptive) == (f"FPI lowers the rms error of y from 1 to 0.5 m (2 times less){words}",)


# Why a smaller error is no success


def test_a_pair_is_compared_with_the_plant_left_alone():
    """A servo that never moves has 0.346 rad: 0.389 in place of 0.543 is no success, and the sentence says so first."""
    plain, adaptive = entry("RHC", errors={"z": 0.543}), entry("FPI", "RHC", errors={"z": 0.389})
    assert first(plain, adaptive, alone={"z": 0.346}) == Finding(
        "RHC and FPI do worse than the plant left alone, whose input stays as it was before the run: rms error 0.346 rad in z. "
        "FPI lowers the rms error of z from 0.543 to 0.389 rad (1.4 times less).",
        Outcome.DOUBTFUL,
        ("RHC", "FPI"),
        {"z": 0.389 / 0.543},
    )
    assert first(plain, adaptive, alone={"z": 0.39}).outcome is Outcome.BETTER
    assert first(plain, adaptive).outcome is Outcome.BETTER
    two = entry("RHC", errors={"y": 1.0, "z": 0.5}), entry("FPI", "RHC", errors={"y": 0.5, "z": 0.25})
    assert first(*two, alone={"y": 0.4, "z": 2.0}).outcome is Outcome.BETTER  # it has brought z down
    worse = first(entry("RHC", errors={"y": 0.1}), entry("FPI", "RHC", errors={"y": 0.5}), alone={"y": 0.4})
    assert worse.outcome is Outcome.WORSE
    assert worse.text.endswith(
        "0.5 m (5 times more). FPI does worse than the plant left alone, whose input stays as it was before the run: rms error "
        "0.4 m in y."
    )


def test_an_error_beyond_the_range_of_the_reference_is_a_failure_of_both():
    """From 295 to 49.7 m along a reference of 2 m is no success; the reason follows."""
    lost: dict[str, Any] = {"measured": {"status": {"NOT_CONVERGED": CYCLES}}}
    plain, adaptive = entry("RHC", errors={"y": 295.0}), entry("FPI", "RHC", errors={"y": 49.7}, **lost)
    failed = first(plain, adaptive, ranges={"y": 2.0})
    assert failed.outcome is Outcome.NOT_COMPARABLE
    assert failed.text == (
        "Neither RHC nor FPI follows the reference: the rms error of y is 295 and 49.7 m, more than the range of its reference, "
        "2 m. FPI: its plans "
        "did not converge in 100 % of the cycles (those of RHC in 0 %), so this is not the optimum of its cost: give the optimiser "
        "more iterations, then compare."
    )
    assert first(plain, entry("FPI", "RHC", errors={"y": 1.9}), ranges={"y": 2.0}).outcome is Outcome.BETTER


def test_an_angle_that_is_held_is_lost_beyond_a_quarter_turn():
    """A pendulum that is held upright and turns round fails although the cart stays; each such run says so."""
    turns = {"turns": {"z": np.pi / 2}}
    plain, adaptive = entry("RHC", errors={"y": 0.5, "z": 5.8}), entry("FPI", "RHC", errors={"y": 0.1, "z": 5.6})
    failed, *left = findings([plain, adaptive], {}, None, Yardstick({}, **turns))
    assert failed.outcome is Outcome.NOT_COMPARABLE
    assert failed.text == (
        "Neither RHC nor FPI follows the reference: the rms error of z is 5.8 and 5.6 rad, more than a quarter turn, 1.57 rad."
    )
    assert left == []  # the first sentence has said so of both
    upright = entry("FPI", "RHC", errors={"y": 0.1, "z": 0.2})
    better, *left = findings([plain, upright], {}, None, Yardstick({}, **turns))
    assert better.outcome is Outcome.BETTER
    assert [one.text for one in left] == [
        "RHC leaves the neighbourhood of its reference, for which its gains and its review are made: rms error of z 5.8 rad, more "
        "than a quarter turn, 1.57 rad."
    ]


def moving(before: float, after: float, **changes: Any) -> Finding:
    """The verdict on half the error, with these movements of the command."""
    facts = [{"total_variation": {"u": v}, "effort": {"u": 1.0}} for v in (before, after)]
    return first(entry("RHC", measured=facts[0]), entry("FPI", "RHC", errors={"y": 0.5}, measured=facts[1], **changes))


def test_movement_of_the_command_is_stated_and_chatter_is_a_reason():
    """Twice as much is stated, ten times as much makes a smaller error doubtful; rounding is no movement."""
    lower = "FPI lowers the rms error of y from 1 to 0.5 m (2 times less)."
    assert moving(0.15, 0.29) == first(entry("RHC"), entry("FPI", "RHC", errors={"y": 0.5}))
    three = moving(0.15, 0.45)
    assert three.outcome is Outcome.BETTER
    assert three.text == f"{lower} Its command moves 3 times as much as that of RHC (u 0.45 against 0.15)."
    chatter = moving(0.15, 12.0)
    assert chatter.outcome is Outcome.DOUBTFUL
    assert chatter.text == (
        "FPI: its command moves 80 times as much as that of RHC (u 12 against 0.15): it chatters, or carries the noise. "
        + lower
    )
    settles = moving(0.15, 12.0, command=np.linspace(0.0, 1.0, CYCLES))  # once, by its span
    assert settles.text == f"{lower} Its command moves 80 times as much as that of RHC (u 12 against 0.15)."
    assert "moves, that of RHC does not (u 0.2 against 0)" in moving(0.0, 0.2).text
    assert moving(0.0, 1e-10).text == lower


def test_reasons_stand_before_a_positive_verdict():
    """Plans that did not converge and commands at their limits make it doubtful."""
    unsolved = {"status": {"NOT_CONVERGED": 0.42 * CYCLES}}
    finding = first(entry("RHC"), entry("FPI", "RHC", errors={"y": 0.5}, measured=unsolved))
    assert finding.outcome is Outcome.DOUBTFUL
    assert finding.text.startswith("FPI: its plans did not converge in 42 % of the cycles")
    assert finding.text.endswith("then compare. FPI lowers the rms error of y from 1 to 0.5 m (2 times less).")
    few = {"status": {"NOT_CONVERGED": 0.04 * CYCLES}}
    assert first(entry("RHC"), entry("FPI", "RHC", errors={"y": 0.5}, measured=few)).outcome is Outcome.BETTER


# The other rows


def test_a_far_better_row_is_named():
    """From a factor of two on, counted from the better of the pair; a row with the exact model is no rival."""
    pair = entry("RHC"), entry("FPI", "RHC", errors={"y": 2.0})
    assert said(*pair, entry("learner", errors={"y": 1 / 32001}))[1] == (
        "learner is far better than this pair: it has an rms error of y of 3.12e-5 m (RHC 1 m and FPI 2 m), 32 000 times "
        "smaller than that of RHC."
    )
    assert len(said(*pair, entry("learner", errors={"y": 0.51}))) == 1
    assert len(said(*pair, entry("exact", errors={"y": 1e-6}, facts={"exact": True}))) == 1
    assert said(*(entry(e.name, e.pair, stop="x") for e in pair), entry("learner"))[1] == (
        "learner finishes its run, with an rms error of y of 1 m."
    )


def test_errors_of_several_coordinates_are_compared_over_their_ranges():
    """Their root mean square: of .3 and .4 it is .3536."""
    pair = entry("RHC", errors={"y": 1.0, "z": 1.0}), entry("FPI", "RHC", errors={"y": 1.0, "z": 1.0})
    text = said(*pair, entry("learner", errors={"y": 0.3, "z": 0.4}))[1]
    assert "it has a relative error, rms over range, of 0.354 (RHC 1 and FPI 1), 2.83 times smaller" in text


def test_an_exact_model_that_is_worse_is_no_bound():
    """It is said with the reasons; an exact model that is as good or better is a bound, and nothing is said."""
    pair = entry("RHC"), entry("FPI", "RHC", errors={"y": 0.01})
    exact = {"exact": True, "no_bound": ("it plans every 10 cycles", "its model does not hold the wind")}
    assert said(*pair, entry("exact", errors={"y": 0.1}, facts=exact))[1] == (
        "exact is no bound here: it has an rms error of y of 0.1 m, FPI 0.01 m. Why: it plans every 10 cycles; its model "
        "does not hold the wind."
    )
    assert len(said(*pair, entry("exact", errors={"y": 0.0105}, facts=exact))) == 1


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("cart_pole_slots", "its law makes this error with a right model too"),
        ("mass_spring_slots", "its law makes this error with a right model too"),
        ("fishery", "its cost weighs more than the error, so the best plan has not the smallest error"),
    ],
)
def test_why_an_exact_model_is_no_bound_is_always_known(name, why):
    """Where no disturbance, dead time or plan is the reason, it is the law or the cost."""
    task = fp.load_problem(name)
    controller = next(c for c in task.controllers.values() if isinstance(c, fp.ExactModel))
    metrics = cast("Metrics", SimpleNamespace(statuses={"OK": 10}))
    assert no_bound_because(task.problem, controller, metrics, None) == (why,)


def test_a_learner_that_does_worse_than_its_fixed_model_is_named():
    """With a fifth less error, or the same, nothing is said."""
    fixed: dict[str, Any] = {"facts": {"learns": True, "fixed": "RHC"}}
    both = [entry("RHC"), entry("FPI", "RHC")]
    assert said(*both, entry("RLS", errors={"y": 3.3}, **fixed))[1] == (
        "RLS does worse than RHC, whose model does not change (1 m): it has an rms error of y of 3.3 m (3.3 times more). Let it "
        "learn more slowly (a smaller drift of disturbances, a longer memory, a smaller gain of adaptation), or mend the model."
    )
    assert (
        " RHC, whose model does not change (1 m): it does not finish."
        in said(*both, entry("RLS", stop=STOP, **fixed))[1]
    )
    for errors in (1.0, 0.8):
        assert len(said(*both, entry("RLS", errors={"y": errors}, **fixed))) == 1


def test_unequal_rates_are_stated():
    """Where adaptation acts in every cycle and a learner at every plan; with a plan in every cycle there is nothing to say."""
    for every, count in ((10, 2), (1, 1)):
        facts = {"plan_every": every}
        rows = (
            entry("RHC", facts=facts),
            entry("FPI", "RHC", facts=facts),
            entry("RLS", facts={**facts, "learns": True}),
        )
        texts = said(*rows)
        assert len(texts) == count
        if count == 2:
            assert texts[1].startswith(
                "Rates: FPI corrects in every cycle, RLS only at every plan, that is every 10 cycles."
            )
    both = entry("FPI", "RHC", facts={"plan_every": 10}), entry("FPI, plain", "RHC", facts={"plan_every": 10})
    texts = said(entry("RHC", facts={"plan_every": 10}), *both, entry("RLS", facts={"plan_every": 10, "learns": True}))
    assert any(t.startswith("Rates: FPI and FPI, plain correct in every cycle, RLS only at every plan") for t in texts)


# Why


def test_a_gain_is_the_cause_from_a_factor_of_one_on():
    """One is no contraction; a factor below it, or none, is no cause."""
    assert no_difference(factor=1.0) == " Its iteration is no contraction (predicted factor 1). Lower the gain."
    assert no_difference(factor=1.2345) == " Its iteration is no contraction (predicted factor 1.23). Lower the gain."
    assert no_difference(factor=0.99) == no_difference() == ""


def test_a_factor_of_one_without_any_slope_is_not_the_iterations():
    """A reality that rounds its dose: no gain is to be lowered for it."""
    text = no_difference(factor=1.0, slopes=[0.0, 0.0])
    assert text == (
        " The predicted factor of 1 is not its iteration's: no small change of a command moves the response, as where it "
        "is rounded."
    )


def test_a_gain_is_the_cause_where_the_factor_is_above_one_in_a_twentieth_of_the_cycles():
    """A worst instant is no cause; how long it lasts is told."""
    assert no_difference(factor=1.61, growing=0.04) == ""
    assert no_difference(factor=1.61, growing=0.25) == (
        " Its iteration is no contraction in 25 % of the cycles (predicted factor 1.61). Lower the gain."
    )


def test_a_step_limit_is_the_cause_from_the_largest_change_on():
    """The vector changes by (3, 4), 5 in size, once: a limit of 5 is too small, one of 5.01 is not."""
    changing = np.where(np.arange(CYCLES)[:, None] < 50, 0.0, [3.0, 4.0])
    plain = entry("RHC", desired=changing)
    assert no_difference(plain=plain, settings={"step_limit": 2.0}) == (
        " The desired response changes by up to 5 in one cycle, more than the map's largest step of 2: raise its scale S at "
        "least 5 times, or leave S out to have it chosen."
    )
    assert "raise its scale S at least 2 times" in no_difference(plain=plain, settings={"step_limit": 5.0})
    chosen = no_difference(plain=plain, settings={"step_limit": 2.0}, facts={"automatic": ("scale",)})
    assert chosen.endswith(
        "the scale S that was chosen automatically did not foresee this, so state one that is at least 5 times as large."
    )
    assert no_difference(plain=plain, settings={"step_limit": 5.01}) == ""
    assert no_difference(plain=plain) == ""
    # What the adaptive controller asks for may diverge because of something else.
    assert no_difference(desired=changing, settings={"step_limit": 2.0}) == ""


def test_runs_that_end_early_show_neither_limits_nor_slew():
    """Before the first cycle that counts a share is no number, and a desired response that diverges asks for no larger scale."""
    assert limit_cause(entry("RHC"), entry("FPI", "RHC", measured={"at_limit": {"": np.nan}})) == ""
    changing = np.where(np.arange(CYCLES)[:, None] < 50, 0.0, [3.0, 4.0])
    adaptive = entry("FPI", "RHC", settings={"step_limit": 2.0})
    assert _slew_cause(entry("RHC", desired=changing), adaptive)
    assert _slew_cause(entry("RHC", desired=changing, stop="the state diverges"), adaptive) == ""


def test_a_run_of_two_cycles_shows_no_slew():
    plain = [entry("RHC", desired=np.arange(CYCLES)[:, None] * [1.0, 0.0], cycles=cycles) for cycles in (2, 3)]
    short, enough = (no_difference(plain=p, settings={"step_limit": 0.5}) for p in plain)
    assert short == ""
    assert enough.startswith(" The desired response changes by up to 1 in")


def test_a_cost_of_absolute_effort_is_a_cause():
    """Only where the settings say so; causes follow each other in the order in which they act."""
    assert no_difference(settings={"weighs_effort": True}) == EFFORT
    assert no_difference(settings={"weighs_effort": False}) == ""
    both = no_difference(factor=2.0, settings={"weighs_effort": True})
    assert both == EFFORT + " Its iteration is no contraction (predicted factor 2). Lower the gain."
    [ended] = said(entry("RHC"), entry("FPI", "RHC", stop=STOP, factor=2.0))
    assert ended.endswith(f"{STOP}. Its iteration is no contraction (predicted factor 2). Lower the gain.")
    [worse] = said(entry("RHC"), entry("FPI", "RHC", errors={"y": 2.0}, factor=2.0))
    assert worse.endswith("2 m (2 times more). Its iteration is no contraction (predicted factor 2). Lower the gain.")


def test_a_full_stop_stands_between_causes():
    """Advice on a gain may come without one."""
    often = {"total_variation": {"u": 12.0}, "effort": {"u": 1.0}}
    plain = entry("RHC", measured={"total_variation": {"u": 0.1}, "effort": {"u": 1.0}})
    both = no_difference(plain=plain, factor=2.0, advice="Lower the gain", measured=often)
    assert both.startswith(
        " Its iteration is no contraction (predicted factor 2). Lower the gain. Its command moves 120 times"
    )


def test_plans_that_did_not_converge_are_a_cause_from_a_twentieth_of_the_cycles_on():
    """On a stirred tank reactor 3 iterations made RHC+FPI 1.8 times worse than RHC, and 40 iterations 8.6 times better."""

    def with_failures(share: float, before: float = 0.0) -> str:
        without, adapting = ({"status": {"NOT_CONVERGED": one * CYCLES}} for one in (before, share))
        return no_difference(plain=entry("RHC", measured=without), measured=adapting)

    def at_the_optimum(worst: float) -> str:
        facts = {"optimality": Optimality(worst, worst, 25)}
        return no_difference(measured={"status": {"NOT_CONVERGED": CYCLES}}, facts=facts)

    assert at_the_optimum(1e-13) == ""  # one iteration on a linear plan is its optimum, with a step above the tolerance
    assert at_the_optimum(1e-3).startswith(" Its plans did not converge in 100 %")
    assert with_failures(0.04) == ""
    assert with_failures(0.42, 0.34) == (
        " Its plans did not converge in 42 % of the cycles (those of RHC in 34 %), so this is not the optimum of its cost: give "
        "the optimiser more iterations, then compare."
    )
    swinging = {"status": {"NOT_CONVERGED": 0.41 * CYCLES}, "at_limit": {"": 0.4}}
    assert no_difference(measured=swinging).startswith(" Its command stands at a limit in 40 % of the cycles")


def test_errors_of_the_start_hide_no_difference_at_the_end():
    """Where the last quarters differ and both are small beside the whole, the start is what was compared."""
    begin = np.array([[8.0, 0.0]]) * (np.arange(CYCLES) < CYCLES // 2)[:, None]
    ends = {name: begin + np.array([size, 0.0]) for name, size in (("RHC", 1.0), ("FPI", 0.01))}
    pair = entry("RHC", true_error=ends["RHC"]), entry("FPI", "RHC", true_error=ends["FPI"])
    assert first(*pair).text.endswith(
        "Most of this error is that of the start; in the last quarter of the run it is 1 and 0.01 m: state measure_from."
    )
    assert "start" not in first(pair[0], entry("FPI", "RHC", true_error=ends["RHC"])).text


def test_commands_at_their_limits_are_a_cause_from_a_fifth_of_the_cycles_on():
    def with_limits(share: float, before: float = 0.0, **both: Any) -> str:
        plain = entry("RHC", measured={"at_limit": {"": before}}, **both)
        return no_difference(plain=plain, measured={"at_limit": {"": share}}, **both)

    assert with_limits(0.19) == ""
    head = " Its command stands at a limit in 90 % of the cycles (that of RHC in "
    assert with_limits(0.9, 0.01) == (
        f"{head}1 %), where no adaptation can act: it asks for too much, or oscillates; the command in the report shows which."
    )
    assert with_limits(0.9, 0.5) == (
        f"{head}50 %), where no adaptation can act: slow the reference down or ask for less, or widen limits that are a choice."
    )
    assert with_limits(0.9, 0.5, reference=np.arange(CYCLES) / CYCLES) == (
        f"{head}50 %): both swing to and fro where the reference does not. Mend the loop without adaptation first; see its review."
    )
    assert with_limits(0.9, math.nan).startswith(
        " Its command stands at a limit in 90 % of the cycles, where"
    )  # it ended
    falling = np.concatenate([np.full(CYCLES // 2, 10.0), np.linspace(9.0, 8.0, CYCLES - CYCLES // 2)])
    assert with_limits(0.5, 0.4, command=falling) == (
        " Its command stands at a limit in 50 % of the cycles (that of RHC in 40 %), while it comes from its start: state "
        "measure_from, from which errors count."
    )
    alone = entry("RHC", measured={"at_limit": {"": 0.5}}, reference=np.arange(CYCLES) / CYCLES)
    ramp = {"reference": np.arange(CYCLES) / CYCLES, "command": np.arange(CYCLES)}
    assert no_difference(plain=alone, measured={"at_limit": {"": 0.9}}, **ramp) == (
        f"{head}50 %): RHC swings to and fro where the reference does not. Mend the loop without adaptation first; see its review."
    )
    assert with_limits(0.9, 0.5, reference=np.full(CYCLES, 115.0)) == (
        f"{head}50 %), where no adaptation can act: disturbances and noise ask for more than the limits allow, or the loop swings "
        "by itself; its review says whether it is stable."
    )
