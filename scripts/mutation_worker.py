"""Runs tests again and again without importing the libraries again: one fork for every run.

Standard input has one JSON object per line, {"arguments": of pytest, "limit": in s}; standard output answers each with
{"passed": ..., "seconds": ..., "output": ...}. The package itself is imported in the fork, so it is read from its files every time.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import pytest

LIBRARIES = (
    "casadi",
    "numpy",
    "scipy.signal",
    "scipy.linalg",
    "scipy.optimize",
    "scipy.stats",
    "osqp",
    "control",
    "pandas",
    "rich",
)


def main() -> None:
    """Answer until the input ends."""
    for library in LIBRARIES:
        with suppress(ImportError):
            importlib.import_module(library)
    for line in sys.stdin:
        order = json.loads(line)
        print(json.dumps(run(order["arguments"], order["limit"])), flush=True)


def run(arguments: list[str], limit: float) -> dict[str, object]:
    """Run pytest in a fork; one that takes longer than the limit has not passed."""
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder, "output.txt")
        child = os.fork()
        if not child:
            _be_the_child(arguments, output)
        code = _wait(child, begin + limit)
        text = output.read_text(encoding="utf-8", errors="replace") if output.exists() else ""
    return {"passed": code == 0, "seconds": time.monotonic() - begin, "output": text[-4000:]}


def _be_the_child(arguments: list[str], output: Path) -> None:
    os.setsid()  # so that whatever the tests start ends with them
    file = os.open(output, os.O_WRONLY | os.O_CREAT)
    os.dup2(file, 1)
    os.dup2(file, 2)
    code: int = 3
    try:
        code = int(pytest.main(arguments))
    finally:
        sys.stdout.flush()
        os._exit(code)


def _wait(child: int, until: float) -> int | None:
    """Exit code of the child; None where its time was over."""
    while time.monotonic() < until:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.05)
    with suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


if __name__ == "__main__":
    main()
