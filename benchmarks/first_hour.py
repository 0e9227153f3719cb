"""Processor time of what a newcomer does first: imports, lists, messages, reviews and reports, with a warm and an empty cache.

    python benchmarks/first_hour.py [--write] [--parts] [--of FOLDER]     --write puts the tables into docs/performance.md
                                                                      --of measures another checkout of the repository

Every command runs in a process of its own. Its time is that of the process and of the compilers that it starts, user and system,
the smallest of several runs: other work on the machine lengthens a time and never shortens it. With an empty cache of compiled
libraries (cold) each run begins with an empty folder; warm is the run after it. Python's own cache of bytecode is warm.

A second table is the profile of one comparison: every second of its process belongs to the innermost part that is at work, those of
compilers, which are at work beside it, to compiling. Its last row is the wall clock.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
from table import write_table

ROOT = Path(__file__).resolve().parents[1]
COLD, WARM = 2, 3  # runs
CHAIN = """
import runpy
import fpirhc as fp
from fpirhc.simulation.loop import close_loop
from fpirhc.symbolic.native import native
task = fp.load_problem("chain_of_masses")
loop = close_loop(runpy.run_path(str(task.path))["chain"](5), task.controllers["RHC+FPI"])
assert native(loop.function, calls=500).compiled
"""
COMPARE = "compare", "two_mass", "--out", "two"
PROFILE = """
import json, resource, sys, time

PARTS = {
    "parsing": ["problem_files.problem_file.load_problem"],
    "composing loops": ["simulation.loop.close_loop"],
    "compiling": ["symbolic.native.native"],
    "running": ["simulation.simulate.run_cycles"],
    "timing cycles": ["studies.comparison.timing.measure_cycles"],
    "causes and null tests": [
        "studies.comparison.pairwise.with_reviewed_causes",
        "studies.comparison.pairwise.null_tests",
        "studies.comparison.pairwise.partners",
    ],
    "pictures and page": ["report.html.render"],
}
parts, stack = {}, ["the rest"]

def spent(who=resource.RUSAGE_SELF):
    return sum(resource.getrusage(who)[:2])

def switch(to=None):
    global last
    now = spent()
    parts[stack[-1]] = parts.get(stack[-1], 0.0) + now - last
    last = now
    stack.append(to) if to else stack.pop()

def timed(part, function):
    def call(*given, **named):
        switch(part)
        try:
            return function(*given, **named)
        finally:
            switch()
    return call

last, begin = 0.0, time.perf_counter()
stack.append("imports")
from fpirhc.cli.main import main
for part, places in PARTS.items():
    for place in places:
        home, _, name = ("fpirhc." + place).rpartition(".")
        function = getattr(__import__(home, fromlist=[name]), name)
        wrapped = timed(part, function)
        for module in list(sys.modules.values()):
            if vars(module).get(name) is function:
                setattr(module, name, wrapped)
switch()
main(sys.argv[1:])
switch()
parts["compiling"] = parts.get("compiling", 0.0) + spent(resource.RUSAGE_CHILDREN)
parts["on the wall clock"] = time.perf_counter() - begin
open("parts.json", "w").write(json.dumps(parts))
"""
ROWS: dict[str, Sequence[str]] = {
    "`import fpirhc`, then `fp.Problem`": ("-c", "import fpirhc as fp; fp.Problem"),
    "`fpirhc list`": ("-m", "fpirhc", "list"),
    "the message of a wrong problem file": ("-m", "fpirhc", "compare", "wrong.py"),
    "`fpirhc review two_mass`": ("-m", "fpirhc", "review", "two_mass"),
    "`fpirhc compare two_mass` (eleven controllers)": ("-m", "fpirhc", *COMPARE),
    "`fpirhc compare pendulum.py`, the problem of the README": (
        "-m",
        "fpirhc",
        "compare",
        "pendulum.py",
        "--out",
        "one",
    ),
    "the loop of a receding horizon for the chain of five masses": ("-c", CHAIN),
}


def main() -> None:
    """Measure every row and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="put the table into docs/performance.md")
    parser.add_argument("--of", type=Path, default=ROOT, metavar="FOLDER", help="checkout that is measured")
    parser.add_argument("--parts", action="store_true", help="the profile of a comparison alone")
    options = parser.parse_args()
    code = options.of.resolve()
    [pendulum] = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "pendulum.py").write_text(pendulum, encoding="utf-8")
        (folder / "wrong.py").write_text("plant = 3\n", encoding="utf-8")
        taken("-c", "import fpirhc as fp; dir(fp)", code=code, folder=folder, cache=folder / "any")
        cold, warm = profiles(code, folder)
        parts = [(part, f"{seconds:.2f}", f"{warm.get(part, 0.0):.2f}") for part, seconds in cold.items()]
        write_table("first hour in parts", ["`fpirhc compare two_mass`, processor time, s", "cold", "warm"], parts)
        if options.parts:
            return
        rows = [(what, *(f"{seconds:.2f}" for seconds in both(words, code, folder))) for what, words in ROWS.items()]
    write_table("first hour", ["processor time, s", "cold", "warm"], rows)


def profiles(code: Path, folder: Path) -> list[dict[str, float]]:
    """Seconds of the parts of a comparison, with an empty cache of libraries and with the full one behind it."""
    found, cache = [], Path(tempfile.mkdtemp(dir=folder))
    for _ in range(2):
        taken("-c", PROFILE, *COMPARE, code=code, folder=folder, cache=cache)
        found.append(json.loads((folder / "parts.json").read_text(encoding="utf-8")))
    return found


def both(words: Sequence[str], code: Path, folder: Path) -> tuple[float, float]:
    """Smallest times with an empty cache of libraries, and with a full one."""
    cold = []
    for _ in range(COLD):
        cache = Path(tempfile.mkdtemp(dir=folder))
        cold.append(taken(*words, code=code, folder=folder, cache=cache))
    warm = (taken(*words, code=code, folder=folder, cache=cache) for _ in range(WARM))
    return min(cold), min(warm)


def taken(*words: str, code: Path, folder: Path, cache: Path) -> float:
    """Processor time of a process of Python and of all that it starts."""
    environment = {**os.environ, "PYTHONPATH": str(code), "FPIRHC_CACHE": str(cache)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # with it every run would translate every module anew
    silent = subprocess.DEVNULL
    process = subprocess.Popen([sys.executable, *words], cwd=folder, env=environment, stdout=silent, stderr=silent)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    # 1: a review that answers no; 2: the wrong file
    if process.returncode not in (0, 1, 2):
        sys.exit(f"'{' '.join(words)}' ended with {process.returncode}")
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
