"""A solver in a process of its own, stopped where it does not return: fatrop has no limit of time and takes no signal."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from multiprocessing.connection import Connection

import numpy as np

Solve = Callable[..., tuple[np.ndarray, float, np.ndarray]]


class WithDeadline:
    """The same solver, warm-started in its own process; one that is stopped begins anew with nothing remembered.

    Args:
        solve: function (first state, data, cold) -> (inputs, seconds, diagnostics). The process is a copy of this one, so that
            what is built and compiled is there.
        inputs: shape of the inputs.
        seconds: after which a solve is stopped; it counts as one without a plan.
    """

    def __init__(self, solve: Solve, inputs: tuple[int, int], seconds: float) -> None:
        self._solve, self._seconds = solve, seconds
        self._no_plan = np.zeros(inputs), seconds, np.full(5, np.nan)
        self._start()

    def __call__(self, s0: np.ndarray, data: np.ndarray, *, cold: bool = False) -> tuple[np.ndarray, float, np.ndarray]:
        """Solve, or stop after the time given."""
        self._channel.send((s0, data, cold))
        if self._channel.poll(self._seconds):
            return self._channel.recv()
        self._process.kill()
        self._process.join()
        self._start()
        return self._no_plan

    def _start(self) -> None:
        self._channel, theirs = multiprocessing.Pipe()
        context = multiprocessing.get_context("fork")
        self._process = context.Process(target=_serve, args=(self._solve, theirs), daemon=True)
        self._process.start()


def _serve(solve: Solve, channel: Connection) -> None:
    """Answer until the other end is closed."""
    while True:
        s0, data, cold = channel.recv()
        channel.send(solve(s0, data, cold=cold))
