"""Worker processes that answer jobs and are replaced when they die.

A worker is a command that reads one JSON value per line and answers each with one line, in order; its first line is a greeting.
It ends at the end of its input, so that no worker outlives its parent, however the parent ends. A worker that is killed is
replaced by another one, which receives the jobs without an answer.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Self

from fpirhc.errors import FpirhcError, WorkerDied

AHEAD = 2  # jobs that a worker has at once, so that it never waits for the next one
DEATHS = 5  # workers that die at one job before the study ends


class Workers:
    """Answers to jobs from `count` processes.

    Args:
        module: module that each process runs.
        opening: first line of input of each process.
        greeting: answer that each process must give to the opening.
        count: number of processes.

    Raises:
        WorkerDied: workers die again and again at one job; raised by `answers`.
        FpirhcError: a worker's greeting is another one; raised by `answers`.
    """

    def __init__(self, module: str, opening: Any, greeting: Any, count: int) -> None:
        self._module, self._opening, self._greeting = module, opening, greeting
        self._count = count
        self._running: dict[int, subprocess.Popen[str]] = {}
        self._stopping = threading.Event()
        self._starting = threading.Lock()
        self._threads: list[threading.Thread] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        with self._starting:
            for process in self._running.values():
                process.kill()
        for thread in self._threads:
            thread.join()

    def answers(self, jobs: Sequence[Any], own: Callable[[Any], Any] | None = None) -> Iterator[Any]:
        """Yield the answer of every job as it comes, in no particular order.

        Args:
            jobs: the jobs.
            own: function that answers a job. With it this process is one of the `count`, which saves the start of another.
        """
        waiting: queue.SimpleQueue[Any] = queue.SimpleQueue()
        answered: queue.SimpleQueue[Any] = queue.SimpleQueue()
        for job in jobs:
            waiting.put(job)
        for k in range(min(self._count, len(jobs)) - (own is not None)):
            self._threads.append(threading.Thread(target=self._drive, args=(k, waiting, answered), daemon=True))
            self._threads[-1].start()
        for _ in jobs:
            answer = self._next(waiting, answered, own)
            if isinstance(answer, Exception):
                raise answer
            yield answer

    def _next(
        self, waiting: queue.SimpleQueue[Any], answered: queue.SimpleQueue[Any], own: Callable[[Any], Any] | None
    ) -> Any:
        """The answer of another process if there is one, else one of this process; with no job left, the next that comes."""
        if own is None or not answered.empty():
            return answered.get()
        mine = _taken(waiting, 1)
        return own(mine[0]) if mine else answered.get()

    def _drive(self, k: int, waiting: queue.SimpleQueue[Any], answered: queue.SimpleQueue[Any]) -> None:
        """Keep worker `k` busy until no job is left."""
        pending: deque[Any] = deque()
        process, deaths = None, 0
        try:
            while not self._stopping.is_set():
                new = _taken(waiting, AHEAD - len(pending))
                pending += new
                if not pending:
                    break
                if process is None:
                    process, new = self._start(k), list(pending)
                if process is None:
                    break
                _send(process, new)
                line = _line(process)
                if line is None:
                    _end(process)
                    process, deaths = None, deaths + 1
                    if deaths == DEATHS:
                        raise WorkerDied(
                            f"{DEATHS} processes died one after the other at the job {pending[0]} (killed, out of memory, or "
                            "crashed); finished results are kept, and the same command continues from them"
                        )
                    continue
                deaths = 0
                pending.popleft()
                answered.put(json.loads(line))
        except Exception as error:  # noqa: BLE001 -- every error must reach the thread that waits for an answer
            answered.put(error)
        finally:
            with self._starting:
                last = self._running.pop(k, None)
            if last is not None:
                _end(last)

    def _start(self, k: int) -> subprocess.Popen[str] | None:
        """Start worker `k` and check its greeting; None when all are to stop. One that dies before its greeting is replaced."""
        for _ in range(DEATHS):
            with self._starting:
                if self._stopping.is_set():
                    return None
                process = _popen(self._module)
                self._running[k] = process
            _send(process, [self._opening])
            line = _line(process)
            if line is not None:
                self._check(json.loads(line))
                return process
            _end(process)
        raise WorkerDied(f"{DEATHS} processes died one after the other before they could begin; use --processes 1")

    def _check(self, greeting: Any) -> None:
        if isinstance(greeting, dict) and "error" in greeting:
            raise FpirhcError(greeting["error"])
        if greeting != self._greeting:
            raise FpirhcError(
                "a process loaded another problem than this one: the file was changed during the run, or the task is not "
                "the file's; use one process for a task that is not in a file"
            )


def _popen(module: str) -> subprocess.Popen[str]:
    # The same import path as here, and no folder that happens to be the current one.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "PYTHONSAFEPATH": "1"}
    command = [sys.executable, "-m", module]
    return subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, text=True, encoding="utf-8"
    )


def _taken(waiting: queue.SimpleQueue[Any], most: int) -> list[Any]:
    taken: list[Any] = []
    while len(taken) < most:
        try:
            taken.append(waiting.get_nowait())
        except queue.Empty:
            break
    return taken


def _send(process: subprocess.Popen[str], values: Sequence[Any]) -> None:
    """Write these lines to the worker; a dead worker is noticed when its answer is read."""
    assert process.stdin is not None
    try:
        process.stdin.write("".join(json.dumps(value) + "\n" for value in values))
        process.stdin.flush()
    except OSError:
        return


def _line(process: subprocess.Popen[str]) -> str | None:
    """The next whole line; None when the worker is dead."""
    assert process.stdout is not None
    line = process.stdout.readline()
    return line if line.endswith("\n") else None


def _end(process: subprocess.Popen[str]) -> None:
    process.kill()
    assert process.stdin is not None
    assert process.stdout is not None
    with contextlib.suppress(OSError):
        process.stdin.close()
    process.stdout.close()
    process.wait()
