"""The shipped problems as parameters of a law: one of each kind, and all of them in the slow lane."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

_FOLDER = Path(__file__).parents[2] / "problems"
NAMES = sorted(p.stem for where in (_FOLDER, _FOLDER / "gallery") for p in where.glob("[!_]*.py"))

# One of each kind: a linear plant, an unstable one, slots, dead time, a map of steps, a reality, a learner, limits of states.
EIGHT: tuple[str, ...] = ("two_mass", "cart_pole", "two_tanks_slots", "delayed_mass")
EIGHT += ("fishery", "heat_exchanger", "turbojet", "chain_of_masses")


def shipped(*long: str) -> list[Any]:
    """All names; all but one of each kind, and those that take long here, with the mark of the slow lane."""
    assert {*long, *EIGHT} <= {*NAMES}
    return [pytest.param(n, marks=() if n in EIGHT and n not in long else pytest.mark.slow) for n in NAMES]


def slow_but(values: Iterable[Any], *quick: Any) -> list[Any]:
    """The values as parameters: all but the quick ones, which stand for their kind, with the mark of the slow lane."""
    values = list(values)
    assert {*quick} <= {*values}
    marks = [() if v in quick else (pytest.mark.slow,) for v in values]
    return [pytest.param(*(v if isinstance(v, tuple) else (v,)), marks=m) for v, m in zip(values, marks, strict=True)]
