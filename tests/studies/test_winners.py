"""The study of winners: laws that its maps must show, and a page that says what the maps say."""

from __future__ import annotations

import math
import re

import pytest
import winners

CELL = re.compile(r"(?:[-FGRVB]+ [\d.]+|none)")


def test_at_equal_information_iteration_and_filter_are_one_estimate():
    """With b = 1 and little noise F and R are level, and both beat the velocity alone; with much noise the velocity beats both."""
    little, much = (winners.errors(share, (1.0,), (0,), "FRV", seeds=(0,))[1.0, 0] for share in (0.01, 100.0))
    assert little["F"] == pytest.approx(little["R"], rel=0.05)
    assert little["V"] > 2 * little["F"]
    assert much["F"] > 5 * much["V"]


def test_limits_of_the_gain():
    """At b = 5 what is tuned for b = 1 on the response diverges; the gentle iteration and the velocity bear it."""
    found = winners.errors(0.01, (5.0,), (0,), seeds=(0,))[5.0, 0]
    assert all(math.isinf(found[name]) for name in "FRB")
    assert found["V"] < found["G"] < 1.1 * found["V"] < 0.1 * found["-"]


@pytest.mark.slow
def test_a_latency_leaves_the_iteration_level_until_it_diverges():
    found = winners.errors(1.0, (0.5, 1.0), (3, 8), "F", seeds=(0,))
    assert found[0.5, 3]["F"] == pytest.approx(found[0.5, 8]["F"], rel=0.15)
    filters = winners.errors(1.0, (0.5,), (8,), "RVB", seeds=(0,))[0.5, 8]
    assert min(filters.values()) > 3 * found[0.5, 8]["F"]
    assert math.isinf(found[1.0, 8]["F"])


@pytest.mark.slow
def test_the_page_has_the_maps_of_the_script():
    """Every row and column of the script has a cell, and one row is made again."""
    page = winners.PAGE.read_text(encoding="utf-8")
    for name, rows in (("noise", winners.SHARES), ("latency", winners.LATENCIES)):
        lines = page.partition(f"<!-- begin {name} -->")[2].partition("<!-- end")[0].strip().splitlines()[2:]
        cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
        assert [row[0] for row in cells] == [f"{one:g}" for one in rows]
        assert all(len(row) == 1 + len(winners.GAINS) and all(map(CELL.fullmatch, row[1:])) for row in cells)
    again = winners.best(winners.errors(10.0, (0.5,), (0,))[0.5, 0])
    assert f"| {again} |" in page.partition("| 10 |")[2].partition("\n")[0]
