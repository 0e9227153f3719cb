"""The log of cycles whose step was not finite: such a step was dropped, and what it logged shows its last finite values.

A run ends where a signal is not finite. What a controller computes in a cycle of status NON_FINITE reaches neither the plant nor
its memory, so it does not end the run. What else is not finite in that cycle does, and so do numbers beyond all sense: a loop that
diverges is a result, and must not end in a held command.
"""

from __future__ import annotations

import numpy as np

from fpirhc.controllers.on_failure import STOPPED
from fpirhc.status import Status
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.layout import Layout

_DIVERGED = 1e100  # size of numbers that no loop but a diverging one has


class Dropped:
    """The rows of a log, and what ends a run in them.

    Args:
        loop: whose log it is.
    """

    def __init__(self, loop: Composite) -> None:
        """Find the columns that the step behind the gate writes."""
        traces: list[Layout] = [block.inside.trace for block in loop.blocks if block.inside is not None]
        names = {name for trace in traces for name in trace.names} & set(loop.trace.names)
        self._own = np.zeros(loop.trace.size, dtype=bool)
        for name in names - {STOPPED}:
            self._own[loop.trace.slice(name)] = True
        self._status = loop.trace.slice("status").start if "status" in names else None

    def first_bad(self, rows: np.ndarray, before: np.ndarray | None) -> tuple[int, int] | None:
        """Return row and column of the first value that ends a run; None where there is none.

        What is not finite in dropped steps gets the value of the row before, in place.

        Args:
            rows: of the log, shape (cycles, columns).
            before: the row before the first; None: there is none, and zeros are shown.
        """
        # A sum is finite only if every summand is, and it is fast; where it is not, the entries are checked one by one.
        with np.errstate(all="ignore"):
            if abs(np.sum(rows)) < _DIVERGED:
                return None
        for k, row in enumerate(rows):
            bad = ~np.isfinite(row)
            dropped = self._status is not None and row[self._status] == int(Status.NON_FINITE)
            if dropped and not (np.abs(row[~bad]) > _DIVERGED).any() and not (bad & ~self._own).any():
                last = rows[k - 1] if k else before
                row[bad] = 0.0 if last is None else last[bad]
            elif dropped or bad.any():
                return k, int(np.argmax(bad) if bad.any() else np.argmax(np.abs(row)))
        return None
