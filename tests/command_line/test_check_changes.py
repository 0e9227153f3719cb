"""What a check says about changes: in percent, largest first, a stale setting before its consequences, a floor."""

from __future__ import annotations

import argparse
import math

import pytest

from fpirhc.baselines.baseline import BANDED, Baseline, Expected, Metric, Settings
from fpirhc.baselines.judging import BETTER, CHANGED, HOLDS, WORSE, Judgement, Row, ignoring, judge
from fpirhc.baselines.measuring import FINISHED, Measurement
from fpirhc.baselines.printing import cells, change, explained, headline, in_summary, sentence, show_check, to_markdown
from fpirhc.cli.options import percent


def expected(**values: float) -> Expected:
    """Metrics with bands of a millionth."""
    return Expected((FINISHED,), {n: Metric(BANDED, v, 1e-6 * abs(v), {}) for n, v in values.items()}, {})


def judged(old: dict[str, dict[str, float]], new: dict[str, dict[str, float]], before: Settings, now: Settings):
    """The judgement of controllers with these metrics."""
    baseline = Baseline(
        problem="case",
        reason="first",
        date="2026-01-01",
        seed=0,
        versions={},
        varied={},
        settings=before,
        controllers={name: expected(**values) for name, values in old.items()},
    )
    fresh = {name: Measurement(FINISHED, "", dict(values)) for name, values in new.items()}
    return judge(baseline, now, fresh)


def errors(**values: float) -> dict[str, float]:
    """Rms errors by coordinate."""
    return {f"rms_error.{name}": value for name, value in values.items()}


SAME = Settings({"period": 1e-3}, {"RHC": {"gain": 1.0}, "PID": {"gain": 2.0}})


def test_two_millionths_are_a_change_and_not_worse():
    """From a tenth of a percent on the direction counts; the value just inside and just outside."""
    old = {"RHC": errors(a=1.0, b=1.0, c=1.0, d=1.0), "PID": {}}
    new = {"RHC": errors(a=1 + 2e-6, b=1.0009, c=1.0011, d=0.9), "PID": {}}
    verdicts = {row.metric[-1]: row.verdict for row in judged(old, new, SAME, SAME).rows}
    assert {k: verdicts[k] for k in "abcd"} == {"a": CHANGED, "b": CHANGED, "c": WORSE, "d": BETTER}


def test_changes_are_in_percent_of_the_old_value():
    """Also of a negative one, and of one that was zero."""
    rows = [Row("c", "m", old, new, 0.1, CHANGED) for old, new in ((2.0, 3.0), (-2.0, -1.0), (0.0, 1.0), (0.0, 0.0))]
    assert [row.change for row in rows] == [0.5, 0.5, math.inf, 0.0]
    assert [change(row.change) for row in rows] == ["+50 %", "+50 %", "from zero", "0 %"]
    assert Row("c", "outcome", "finished", "ended early", None, CHANGED).change is None
    assert Row("c", "m", True, False, None, CHANGED).change is None


def test_the_largest_change_stands_first(capsys):
    """An outcome before all numbers; what holds comes last."""
    old = {"RHC": errors(a=1.0, b=1.0, c=1.0, d=1.0), "PID": errors(a=1.0)}
    new = {"RHC": errors(a=1.1, b=3.0, c=0.5, d=1.0), "PID": errors(a=1.2)}
    _, rows = explained(judged(old, new, SAME, SAME))
    assert [(row.controller, cells(row)[3]) for row in rows if not row.holds] == [
        ("RHC", "+200 %"),
        ("RHC", "-50 %"),
        ("PID", "+20 %"),
        ("RHC", "+10 %"),
    ]
    assert rows[-1].holds
    show_check([judged(old, new, SAME, SAME)], {}, every=False)
    shown = capsys.readouterr().out
    assert shown.index("+200 %") < shown.index("-50 %") < shown.index("+20 %") < shown.index("+10 %")


def test_a_stale_setting_stands_first_with_its_consequences_folded(capsys):
    """The changes of its controller are counted under it, not listed; a change that it cannot cause is listed."""
    now = Settings(SAME.problem, {**SAME.controllers, "RHC": {"gain": 1.5}})
    old = {"RHC": errors(a=1.0, b=1.0), "PID": errors(a=1.0)}
    new = {"RHC": errors(a=1.1, b=3.0), "PID": errors(a=1.2)}
    judgement = judged(old, new, SAME, now)
    [(text, own)], others = explained(judgement)
    assert text == "stale: controller 'RHC': gain was 1.0, is 1.5"
    assert [cells(row)[3] for row in own] == ["+200 %", "+10 %"]
    assert [cells(row)[3] for row in others if not row.holds] == ["+20 %"]
    show_check([judgement], {}, every=False)
    shown = " ".join(capsys.readouterr().out.split())
    assert shown.startswith("case: stale: controller 'RHC': gain was 1.0, is 1.5")
    assert "2 metrics changed with it (RHC: rms_error.b +200 %; RHC: rms_error.a +10 %); --all shows them" in shown
    assert shown.index("gain was") < shown.index("2 metrics changed") < shown.index("+20 %")
    assert shown.count("gain was") == 1
    page = to_markdown([judgement], {})
    assert page.index("gain") < page.index("<details><summary>2 metrics changed with it") < page.index("+20 ")
    assert page.index("+200 ") < page.index("</details>") < page.index("+20 ")
    show_check([judgement], {}, every=True)
    assert "+10 %" in capsys.readouterr().out


def test_a_setting_of_the_problem_explains_every_change():
    """And each change stands once, under the first setting that can have caused it."""
    now = Settings({"period": 2e-3}, {**SAME.controllers, "RHC": {"gain": 1.5}})
    old = {"RHC": errors(a=1.0), "PID": errors(a=1.0)}
    new = {"RHC": errors(a=1.1), "PID": errors(a=1.2)}
    causes, others = explained(judged(old, new, SAME, now))
    assert [len(rows) for _, rows in causes] == [2, 0]
    assert all(row.holds for row in others)


def test_a_floor_ignores_small_changes_and_nothing_else():
    """Counts, outcomes and metrics that are gone stay; what was ignored is counted."""
    rows = (
        Row("c", "small", 1.0, 1.0004, 1e-6, CHANGED),
        Row("c", "large", 1.0, 1.002, 1e-6, WORSE),
        Row("c", "count", 10_000, 10_001, None, CHANGED),
        Row("c", "gone", 1.0, None, 1e-6, CHANGED),
        Row("c", "outcome", "finished", "ended early", None, CHANGED),
    )
    left = ignoring(Judgement("case", rows), 1e-3)
    assert [row.verdict for row in left.rows] == [HOLDS, WORSE, CHANGED, CHANGED, CHANGED]
    assert left.notes == ("1 changes below 0.1 % are ignored",)
    assert ignoring(Judgement("case", rows), 0.0) == Judgement("case", rows)
    assert ignoring(Judgement("case", rows[:1]), 1e-3).holds


@pytest.mark.parametrize(("text", "value"), [("0.1%", 0.1), ("0.1", 0.1), ("0", 0.0), ("2 %", 2.0)])
def test_the_floor_is_a_percentage(text, value):
    assert percent(text) == value


@pytest.mark.parametrize("text", ["-1%", "a bit", "100%", "nan"])
def test_a_wrong_floor_is_refused(text):
    with pytest.raises(argparse.ArgumentTypeError, match=r"expected percent .* such as 20%"):
        percent(text)


# Terminal and Markdown say the same about a check, because they lay out the same rows, headlines and remarks


HOLDING = Row("RHC", "rms_error.y", 1.0, 1.0, 0.1, "holds")
QUIET = Row("RHC", "cycles", 300, 300, None, "holds")
MUCH_WORSE = Row("RHC+FPI", "effort.u", 1.0, 2.0, 0.1, "worse")
ENDED = Row("PID", "outcome", "finished", "ended early", None, "changed")
GOOD = Judgement("good", (HOLDING, QUIET), reason="first", date="2026-01-01")
BAD = Judgement(
    "bad", (HOLDING, QUIET, MUCH_WORSE, ENDED), reason="first", date="2026-01-01", notes=("PID: not finite",)
)
MISSING = Judgement("missing", unusable=("there is no baseline 'missing.json'",))
BROKEN = Judgement("broken", broken="no file at 'broken.py'")
EVERY = [GOOD, BAD, MISSING, BROKEN], {"chain": "takes a minute"}


@pytest.fixture
def texts(capsys):
    """Both outputs, without what their formats add."""
    show_check(*EVERY, every=False)
    terminal = " ".join(capsys.readouterr().out.split())
    markdown = to_markdown(*EVERY).replace("&#95;", "_").replace("&#58;", ":")
    return {"terminal": terminal, "markdown": markdown}


def test_a_summary_says_what_changed():
    """A row in a sentence, a problem in one."""
    assert [in_summary(row) for row in BAD.rows] == [True, False, True, True]
    assert in_summary(Row("PID", "rms_error.y", 1.0, 1.0, 0.1, HOLDS))
    assert headline(BAD) == "bad: 2 of 4 metrics changed"
    assert sentence(MUCH_WORSE) == "RHC+FPI: effort.u was 1, is 2 (+100 %, band \u00b1 0.1): worse"
    assert sentence(ENDED) == "PID: outcome was finished, is ended early: changed"


@pytest.mark.parametrize("form", ["terminal", "markdown"])
@pytest.mark.parametrize("word", ["effort.u", "RHC+FPI", "ended early", "missing.json", "no file at"])
def test_every_form_has_what_changed_and_what_is_unclear(form, word, texts):
    """Nothing that makes a check fail is left out of any output."""
    assert word in texts[form]


def test_metrics_that_hold_are_not_in_the_way(texts, capsys):
    """A count that holds is in no summary; --all shows it on the terminal."""
    assert "cycles" not in texts["terminal"]
    assert "cycles" not in texts["markdown"]
    show_check(*EVERY, every=True)
    assert "cycles" in capsys.readouterr().out
