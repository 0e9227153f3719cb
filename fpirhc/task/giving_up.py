"""Calls of something that may never return, such as a device whose cable is out: who waits can give up.

All calls are made one after another by one thread, so that an object that belongs to a thread is safe, and none begins before the
last one has returned: nothing is interrupted. The thread does not keep the program from ending.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from typing import TypeVar

Result = TypeVar("Result")


class GaveUp(Exception):
    """The time is over; `begun` says whether the call itself was begun."""

    def __init__(self, *, begun: bool) -> None:
        super().__init__(begun)
        self.begun = begun


class Caller:
    """Calls functions in a thread of its own, which begins with the first call."""

    def __init__(self) -> None:
        self._calls: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._last = threading.Event()  # set when the last call has returned
        self._last.set()

    def call(self, function: Callable[[], Result], patience: float | None, *, free_within: float) -> Result:
        """Return what a function returns, or raise what it raises.

        Args:
            function: without arguments.
            patience: longest time that is waited for it, s; None: any.
            free_within: longest time in which an earlier call that was given up has to return, s.

        Raises:
            GaveUp: it has not returned by then.
        """
        end = None if patience is None else time.monotonic() + patience
        if not self._last.wait(free_within):
            raise GaveUp(begun=False)
        returned: list[Result] = []
        raised: list[BaseException] = []
        done = self._last = threading.Event()

        def run() -> None:
            try:
                returned.append(function())
            except BaseException as error:  # noqa: BLE001 -- it is raised where the result is waited for
                raised.append(error)
            finally:
                done.set()

        self._start()
        self._calls.put(run)
        if not done.wait(None if end is None else max(end - time.monotonic(), 0.0)):
            raise GaveUp(begun=True)
        if raised:
            raise raised[0]
        return returned[0]

    def _start(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=_work, args=(self._calls,), name="fpirhc body", daemon=True)
            self._thread.start()


def _work(calls: queue.SimpleQueue[Callable[[], None]]) -> None:
    while True:
        calls.get()()
