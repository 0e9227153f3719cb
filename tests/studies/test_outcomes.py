"""One outcome decides words and colours, in comparisons and in studies of scenarios."""

from __future__ import annotations

import re

import numpy as np
import pytest

from fpirhc.report.html import asset, css_class
from fpirhc.report.terminal import STYLES
from fpirhc.studies.comparison.outcome import Outcome
from fpirhc.studies.scenarios.paired import ConfidenceInterval, Summary, verdict


def summary(name: str, interval: tuple[float, float] | None) -> Summary:
    """A controller whose error differs from the baseline's by this interval."""
    difference = None if interval is None else ConfidenceInterval(sum(interval) / 2, *interval)
    errors = np.full(5, 0.1)
    return Summary(
        name,
        errors,
        errors,
        errors,
        0.1,
        0.1,
        0,
        "0",
        {"rms_error": {}},
        {},
        {"finished": 5},
        {},
        difference,
        1.0,
        2,
        0,
    )


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
