"""Two ways of doing the same, timed in turns that change places: best times, and the quotient of neighbours with its quartiles."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np

from fpirhc.simulation.loop import start_memory
from fpirhc.simulation.path import CHUNK
from fpirhc.simulation.simulate import Simulator

Work = Callable[[], float]  # process time, s


def loop_time(ready: Simulator) -> Work:
    """Process time of the compiled loop alone, over the whole run, with the live settings of its start."""
    log = np.empty((CHUNK, ready.loop.trace.size))
    start = start_memory(ready.loop, ready.problem, ready.controller, ready.live.start)

    def work() -> float:
        evaluator = ready.evaluator
        evaluator.arguments[0][:] = start
        evaluator.redirect(1, log)
        begin = time.process_time()
        for _ in range(ready.problem.cycles // CHUNK):
            evaluator.evaluate()
            evaluator.arguments[0][:] = evaluator.results[0]
        return time.process_time() - begin

    return work


def compared(works: Sequence[Work], count: int, repeats: int) -> list[str]:
    """Cells of a row: microseconds of the first and of the second work, and the difference in percent.

    Args:
        works: two.
        count: cycles or steps of one work.
        repeats: how often both are timed.
    """
    orders = [(0, 1) if k % 2 else (1, 0) for k in range(repeats)]
    times = np.array([[t for _, t in sorted((k, works[k]()) for k in order)] for order in orders])
    first, second = 1e6 * times.min(axis=0) / count
    low, middle, high = 100 * (np.quantile(times[:, 1] / times[:, 0], (0.25, 0.5, 0.75)) - 1)
    return [f"{first:.3f} us", f"{second:.3f} us", f"{middle:+.1f} % ({low:+.1f} to {high:+.1f})"]
