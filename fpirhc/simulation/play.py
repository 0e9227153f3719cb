"""A plant with somebody else at its inputs: the closed loop of a problem, cycle by cycle, around a command that is given."""

from __future__ import annotations

import numpy as np

from fpirhc.simulation.loop import HELD_INPUT, HeldInput, close_loop, start_memory
from fpirhc.simulation.ranges import ranges_of
from fpirhc.simulation.step_arguments import Setpoints
from fpirhc.simulation.tables import run_tables
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.task.problem import Problem


class Play:
    """One run of the loop. A step evaluates it twice: to move with the command, and for what is measured before the next one.

    Args:
        problem: the task.
        setpoints: by coordinate, in place of those of the reference.

    `cycle` counts from 0; `signals` has every signal of the cycle by name, and `gone` says whether the plant has left its range.
    """

    def __init__(self, problem: Problem, setpoints: Setpoints | None) -> None:
        self._problem, self._setpoints = problem, setpoints
        self._loop = close_loop(problem, HeldInput())
        self._step, self._ranges = Evaluator(self._loop.function), ranges_of(problem, self._loop.trace)
        self._place = self._loop.memory.slice(HELD_INPUT)
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Go to the start."""
        self.cycle, self.gone = 0, False
        self._tables = run_tables(self._problem, seed, self._problem.cycles + 1, setpoints=self._setpoints)
        self._memory = start_memory(self._loop, self._problem, HeldInput())
        self._measure()

    def step(self, command: np.ndarray) -> None:
        """Hold a command for a cycle."""
        self._memory[self._place] = command
        self._memory, sent = self._step(self._memory, *(table[self.cycle] for table in self._tables))
        self.cycle += 1
        row = self._measure()
        finite = np.isfinite(self._memory).all() and np.isfinite(sent).all()
        self.gone = not finite or self._ranges.first_outside(row[np.newaxis]) is not None

    def _measure(self) -> np.ndarray:
        """Sense at the beginning of the cycle that comes; sensors do not depend on its command."""
        _, row = self._step(self._memory, *(table[self.cycle] for table in self._tables))
        self.signals = self._loop.trace.unpack(row.ravel())
        return row.ravel()
