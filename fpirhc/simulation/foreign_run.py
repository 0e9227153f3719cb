"""A run with a foreign reality: cycle by cycle, one call of the compiled step and one of the object outside."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from fpirhc.simulation.ranges import Dropped, physical_ranges
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.task.problem import Problem

Patch: TypeAlias = tuple[int, np.ndarray, np.ndarray]  # cycle, places in the memory, their values


def run_foreign(
    problem: Problem,
    start: np.ndarray,
    loop: Composite,
    evaluator: Evaluator,
    seed: int,
    tables: Sequence[np.ndarray],
    progress: Callable[[int, int], None] | None,
    patches: Sequence[Patch] = (),
) -> tuple[np.ndarray, str | None]:
    """Return the log, shape (cycles, trace.size), and the reason why the run ended early.

    Args:
        problem: with a foreign reality.
        start: first memory of the loop.
        loop: one cycle, which the log is of.
        evaluator: of one cycle of the loop.
        seed: with which the reality is reset.
        tables: disturbances and the sensors' random series, one row per cycle.
        progress: called with (cycles done, cycles in all).
        patches: changes of the memory before some cycles.

    Raises:
        InvalidProblem: a bad first answer.
    """
    foreign, cycles, trace, dropped = problem.foreign, problem.cycles, loop.trace, Dropped(loop)
    assert foreign is not None
    memory, *inputs = evaluator.arguments
    *random, answer, held = inputs
    log, ranges, bridged = np.empty((cycles, trace.size)), physical_ranges(problem, trace), 0
    memory[:], held[0] = start, 0.0
    answer[:] = foreign.first(seed)
    for k in range(cycles):
        for argument, table in zip(random, tables, strict=True):
            argument[:] = table[k]
        _patch(memory, k, patches)
        failure = evaluator.failure()
        if failure:
            return log[:k], stopped(problem, k, f"a solver failed ({failure})")
        memory_next, row, sent = evaluator.results
        bad = dropped.first_bad(row[None, :], log[k - 1] if k else None)
        if bad is not None:
            return log[:k], stopped(problem, k, f"signal '{trace.columns[bad[1]]}' is not finite")
        outside = ranges.first_outside(row[None, :])
        if outside is not None:
            return log[:k], stopped(problem, k, outside[1])
        log[k] = row
        memory[:] = memory_next
        reading = foreign.read(k * problem.period, sent.copy())
        bridged = 0 if reading.values is not None else bridged + 1
        if bridged > foreign.holds and k + 1 < cycles:
            return log[: k + 1], stopped(problem, k + 1, reading.mistake) + foreign.remedy
        held[0] = float(reading.values is None)
        if reading.values is not None:
            answer[:] = reading.values
        if progress:
            progress(k + 1, cycles)
    return log, None


def _patch(memory: np.ndarray, cycle: int, patches: Sequence[Patch]) -> None:
    for at, places, values in patches:
        if at == cycle:
            memory[places] = values


def stopped(problem: Problem, cycle: int, what: str) -> str:
    """Return the reason why a run ended before this cycle."""
    when = f"at t = {cycle * problem.period:g} {problem.time_unit} (cycle {cycle})"
    return f"{what} {when}; the run keeps the cycles before it"
