"""Whether stage functions run as fast after a Riccati sweep as before it.

    python benchmarks/transition.py [PROBLEM ...]

The loops of the fixed-point iteration use wide registers, the stage functions narrow ones. Where the upper halves of the wide
registers are not cleared in between, processors slow every narrow instruction down. The first rollout of a call comes before any
sweep, the second one after it: both do the same work and must take the same time. Counted in cycles inside the compiled loop,
medians of 2000 calls, once as shipped and once with registers allocated across calls.
"""

from __future__ import annotations

import ctypes
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import optimisers

import fpirhc as fp
from fpirhc.horizon.hessian_models import GaussNewton
from fpirhc.optimisers.plain import PlainSettings, plain_driver
from fpirhc.symbolic.native import find_compiler

CALLS = 2000
_TIMED = """#include <x86intrin.h>
static unsigned long long spent[2];
#define TIMED(k, call) ({ unsigned long long t = __rdtsc(); int r = (call); if ((k) < 2) spent[k] = __rdtsc() - t; r; })
"""
_READ = "\nvoid cycles(double* first, double* second) { *first = spent[0], *second = spent[1]; }\n"
_CALL = "try_next(&s, best, plan, s0, data, lower, upper)"


def cycles(name: str, across: bool) -> tuple[float, float]:
    """Median cycles of the first and the second rollout of a call."""
    p = optimisers.problem_of(name)
    recorded = optimisers.recorded(p)
    optimiser = fp.FixedPoint(iterations=1, tolerance=recorded.tolerance)
    settings = PlainSettings(optimiser.tolerance, optimiser.map, GaussNewton(), optimiser.damping, 1, converging=False)
    source = plain_driver(recorded.ocp, settings, settings.stops).source()
    assert source.count(_CALL) == 1
    source = source.replace(_CALL, f"TIMED(count, {_CALL})")
    source = source.replace(', "no-ipa-ra"', "") if across else source
    with tempfile.TemporaryDirectory() as folder:
        text, library = Path(folder) / "driver.c", Path(folder) / "driver.so"
        text.write_text(f"#define ENTRY entry\n{_TIMED}{source}{_READ}")
        flags = ["-O3", "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared"]
        subprocess.run([str(find_compiler()), *flags, "-o", str(library), str(text), "-lm"], check=True)
        return _measured(ctypes.CDLL(str(library)), optimiser, recorded)


def _measured(library: ctypes.CDLL, optimiser: fp.FixedPoint, recorded: optimisers.Horizons) -> tuple[float, float]:
    ocp, size = recorded.ocp, optimiser.memory(recorded.ocp).size
    values = (recorded.first[0], recorded.data[0].T.copy(), ocp.input_lower, ocp.input_upper, np.zeros(size))
    results = (np.zeros(ocp.input.size * ocp.stages), np.zeros(5), np.zeros(size))
    pointer = ctypes.POINTER(ctypes.c_double)
    arguments, places = (
        (pointer * len(arrays))(*(np.ascontiguousarray(a, dtype=float).ctypes.data_as(pointer) for a in arrays))
        for arrays in (values, results)
    )
    pair, times = (ctypes.c_double(), ctypes.c_double()), []
    for _ in range(CALLS):
        library.entry(arguments, places, None, None, 0)
        library.cycles(*(ctypes.byref(v) for v in pair))
        times.append([v.value for v in pair])
    first, second = np.median(times, axis=0)
    return float(first), float(second)


def main() -> None:
    """Print both ways for the problems named on the command line."""
    for name in sys.argv[1:] or ["cart_pole", "chain_of_masses:3"]:
        for across in (False, True):
            first, second = cycles(name, across)
            way = "registers across calls" if across else "as shipped"
            print(f"{name}, {way}: first {first:.0f}, second {second:.0f} cycles, ratio {second / first:.2f}")


if __name__ == "__main__":
    main()
