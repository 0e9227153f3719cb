"""Attacks on the cache of compiled libraries: processes that are killed while they compile."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

_COMPILE = """
import casadi as ca
import numpy as np
from fpirhc.symbolic.native import native
x = ca.SX.sym("x", 3)
function = ca.Function("fpirhc_attacked", [x], [ca.sin(x) * 1.25 + x**2])
ready = native(function)
assert ready.compiled, ready.reason
value = np.array([0.5, 1.0, 2.0])
assert np.array_equal(ready.function(value).full(), function(value).full())
"""


def killed_compilations(folder: Path, count: int, *, seed: int) -> int:
    """Kill processes while they compile; return after how many kills the next process fails."""
    _compiled(folder)  # how long one takes
    begin = time.perf_counter()
    _compiled(folder / "timed")
    longest = time.perf_counter() - begin
    generator, failed = np.random.default_rng(seed), 0
    for k in range(count):
        place = folder / str(k)
        process = subprocess.Popen([sys.executable, "-c", _COMPILE], env=_environment(place), stderr=subprocess.DEVNULL)
        try:
            process.wait(timeout=longest * generator.uniform(0.3, 1.0))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        try:
            _compiled(place)
        except subprocess.SubprocessError:
            failed += 1
    return failed


def _compiled(folder: Path) -> None:
    command = [sys.executable, "-c", _COMPILE]
    subprocess.run(command, env=_environment(folder), check=True, capture_output=True, timeout=120)


def _environment(folder: Path) -> dict[str, str]:
    return {**os.environ, "FPIRHC_CACHE": str(folder)}
