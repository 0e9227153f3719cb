"""Names in a horizon are checked where the problem is written, before any controller plans."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

import fpirhc as fp
from fpirhc.errors import InvalidProblem

TASK = fp.load_problem("van_der_pol").problem
LIMITED = replace(TASK.limits, states={"q": (-3.0, 3.0)})


@pytest.mark.parametrize(
    ("horizon", "limits", "words"),
    [
        ({"terminal": ("end",)}, LIMITED, r"horizon: terminal: state 'end' is unknown\. Valid: q, q'"),
        ({"terminal": ("q", "qq")}, LIMITED, r"'qq' is unknown\. Did you mean 'q'"),
        ({"margins": {"q'": 0.1}}, LIMITED, r"margins: limit of state 'q'' is unknown\."),
        ({"margins": {"q": 3.0}}, LIMITED, "leaves nothing between its limits -3 and 3"),
        ({"margins": {"q": 0.1}}, replace(LIMITED, soft={"q": 1.0}), "its limit is soft or has a price"),
    ],
)
def test_a_wrong_name_is_refused_with_the_problem(horizon: dict[str, Any], limits: fp.Limits, words: str) -> None:
    assert TASK.horizon is not None
    with pytest.raises(InvalidProblem, match=words):
        replace(TASK, horizon=replace(TASK.horizon, **horizon), limits=limits)
