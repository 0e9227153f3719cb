"""Who answers the jobs of a study: worker processes of this machine, replaced when they die, or a cluster of Dask.

A worker is a command that reads one JSON value per line and answers each with one line, in order; its first line is a greeting.
It ends at the end of its input, so that no worker outlives its parent. With a cluster the client alone writes the ledger; a worker
builds the study from the file's content, and answers only where the facts on which its numbers depend are the client's.
"""

from __future__ import annotations

import atexit
import contextlib
import itertools
import json
import logging
import math
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

from fpirhc.errors import FpirhcError, InvalidValue, WorkerDied, package
from fpirhc.fields.user_code import users_level
from fpirhc.studies.scenarios.worker import Job, Study, answered, study

_NONE = object()  # no job is left
AHEAD = 2  # jobs that a worker has at once, so that it never waits for the next one
DEATHS = 5  # workers that die at one job before the study ends


class _Jobs:
    """Jobs that several threads take one after the other; the next one is known, so that it is seen when the last one is taken."""

    def __init__(self, jobs: Iterator[Any]) -> None:
        self._jobs, self._next, self._count, self._one_at_a_time = jobs, next(jobs, _NONE), 0, threading.Lock()

    def taken(self, most: int) -> list[Any]:
        """Take so many jobs, or those that are left."""
        some: list[Any] = []
        with self._one_at_a_time:
            while len(some) < most and self._next is not _NONE:
                some.append(self._next)
                self._next = next(self._jobs, _NONE)
            self._count += len(some)
        return some

    def are_done(self, answers: int) -> bool:
        """Whether so many answers are those of all jobs."""
        with self._one_at_a_time:
            return self._next is _NONE and answers == self._count


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

    def answers(self, jobs: Iterable[Any], own: Callable[[Any], Any] | None = None) -> Iterator[Any]:
        """Yield the answer of every job as it comes, in no particular order.

        Args:
            jobs: the jobs, each of which is asked for when somebody can begin it.
            own: function that answers a job. With it this process is one of the `count`, which saves the start of another.
        """
        others = iter(jobs)
        first = list(itertools.islice(others, self._count))
        waiting, answered = _Jobs(itertools.chain(first, others)), queue.SimpleQueue[Any]()
        for k in range(len(first) - (own is not None)):
            self._threads.append(threading.Thread(target=self._drive, args=(k, waiting, answered), daemon=True))
            self._threads[-1].start()
        for done in itertools.count():
            if waiting.are_done(done):
                return
            answer = self._next(waiting, answered, own)
            if isinstance(answer, Exception):
                raise answer
            yield answer

    def _next(self, waiting: _Jobs, answered: queue.SimpleQueue[Any], own: Callable[[Any], Any] | None) -> Any:
        """The answer of another process if there is one, else one of this process; with no job left, the next that comes."""
        if own is None or not answered.empty():
            return answered.get()
        mine = waiting.taken(1)
        return own(mine[0]) if mine else answered.get()

    def _drive(self, k: int, waiting: _Jobs, answered: queue.SimpleQueue[Any]) -> None:
        """Keep worker `k` busy until no job is left."""
        pending: deque[Any] = deque()
        process, deaths = None, 0
        try:
            while not self._stopping.is_set():
                new = waiting.taken(AHEAD - len(pending))
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


LOCAL = "local"  # in place of an address: a cluster of this machine's cores
_CHUNK = 0.2  # s of work in a task, beside which the milliseconds of its transport do not count
_LOSSES = 2  # times that a task is given again after Dask gave it up, because its workers died one after the other
_MOST = 200  # groups of jobs in a task
_WAIT = 10  # s for an answer of the scheduler
_LOCAL = {
    # Dask's own settings give every log back to the system and fetch it anew: half as much time again for a scenario.
    "distributed.nanny.pre-spawn-environ": {f"{name}_NUM_THREADS": 1 for name in ("OMP", "MKL", "OPENBLAS")},
    # What looks at workers and threads many times a second has the same cores as the runs.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.scheduler.work-stealing": False,
}
_ONE_AT_A_TIME = threading.Lock()  # a worker may have several threads, and a loop serves one


class Cluster:
    """Answers to jobs from a cluster.

    Args:
        address: of the scheduler, such as 'tcp://10.0.0.1:8786'; 'local': a cluster that lives as long as this value.
        opening: what a worker needs to build the study, as for processes.
        greeting: facts on which the numbers depend; a worker with others is refused.

    Raises:
        InvalidValue: nothing answers at the address.
        NotSupported: Dask is not installed.
    """

    def __init__(self, address: str, opening: Mapping[str, Any], greeting: Mapping[str, Any], count: int) -> None:
        self._opening = json.dumps(opening)
        self._content = Path(opening["path"]).read_bytes()
        self._greeting = greeting
        self._dask = package("distributed", "cluster", "--cluster")
        self._stack = contextlib.ExitStack()
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what is lost is said by errors here
        self._client = self._connected(address, count)

    def _connected(self, address: str, count: int) -> Any:
        where: Any = address
        if address == LOCAL:
            with package("dask.config", "cluster", "--cluster").set(_LOCAL):
                facts = {"dashboard_address": "127.0.0.1:0", "silence_logs": logging.CRITICAL, "memory_limit": None}
                local = self._dask.LocalCluster(n_workers=count, threads_per_worker=1, **facts)
            where = self._stack.enter_context(local)
        try:
            if where is address:  # a client of what is no address hangs when it is closed
                self._dask.comm.get_address_host_port(address)
            return self._stack.enter_context(self._dask.Client(where, timeout=_WAIT, set_as_default=False))
        except (OSError, ValueError, TypeError) as error:
            self._stack.close()
            raise InvalidValue(
                f"--cluster {address}: no scheduler answers there ({' '.join(str(error).split())[:120]}); start one with 'dask "
                f"scheduler' and give its address, or --cluster {LOCAL}"
            ) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(Exception):  # a scheduler that is gone cannot be left in good order
            self._stack.close()

    def answers(
        self, jobs: Iterable[Sequence[Job]], own: Callable[[Sequence[Job]], Any] | None = None
    ) -> Iterator[Any]:
        """Yield the answer of every group of jobs as it comes, in no particular order."""
        del own  # this process has the ledger to write
        try:
            for answers in self._chunks(iter(jobs)):
                yield from answers
        except (OSError, TimeoutError, CancelledError) as error:
            raise _lost("the cluster does not answer any more", error) from None

    def _chunks(self, jobs: Iterator[Sequence[Job]]) -> Iterator[list[Any]]:
        """Answers of one task after the other; tasks get longer until their transport does not count."""
        size = 1
        running: dict[str, tuple[list[Sequence[Job]], int]] = {}  # jobs of a task, and how often it was lost, by key
        pool = self._dask.as_completed(loop=self._client.loop, with_results=True, raise_errors=False)
        while True:
            threads = sum(self._client.nthreads().values())  # asked once for every answer: workers may come and go
            while len(running) < 2 * max(1, threads) and (chunk := list(itertools.islice(jobs, size))):
                future = self._submitted(chunk)
                pool.add(future)
                running[future.key] = chunk, 0
            if not running:
                return
            if not threads:
                self._wait_for_workers()
            future, result = next(pool)
            chunk, losses = running.pop(future.key)
            if future.status != "finished":
                if losses == _LOSSES or not isinstance(_error_in(result), self._dask.KilledWorker):
                    raise _lost("the cluster lost a task", result)
                again = self._submitted(chunk)
                pool.add(again)
                running[again.key] = chunk, losses + 1
                continue
            answers, seconds = result
            future.release()  # a worker that is killed would compute every result that it holds anew
            size = min(max(size, math.ceil(_CHUNK * len(answers) / max(seconds, 1e-6))), 2 * size, _MOST)
            yield answers

    def _submitted(self, chunk: list[Sequence[Job]]) -> Any:
        return self._client.submit(run_jobs, self._opening, self._content, self._greeting, chunk, pure=False)

    def _wait_for_workers(self) -> None:
        """Warn where nobody takes the tasks; a cluster may begin workers when it has tasks, or bring back those it lost."""
        try:
            self._client.wait_for_workers(1, timeout=_WAIT)
        except TimeoutError:
            address = self._client.scheduler.address
            text = f"the cluster at {address} has no workers; the study waits for them: dask worker {address}"
            warnings.warn(text, RuntimeWarning, stacklevel=users_level())


def _error_in(result: Any) -> Any:
    """The error of a task that failed, of which Dask has class, error and traceback."""
    return result[1] if isinstance(result, tuple) and len(result) > 1 else result


def _lost(what: str, why: Any) -> WorkerDied:
    error = _error_in(why)
    text = " ".join(str(error).split())[:160]
    return WorkerDied(
        f"{what} ({type(error).__name__}: {text}); finished results are kept, and the same command continues from them"
    )


def run_jobs(
    opening: str, content: bytes, greeting: Mapping[str, Any], groups: Sequence[Sequence[Job]]
) -> tuple[list[list[dict[str, Any]]], float]:
    """Answer groups of jobs on a worker; return the records of each and the seconds that they took.

    `greeting`: facts on which the client's numbers depend.
    """
    with _ONE_AT_A_TIME:
        try:
            ready = _study(opening, content)
        except FpirhcError as error:
            return [[{"error": f"a worker cannot load the problem: {error}"}]], 0.0
        other = _differences(greeting, ready.greeting)
        if other:
            return [[{"error": f"a worker would compute other numbers: {other}"}]], 0.0
        begin = time.perf_counter()
        return [answered(ready.bench, jobs) for jobs in groups], time.perf_counter() - begin


def _differences(wanted: Mapping[str, Any], there: Mapping[str, Any]) -> str:
    names = [n for n in dict.fromkeys([*wanted, *there]) if wanted.get(n) != there.get(n)]
    return "; ".join(f"{n} is {there.get(n)!r} there and {wanted.get(n)!r} here" for n in names)


@lru_cache(maxsize=2)  # of this study, and of the one before
def _study(opening: str, content: bytes) -> Study:
    """The study of a worker: from the file where it is the same one here, else from a copy of its content."""
    values = json.loads(opening)
    path = Path(values["path"])
    if not path.is_file() or path.read_bytes() != content:
        folder = tempfile.mkdtemp(prefix="fpirhc-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        path = Path(folder, path.name)
        path.write_bytes(content)
    return study({**values, "path": str(path)})
