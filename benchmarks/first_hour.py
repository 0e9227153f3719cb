"""Processor time of what a newcomer does first: imports, lists, messages, reviews and reports, with a warm and an empty cache.

    python benchmarks/first_hour.py [--write] [--of FOLDER]      --write puts the table into docs/performance.md
                                                                 --of measures another checkout of the repository

Every command runs in a process of its own. Its time is that of the process and of the compilers that it starts, user and system,
the smallest of several runs: other work on the machine lengthens a time and never shortens it. With an empty cache of compiled
libraries (cold) each run begins with an empty folder; warm is the run after it. Python's own cache of bytecode is warm.
"""

from __future__ import annotations

import argparse
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
ROWS: dict[str, Sequence[str]] = {
    "`import fpirhc`, then `fp.Problem`": ("-c", "import fpirhc as fp; fp.Problem"),
    "`fpirhc list`": ("-m", "fpirhc", "list"),
    "the message of a wrong problem file": ("-m", "fpirhc", "compare", "wrong.py"),
    "`fpirhc review two_mass`": ("-m", "fpirhc", "review", "two_mass"),
    "`fpirhc compare two_mass` (eleven controllers)": ("-m", "fpirhc", "compare", "two_mass", "--out", "two"),
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
    code = parser.parse_args().of.resolve()
    [pendulum] = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "pendulum.py").write_text(pendulum, encoding="utf-8")
        (folder / "wrong.py").write_text("plant = 3\n", encoding="utf-8")
        taken("-c", "import fpirhc as fp; dir(fp)", code=code, folder=folder, cache=folder / "any")
        rows = [(what, *(f"{seconds:.2f}" for seconds in both(words, code, folder))) for what, words in ROWS.items()]
    write_table("first hour", ["processor time, s", "cold", "warm"], rows)


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
