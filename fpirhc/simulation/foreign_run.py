"""A run with a foreign reality: cycle by cycle, one call of the compiled step and one of the object outside."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.task.problem import Problem


def run_foreign(
    problem: Problem,
    start: np.ndarray,
    width: int,
    evaluator: Evaluator,
    seed: int,
    tables: Sequence[np.ndarray],
    progress: Callable[[int, int], None] | None,
) -> tuple[np.ndarray, str | None]:
    """Return the log, shape (cycles, width), and the reason why the run ended early.

    Args:
        problem: with a foreign reality.
        start: first memory of the loop.
        width: number of logged numbers per cycle.
        evaluator: of one cycle of the loop.
        seed: with which the reality is reset.
        tables: disturbances and the sensors' random series, one row per cycle.
        progress: called with (cycles done, cycles in all).

    Raises:
        InvalidProblem: a bad first answer.
    """
    foreign, cycles = problem.foreign, problem.cycles
    assert foreign is not None
    memory, *given = evaluator.arguments
    *random, answer, held = given
    log, memory[:], held[0], bridged = np.empty((cycles, width)), start, 0.0, 0
    answer[:] = foreign.first(seed)
    for k in range(cycles):
        for argument, table in zip(random, tables, strict=True):
            argument[:] = table[k]
        evaluator.evaluate()
        memory_next, row, sent = evaluator.results
        if not np.isfinite(row).all():
            return log[:k], _stop(problem, k, "a signal of the loop is not finite")
        log[k] = row
        memory[:] = memory_next
        reading = foreign.read(k * problem.period, sent.copy())
        bridged = 0 if reading.values is not None else bridged + 1
        if bridged > foreign.holds and k + 1 < cycles:
            return log[: k + 1], _stop(problem, k + 1, reading.mistake)
        held[0] = float(reading.values is None)
        if reading.values is not None:
            answer[:] = reading.values
        if progress:
            progress(k + 1, cycles)
    return log, None


def _stop(problem: Problem, cycle: int, why: str) -> str:
    when = f"at t = {cycle * problem.period:g} {problem.time_unit} (cycle {cycle})"
    return f"{why}, {when}; the run keeps the cycles before it"
