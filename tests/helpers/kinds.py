"""The shipped problems as parameters of a law: in the slow lane are those that repeat another's kind of plant, sensors and plan."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

_FOLDER = Path(__file__).parents[2] / "problems"
NAMES = sorted(p.stem for where in (_FOLDER, _FOLDER / "gallery") for p in where.glob("[!_]*.py"))

ALIKE = {  # a problem of the same kind: the problems that repeat it
    "anaesthesia": ("anaesthesia_drawn", "anaesthesia_monitor", "anaesthesia_people", "anaesthesia_stimulated"),
    "cart_pole_slots": ("crane_slots", "mass_spring_slots", "two_tanks_slots"),
    "delayed_mass": ("delayed_tanks",),
    "diabetes": ("diabetes_announced", "diabetes_order_five"),
    "freeway_metering": ("freeway_coordinated", "freeway_economic"),
    "hodgkin_huxley": ("hodgkin_huxley_silent",),
    "tumour": ("tumour_daily", "tumour_portions", "tumour_vessels"),
    "turbojet": ("turbojet_slow",),
    "two_link_arm": ("planar_arm", "puma560", "three_link_arm"),
    "van_der_pol": ("van_der_pol_duffing",),
}


def shipped(*long: str) -> list[Any]:
    """All names; those that repeat another, and those that take long here, with the mark of the slow lane."""
    slow = {*long, *(name for names in ALIKE.values() for name in names)}
    assert slow | {*ALIKE} <= {*NAMES}
    return [pytest.param(n, marks=[pytest.mark.slow] if n in slow else ()) for n in NAMES]


def slow_but(values: Iterable[Any], *quick: Any) -> list[Any]:
    """The values as parameters: all but the quick ones, which stand for their kind, with the mark of the slow lane."""
    values = list(values)
    assert {*quick} <= {*values}
    marks = [() if v in quick else (pytest.mark.slow,) for v in values]
    return [pytest.param(*(v if isinstance(v, tuple) else (v,)), marks=m) for v, m in zip(values, marks, strict=True)]
