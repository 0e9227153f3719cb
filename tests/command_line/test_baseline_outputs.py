"""Terminal and Markdown say the same about a check, because they lay out one outline."""

from __future__ import annotations

import pytest

from fpirhc.baselines.judging import Judgement, Row
from fpirhc.baselines.outline import outline
from fpirhc.baselines.printing import show_check, to_markdown

HOLDING = Row("RHC", "rms_error.y", 1.0, 1.0, 0.1, "holds")
QUIET = Row("RHC", "cycles", 300, 300, None, "holds")
WORSE = Row("RHC+FPI", "effort.u", 1.0, 2.0, 0.1, "worse")
ENDED = Row("PID", "outcome", "finished", "ended early", None, "changed")
GOOD = Judgement("good", (HOLDING, QUIET), reason="first", date="2026-01-01")
BAD = Judgement("bad", (HOLDING, QUIET, WORSE, ENDED), reason="first", date="2026-01-01", notes=("PID: not finite",))
MISSING = Judgement("missing", unusable=("there is no baseline 'missing.json'",))
BROKEN = Judgement("broken", broken="no file at 'broken.py'")
EVERY = outline([GOOD, BAD, MISSING, BROKEN], [("chain", "takes a minute")])


@pytest.fixture
def texts(capsys):
    """Both outputs, without what their formats add."""
    show_check(EVERY, every=False)
    terminal = " ".join(capsys.readouterr().out.split())
    markdown = to_markdown(EVERY).replace("&#95;", "_").replace("&#58;", ":")
    return {"terminal": terminal, "markdown": markdown}


def test_an_outline_groups_by_controller_and_knows_what_changed():
    """Controllers stand in the order of their rows; what is unclear is so for a reason."""
    bad = EVERY.sections[1]
    assert [case.controller for case in bad.cases] == ["RHC", "RHC+FPI", "PID"]
    assert [line.cells[1] for case in bad.cases for line in case.changed] == ["effort.u", "outcome"]
    assert [line.in_summary for line in bad.lines] == [True, False, True, True]
    assert [one.holds for one in EVERY.sections] == [True, False, False, False]
    assert [one.unclear for one in EVERY.sections] == [False, False, True, True]
    assert bad.headline == "bad: 2 of 4 metrics changed"
    assert bad.lines[2].sentence == "RHC+FPI: effort.u was 1, is 2 (+100 %, band \u00b1 0.1): worse"
    assert bad.lines[3].sentence == "PID: outcome was finished, is ended early: changed"


@pytest.mark.parametrize("form", ["terminal", "markdown"])
@pytest.mark.parametrize("word", ["effort.u", "RHC+FPI", "ended early", "missing.json", "no file at"])
def test_every_form_has_what_changed_and_what_is_unclear(form, word, texts):
    """Nothing that makes a check fail is left out of any output."""
    assert word in texts[form]


def test_metrics_that_hold_are_not_in_the_way(texts, capsys):
    """A count that holds is in no summary; --all shows it on the terminal."""
    assert "cycles" not in texts["terminal"]
    assert "cycles" not in texts["markdown"]
    show_check(EVERY, every=True)
    assert "cycles" in capsys.readouterr().out
