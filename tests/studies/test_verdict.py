"""The verdict from rows made by hand: outcomes and ratios, flags, the number that a problem is judged by, remarks."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import fpirhc as fp
from fpirhc import Run
from fpirhc.contracts import Layout, Signal
from fpirhc.report.html import css_class
from fpirhc.report.terminal import STYLES
from fpirhc.simulation.metrics import Metrics, known_metrics
from fpirhc.simulation.trials import ErrorPair
from fpirhc.studies.comparison.compare import Entry
from fpirhc.studies.comparison.verdict import FLAGS, Finding, Outcome, Yardstick, findings, judge
from fpirhc.studies.objective import Objective

CYCLES = 100
UNITS = {"y": "m", "z": "rad"}
NUMBER = fp.Metric("in_band", lambda problem, run: 1.0, better="larger", unit="h")
BOTH = {"y": 1.0, "z": 1.0}


def entry(name: str, pair: str | None = None, *, errors: Any = None, **facts: Any) -> Entry:
    """A row with these errors of y [m] and z [rad]; `facts` are its other fields, numbers of metrics, and signals of its run."""
    signals = [Signal("error", ("y", "z"), ("m", "rad")), Signal("command", ("u",), ("N",))]
    signals.append(Signal("true_error", ("y", "z"), ("m", "rad")))
    command = np.asarray(facts.pop("command", np.linspace(0, 1, CYCLES)), dtype=float)[:, None]
    true_error = np.asarray(facts.pop("true_error", np.ones((CYCLES, 2))), dtype=float)
    log = np.hstack([np.zeros((CYCLES, 2)), command, true_error])
    run = Run("case", name, 0, 0.1, Layout(tuple(signals)), log, facts.pop("stop", None), False, {})
    numbers = {"rms_error": errors or BOTH, **facts.pop("measured", {})}
    metrics = Metrics(numbers, {}, {m.name: m for m in (*known_metrics(), NUMBER)})
    grows = facts.pop("grows", None)
    usual: dict[str, Any] = {"weighed": None, "exact": False, "adaptive": pair is not None}
    contraction = cast(Any, None if grows is None else SimpleNamespace(growing=grows))
    return Entry(name, run, metrics, pair=pair, contraction=contraction, **(usual | facts))


def yard(**changes: Any) -> Yardstick:
    return Yardstick(**({"scales": BOTH, "alone": {}, "moving": frozenset(BOTH)} | changes))


def verdict(*entries: Entry, aim: Objective | None = None, headline: Any = None, **changes: Any) -> tuple[Finding, ...]:
    return findings(entries, headline, yard(**changes), {}, aim or Objective())


OUTCOMES = {
    "both lower": ({"y": 0.5, "z": 0.5}, {"y": 0.1, "z": 0.2}, "better", {"z": 0.4, "y": 0.2}),
    "a tenth lower is no difference": ({"y": 0.5, "z": 0.5}, {"y": 0.455, "z": 0.5}, "no difference", None),
    "a tenth higher is none": ({"y": 0.5, "z": 0.5}, {"y": 0.545, "z": 0.5}, "no difference", None),
    "one lower": ({"y": 0.5, "z": 0.5}, {"y": 0.445, "z": 0.5}, "better", {"z": 1.0, "y": 0.89}),
    "one higher": ({"y": 0.5, "z": 0.5}, {"y": 0.56, "z": 0.5}, "worse", {"y": 1.12, "z": 1.0}),
    "one of each": ({"y": 0.5, "z": 0.5}, {"y": 0.1, "z": 0.9}, "mixed", {"z": 1.8, "y": 0.2}),
    "minor beside the other": ({"y": 0.5, "z": 1e-5}, {"y": 0.1, "z": 1e-4}, "better", {"y": 0.2}),
    "small before and after": ({"y": 0.5, "z": 1e-3}, {"y": 1e-3, "z": 1e-2}, "mixed", {"z": 10.0, "y": 2e-3}),
    "from nothing": ({"y": 0.5, "z": 0.0}, {"y": 0.1, "z": 0.3}, "mixed", {"z": math.inf, "y": 0.2}),
    "rounding": ({"y": 1e-12, "z": 1e-13}, {"y": 1e-11, "z": 1e-12}, "no difference", {}),
    "no number": ({"y": math.nan, "z": 0.5}, {"y": 0.1, "z": 0.2}, "not comparable", {}),
    "both beyond the motion": ({"y": 1.5, "z": 0.5}, {"y": 1.2, "z": 0.2}, "not comparable", None),
    "one beyond the motion": ({"y": 1.5, "z": 0.5}, {"y": 0.9, "z": 0.2}, "better", {"y": 0.6, "z": 0.4}),
}


@pytest.mark.parametrize("name", OUTCOMES)
def test_outcomes_and_ratios(name):
    """Ratios of the errors that count, the largest first; an outcome is what they say."""
    before, after, outcome, ratios = OUTCOMES[name]
    found = judge(entry("RHC", errors=before), entry("FPI", "RHC", errors=after), yard())
    assert str(found.outcome) == outcome
    assert found.pair == ("RHC", "FPI")
    if ratios is not None:
        assert found.ratios == pytest.approx(ratios)
        assert list(found.ratios) == list(ratios)


def test_errors_count_by_their_scales_and_by_what_the_cost_weighs():
    """A scale of 1000 makes an error a minor one; what the cost does not weigh is not judged."""
    plain, adaptive = entry("RHC", errors={"y": 0.5, "z": 0.5}), {"y": 0.1, "z": 0.9}
    scaled = judge(plain, entry("FPI", "RHC", errors=adaptive), yard(scales={"y": 1.0, "z": 1000.0}))
    weighed = judge(plain, entry("FPI", "RHC", errors=adaptive, weighed=frozenset({"y"})), yard())
    assert scaled.outcome is weighed.outcome is Outcome.BETTER
    assert list(scaled.ratios) == list(weighed.ratios) == ["y"]


@pytest.mark.parametrize(
    ("ends", "outcome"), [((None, "b"), "worse"), (("a", None), "better"), (("a", "b"), "not comparable")]
)
def test_who_does_not_finish(ends, outcome):
    found = judge(entry("RHC", stop=ends[0]), entry("FPI", "RHC", stop=ends[1]), yard())
    assert str(found.outcome) == outcome
    for name, why in zip(("RHC", "FPI"), ends, strict=True):
        assert (f"{name} does not finish: {why}" in found.text) == (why is not None)


# --- Flags ------------------------------------------------------------------------------------------------------------

NULL = ErrorPair({"y": 0.01}, {"y": 0.7}, {"y": 1.0}, {"y": "m"})
GROWING = np.exp(np.linspace(0, 8, CYCLES))[:, None] * [1e-3, 1e-3]
ZIGZAG = np.arange(CYCLES) % 2
# Facts of the row with adaptation that raise the flag, facts that nearly do, and words of its sentence.
RAISED: tuple[tuple[dict[str, Any], dict[str, Any], str], ...] = (
    ({"alone": {"y": 0.05, "z": 0.05}}, {"alone": {"y": 0.05, "z": 0.2}}, "left alone"),
    ({"true_error": GROWING}, {"true_error": np.linspace(0.1, 3, CYCLES)[:, None] * [1, 1]}, "unstable loop"),
    (
        {"measured": {"status": {"NOT_CONVERGED": 6, "OK": 94}}},
        {"measured": {"status": {"NOT_CONVERGED": 5, "OK": 95}}},
        "did not converge",
    ),
    ({"measured": {"at_limit": {"": 0.21}}}, {"measured": {"at_limit": {"": 0.2}}}, "at a limit"),
    (
        {"measured": {"total_variation": {"u": 11.0}}, "command": ZIGZAG},
        {"measured": {"total_variation": {"u": 1.9}}, "command": ZIGZAG},
        "chatters",
    ),
    ({"measured": {"total_variation": {"u": 2.1}}}, {"measured": {"total_variation": {"u": 1.9}}}, "moves 2.1 times"),
    ({"grows": 0.06}, {"grows": 0.04}, "no contraction"),
    (
        {"null": NULL},
        {"null": ErrorPair({"y": 0.01}, {"y": 0.4}, {"y": 1.0}, {"y": "m"})},
        "the error of a right model 70 times",
    ),
)


def flagged(facts: dict[str, Any]) -> Finding:
    own = {name: value for name, value in facts.items() if name != "alone"}
    plain = entry("RHC", errors={"y": 0.5, "z": 0.5}, measured={"total_variation": {"u": 1.0}})
    adaptive = entry("FPI", "RHC", errors={"y": 0.1, "z": 0.1}, **own)
    return judge(plain, adaptive, yard(alone=facts.get("alone", {})))


@pytest.mark.parametrize("number", range(len(FLAGS)))
def test_a_flag_is_raised_from_its_threshold_on(number):
    """A smaller error is then doubtful, or better with a remark. The null test counts beside what the wrong model costs."""
    raised, nearly, words = RAISED[number]
    assert len(RAISED) == len(FLAGS) == 8
    found, calm = flagged(raised), flagged(nearly)
    assert words in found.text
    assert found.outcome is (Outcome.DOUBTFUL if FLAGS[number].doubts else Outcome.BETTER)
    assert calm.outcome is Outcome.BETTER
    assert words not in calm.text


def test_a_worse_error_stays_worse_with_its_flags():
    found = judge(
        entry("RHC", errors={"y": 0.1, "z": 0.1}), entry("FPI", "RHC", errors={"y": 0.5, "z": 0.5}, null=NULL), yard()
    )
    assert found.outcome is Outcome.WORSE
    assert "right model" in found.text


# --- The number, remarks, colours -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("before", "after", "outcome"),
    [
        (2.0, 3.0, "better"),
        (3.0, 2.0, "worse"),
        (2.0, 2.1, "no difference"),
        (2.0, math.nan, "worse"),
        (math.nan,) * 2 + ("not comparable",),
    ],
)
def test_the_number_that_a_problem_is_judged_by_comes_first(before, after, outcome):
    """Larger is better by the metric, whatever the errors say."""
    rows = [
        entry(name, pair, measured={"in_band": {"": value}})
        for name, pair, value in (("RHC", None, before), ("FPI", "RHC", after))
    ]
    first, second, *_ = verdict(*rows, aim=Objective(NUMBER, "", "h"))
    assert str(first.outcome) == outcome
    assert "in_band" in first.text
    assert second.outcome is Outcome.NO_DIFFERENCE


def test_the_headline_comes_first_and_the_best_row_is_named():
    rows = [
        entry("A", errors={"y": 0.5, "z": 0.5}),
        entry("A+FPI", "A", errors={"y": 0.3, "z": 0.3}),
        entry("B", errors={"y": 0.5, "z": 0.5}),
        entry("B+FPI", "B", errors={"y": 0.2, "z": 0.2}),
        entry("PID", errors={"y": 0.1, "z": 0.1}),
    ]
    found = verdict(*rows, headline=("B", "B+FPI"))
    assert [f.pair for f in found if f.pair] == [("B", "B+FPI"), ("A", "A+FPI")]
    assert found[2].text == "The smallest error is that of PID, 10 % of the range."
    alone = verdict(rows[0], rows[4])
    assert alone[0].outcome is Outcome.NOT_COMPARABLE
    assert "PID" in alone[1].text


def test_an_exact_model_is_the_bound_unless_it_is_beaten():
    """It is no rival, and by what the cost of the pair weighs; a row that leaves its reference is named."""
    plain, adaptive = entry("RHC", errors={"y": 0.5, "z": 0.5}), entry("FPI", "RHC", errors={"y": 0.2, "z": 0.2})
    for error, said in ((0.1, False), (0.21, False), (0.4, True)):
        found = verdict(plain, adaptive, entry("exact", exact=True, errors={"y": error, "z": error}))
        assert any("exact is no bound here: FPI have smaller errors" in f.text for f in found) == said
        assert any(f.text.startswith("The smallest error is that of FPI") for f in found)
    lost = verdict(plain, adaptive, entry("PID", errors={"y": 2.0, "z": 0.1}))
    assert any(f.text == "PID leaves the neighbourhood of its reference in y." for f in lost)


def test_what_does_not_help_is_never_green():
    """One outcome decides the words, the terminal's colour and the page's class."""
    assert [outcome for outcome in Outcome if "green" in STYLES[outcome]] == [Outcome.BETTER]
    assert len({css_class(outcome) for outcome in Outcome}) == len(Outcome)
