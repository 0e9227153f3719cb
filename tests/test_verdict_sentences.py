"""Every sentence of the verdict, word by word, from entries that were made by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hand_made_runs import CYCLES, SOLVE

from fpirhc.simulation.metrics import Metrics, known_metrics
from fpirhc.simulation.run import Run
from fpirhc.studies.comparison.compare import Entry
from fpirhc.studies.comparison.timing import CycleTime
from fpirhc.studies.comparison.verdict import verdict
from fpirhc.symbolic.layout import Layout, Signal

STOP = "signal 'x' is not finite"
EFFORT = (
    " Its cost weighs the absolute effort, so the optimum of the wrong model trades tracking against a wrong effort and "
    "adaptation realises that plan faithfully: weigh the deviation from the model's feedforward, or the input's rate."
)


def entry(name: str, pair: str | None = None, *, micro: float | None = 5.0, errors=None, **changes: Any) -> Entry:
    """An entry with these errors of y [m] and z [rad]; `changes` are stop, desired (rows), settings, planning, factor."""
    signals = [Signal("error", ("y", "z"), ("m", "rad")), Signal("desired", ("y", "z"), ("m/s2", "rad/s2"))]
    values = [np.zeros((CYCLES, 2)), np.broadcast_to(changes.get("desired", 0.0), (CYCLES, 2))]
    if changes.get("planning"):
        signals, values = [*signals, Signal("solve", SOLVE)], [*values, np.zeros((CYCLES, len(SOLVE)))]
    log = np.hstack(values)[: changes.get("cycles", CYCLES)]
    settings = {"step_limit": None, **changes.get("settings", {})}
    made = Run("case", name, 0, 0.1, Layout(tuple(signals)), log, changes.get("stop"), False, settings)
    metrics = Metrics({"rms_error": errors or {"y": 1.0}}, {}, {m.name: m for m in known_metrics()})
    factor = changes.get("factor")
    report = SimpleNamespace(predicted=factor, report=SimpleNamespace(text="Lower the gain."))
    cycle = None if micro is None else CycleTime(micro, micro, micro, micro, micro)
    contraction = cast(Any, None if factor is None else report)
    return Entry(name, made, metrics, cycle, pair is not None, pair, contraction)


def said(*entries: Entry, skipped=None, headline=None) -> tuple[str, ...]:
    return verdict(entries, skipped or {}, headline)


def no_difference(**adaptive: Any) -> str:
    """What is said beside 'no clear difference'."""
    plain = adaptive.pop("plain", None) or entry("RHC")
    [sentence] = said(plain, entry("FPI", "RHC", **adaptive))
    begin = "FPI makes no clear difference: the rms error of y from 1 to 1 m."
    assert sentence.startswith(begin)
    return sentence.removeprefix(begin)


# What happened


def test_who_finishes():
    """The adaptive run ended, the plain one, or both: the adaptive one is told first."""
    assert said(entry("RHC"), entry("FPI", "RHC", stop=STOP)) == (f"FPI does not finish: {STOP}.",)
    assert said(entry("RHC", stop=STOP), entry("FPI", "RHC")) == (f"FPI finishes where RHC does not ({STOP}).",)
    assert said(entry("RHC", stop="b"), entry("FPI", "RHC", stop="a")) == ("FPI does not finish: a.",)


def test_several_coordinates():
    """Each has its numbers and unit; the factor is that of the coordinate with the largest error before."""
    plain, adaptive = entry("RHC", errors={"y": 1.0, "z": 2.0}), entry("FPI", "RHC", errors={"y": 0.5, "z": 0.2})
    assert said(plain, adaptive) == (
        "FPI lowers the rms error of y from 1 to 0.5 m, z from 2 to 0.2 rad (10 times less for z) at no more time per cycle.",
    )
    worse = entry("FPI", "RHC", errors={"y": 1.5, "z": 4.0})
    assert said(plain, worse) == (
        "FPI does not help: it raises the rms error of y from 1 to 1.5 m, z from 2 to 4 rad.",
    )
    mixed = entry("FPI", "RHC", errors={"y": 0.1, "z": 4.0})
    assert said(plain, mixed)[0].startswith("FPI makes no clear difference: the rms error of y from 1 to 0.1 m, z from")


def test_an_error_that_was_zero_has_no_ratio():
    """Nothing can be said of a share of zero; a tiny error has one."""
    zero, some = entry("RHC", errors={"y": 0.0}), entry("FPI", "RHC", errors={"y": 0.1})
    assert said(zero, some) == ("FPI makes no clear difference: the rms error of y from 0 to 0.1 m.",)
    tiny = entry("RHC", errors={"y": 1e-3}), entry("FPI", "RHC", errors={"y": 1e-4})
    assert "(10 times less for y)" in said(*tiny)[0]


@pytest.mark.parametrize(
    ("times", "price"),
    [
        ((5.0, 7.5), " at 2.5 more microseconds per cycle."),
        ((5.0, 5.4), " at 0.4 more microseconds per cycle."),
        ((5.0, 5.0), " at no more time per cycle."),
        ((5.0, None), "."),
        ((None, 5.0), "."),
    ],
)
def test_price(times, price):
    """The difference of the median times; nothing where one was not measured."""
    plain, adaptive = entry("RHC", micro=times[0]), entry("FPI", "RHC", micro=times[1], errors={"y": 0.5})
    assert said(plain, adaptive) == (f"FPI lowers the rms error of y from 1 to 0.5 m (2 times less for y){price}",)


def test_order_of_the_sentences():
    """The headline pair, then receding horizons, then the others as they come; each once."""
    pairs = [
        *(entry("CTC"), entry("CTC+FPI", "CTC")),
        *(entry("PID"), entry("PID+FPI", "PID")),
        *(entry("RHC", planning=True), entry("RHC+FPI", "RHC", planning=True)),
        entry("lost", "nobody"),
    ]
    names = [s.split()[0] for s in said(*pairs, headline=("PID", "PID+FPI"))]
    assert names == ["PID+FPI", "RHC+FPI", "CTC+FPI"]
    assert [s.split()[0] for s in said(*pairs)] == ["RHC+FPI", "CTC+FPI", "PID+FPI"]
    assert [s.split()[0] for s in said(*pairs, headline=("CTC", "PID+FPI"))] == ["RHC+FPI", "CTC+FPI", "PID+FPI"]


def test_no_pair():
    """The smallest worst error, of those that finished; and what is said where none did or none ran."""
    alone = [entry("A", errors={"y": 0.1, "z": 0.5}), entry("B", errors={"y": 0.4, "z": 0.4})]
    assert said(*alone, entry("C", stop=STOP, errors={"y": 0.0})) == (
        "B has the smallest rms error (0.4); no controller is here both with and without adaptation, so adaptation itself is "
        "not judged.",
    )
    assert said(entry("A", stop="a"), entry("B", stop="b")) == ("No controller finished its run: A: a; B: b.",)
    assert said() == ("No controller finished, so nothing can be compared.",)
    assert said(skipped={"A": "no horizon", "B": "no limits"})[1:] == ("Not run: A (no horizon); B (no limits).",)


# Why


def test_a_gain_is_the_cause_from_a_factor_of_one_on():
    """One is no contraction; a factor below it, or none, is no cause."""
    assert no_difference(factor=1.0) == " Its iteration is no contraction (predicted factor 1): Lower the gain."
    assert no_difference(factor=1.2345) == " Its iteration is no contraction (predicted factor 1.23): Lower the gain."
    assert no_difference(factor=0.99) == no_difference() == ""


def test_a_step_limit_is_the_cause_from_the_largest_change_on():
    """The vector changes by (3, 4), 5 in size, once: a limit of 5 is too small, one of 5.01 is not."""
    changing = np.where(np.arange(CYCLES)[:, None] < 50, 0.0, [3.0, 4.0])
    plain = entry("RHC", desired=changing)
    assert no_difference(plain=plain, settings={"step_limit": 2.0}) == (
        " The desired response changes by up to 5 in one cycle, more than the map's largest step of 2: raise its scale S at "
        "least 3.1 times, or leave S out to have it chosen."
    )
    assert "raise its scale S at least 1.2 times" in no_difference(plain=plain, settings={"step_limit": 5.0})
    assert no_difference(plain=plain, settings={"step_limit": 5.01}) == ""
    assert no_difference(plain=plain) == ""
    # What the adaptive controller asks for may diverge because of something else.
    assert no_difference(desired=changing, settings={"step_limit": 2.0}) == ""


def test_a_run_of_two_cycles_shows_no_slew():
    """Three cycles do."""
    plain = [entry("RHC", desired=np.arange(CYCLES)[:, None] * [1.0, 0.0], cycles=cycles) for cycles in (2, 3)]
    short, enough = (no_difference(plain=p, settings={"step_limit": 0.5}) for p in plain)
    assert short == ""
    assert enough.startswith(" The desired response changes by up to 1 in")


def test_a_cost_of_absolute_effort_is_a_cause():
    """Only where the settings say so; causes follow each other, the gain first."""
    assert no_difference(settings={"weighs_effort": True}) == EFFORT
    assert no_difference(settings={"weighs_effort": False}) == ""
    both = no_difference(factor=2.0, settings={"weighs_effort": True})
    assert both == " Its iteration is no contraction (predicted factor 2): Lower the gain." + EFFORT
    [ended] = said(entry("RHC"), entry("FPI", "RHC", stop=STOP, factor=2.0))
    assert ended.endswith(f"{STOP}. Its iteration is no contraction (predicted factor 2): Lower the gain.")
    [worse] = said(entry("RHC"), entry("FPI", "RHC", errors={"y": 2.0}, factor=2.0))
    assert worse.endswith("2 m. Its iteration is no contraction (predicted factor 2): Lower the gain.")
