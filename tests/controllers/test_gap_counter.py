"""The gap counter of a gate, cycle by cycle, against its rules in plain Python."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc import Status
from fpirhc.conformance.loops import two_masses
from fpirhc.contracts import Block, Layout, scalar
from fpirhc.controllers.gate import AGAIN, Gap, across_gaps
from fpirhc.controllers.sensing_chain import compose_with_sensing
from fpirhc.symbolic.block import LONG, compose

NAMES = ("missing_cycles", "still_settling")


def cycle(gap: Gap, memory: tuple[float, float], *, fits: bool, time: float = 0.0, trusted: bool = False) -> Any:
    """What the step is told, its status where it was OK, and the memory after it."""
    s = SimpleNamespace(**{name: ca.DM(value) for name, value in zip(NAMES, memory, strict=True)})
    counts = gap.counts(cast(Any, s), trusted=trusted)
    told, passes = gap.seen(counts), gap.passes(counts, cast(Any, ca.DM(time)))
    after = gap.remembered(cast(Any, ca.DM(float(fits))), passes, counts, told)
    status = gap.status(cast(Any, ca.DM(int(Status.OK))), told)
    return (
        tuple(float(told[n]) for n in ("gap", "settling")),
        Status(int(status)),
        tuple(float(after[n]) for n in NAMES),
    )


@pytest.mark.parametrize("settles", [0.0, 3.0])
@pytest.mark.parametrize("bridged", [0, 2, 5])
@pytest.mark.parametrize("trusted", [False, True])
def test_counts_follow_their_rules(settles, bridged, trusted):
    """Missing cycles up to one beyond the bridged ones, and settling from a long gap on; nothing before the first sample."""
    gap, rng = Gap(bridged, settles), np.random.default_rng(bridged)
    memory, missing, still = (-1.0, 0.0), -1.0, 0.0
    lengths = [0, 3, 0, 1, 0, 0, 2, 0, 0, 0, 7, 0, 1, 0, 0, 0, 0, 5, 0, 6, *rng.integers(0, 8, 40).tolist()]
    pattern = [ok for length in lengths for ok in (*[False] * length, True)]
    for fits in [False, False, *pattern]:
        long = missing > bridged
        settling = (settles if long else max(still - 1, 0)) if settles else 0.0
        told, status, memory = cycle(gap, memory, fits=fits, trusted=trusted)
        assert told == (LONG if long else max(missing, 0.0), settling)
        expected = Status.SETTLING if settling else Status.BRIDGED if missing > 0 else Status.OK
        assert status == expected
        if fits:
            missing, still = 0.0, settling
        elif missing >= 0:
            missing = min(missing + 1, bridged + 1)
        assert memory == (missing, still)


def test_a_status_that_is_worse_stays():
    """Only OK becomes BRIDGED or SETTLING."""
    told = {"gap": ca.DM(2), "settling": ca.DM(1)}
    for status in Status:
        result = Gap(5, 3.0).status(cast(Any, ca.DM(int(status))), cast(Any, told))
        assert int(result) == (Status.SETTLING if status == Status.OK else status)


def test_a_cycle_that_is_given_again_is_no_missing_one():
    """Its time is beyond every time; the count stays."""
    for time, count in ((0.0, 2.0), (1e9, 2.0), (AGAIN, 1.0)):
        assert cycle(Gap(5, 0.0), (1.0, 0.0), fits=False, time=time)[2] == (count, 0.0)


@pytest.mark.parametrize(
    "bad", [(np.nan, 0.0), (0.0, np.nan), (7.0, 0.0), (-7.0, 0.0), (0.0, 4.0), (0.0, -4.0), (1e300, 1e300)]
)
def test_counts_that_cannot_be_are_those_of_the_start(bad):
    """After a flipped bit in the memory; a memory that a loop keeps itself is believed."""
    gap = Gap(5, 3.0)
    assert cycle(gap, bad, fits=False)[2] == (-1.0, 0.0)
    assert cycle(gap, bad, fits=True)[:2] == ((0.0, 0.0), Status.OK)
    for good in ((6.0, 0.0), (0.0, 3.0), (6.0, 3.0)):
        assert cycle(gap, good, fits=False)[2] == good if good[0] == 6.0 else (1.0, good[1])


def test_a_step_reads_the_gap_where_a_block_knows_it():
    problem = replace(two_masses(), sensing=fp.Sensing(estimator=fp.PositionDifference()))
    step = compose_with_sensing(problem, fp.ComputedTorque(fp.Exponential(rate=6.0)))
    assert "gap" not in step.reads
    assert "gap" in across_gaps(step).reads
    block = Block("b", Layout((scalar("a"),)), Layout((scalar("c"),)), lambda s: {"c": s.a})
    plain = compose("plain", block.reads, [block])
    assert across_gaps(plain) is plain
