"""Mutation testing: how many small faults in a module the tests notice. Called by scripts/mutate, in the tool's environment.

The faults are made in a copy of the checkout, in Python by Cosmic Ray and in C by `mutation_c`. A sample of them is tried: the
seed shuffles the places of a module, and one fault of every place is taken in turn until there are enough, so that a line with many
operators does not fill the sample.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from difflib import unified_diff
from itertools import chain, zip_longest
from pathlib import Path
from subprocess import PIPE
from typing import Any, Protocol

import mutation_c
import mutation_python

ROOT = Path(__file__).resolve().parents[1]
PAGE, SURVIVORS = ROOT / "docs/mutation.md", ROOT / "results/mutation"
SPARE, FACTOR = 20.0, 4.0  # s, and times the time without a fault: from which the tests are taken to hang
NOT_COMPILED = "CompileError"  # in the output of tests whose C was refused by the compiler: the fault was never run
# Numbers are the same without optimising, and a library is there in a quarter of the time. The pragma would ask for it again.
COMPILER = """#!/bin/sh
for file in "$@"; do case $file in *.c) sed -i '/pragma GCC optimize/d' "$file" ;; esac; done
exec cc "$@" -O0
"""
BEGIN, END = "<!-- table: written by scripts/mutate -->", "<!-- end of the table -->"
HEAD = "| module | faults there | tried | killed | survived | score | seed | tests |\n|---|--:|--:|--:|--:|--:|--:|---|"


class Fault(Protocol):
    """A small change of a file."""

    @property
    def place(self) -> Any:
        """Where it is; faults of one place are alternatives."""

    def made(self) -> AbstractContextManager[tuple[str, str]]:
        """The file with the fault, while the context lasts: its text before and after."""


@dataclass(frozen=True)
class Row:
    """A line of the table."""

    module: str
    faults: int
    tried: int
    killed: int
    seed: int
    tests: str

    def __str__(self) -> str:
        score = f"{100 * self.killed / self.tried:.0f} %" if self.tried else "-"
        numbers = f"{self.faults} | {self.tried} | {self.killed} | {self.tried - self.killed} | {score} | {self.seed}"
        return f"| `{self.module}` | {numbers} | `{self.tests}` |"


def main() -> int:
    """Try the faults of the wanted modules and write the table after each module."""
    options = _options()
    targets = [t for t in _targets() if not options.words or any(word in t[0] for word in options.words)]
    if not targets:
        raise SystemExit(
            f"no module of scripts/mutation.toml has one of these words in its path: {', '.join(options.words)}"
        )
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the copy is removed
    SURVIVORS.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        _copy_checkout(Path(folder))
        os.chdir(folder)
        os.environ |= {"PYTHONPATH": folder, "PYTHONDONTWRITEBYTECODE": "1", **_compiling(Path(folder))}
        # A changed file has a new time, so that its compiled form is not used.
        subprocess.run([options.python, "-m", "compileall", "-q", "fpirhc"], check=True)
        worker = Worker(options.python)
        print(HEAD)
        for module, tests in targets:
            row = _try_module(module, tests, options, worker)
            print(row, flush=True)
            _write(row)
    return 0


def _compiling(folder: Path) -> dict[str, str]:
    """Settings with which libraries are compiled quickly, in a cache of their own."""
    if shutil.which("cc") is None:
        return {}
    compiler, cache = folder / "quick_cc", folder / ".libraries"
    compiler.write_text(COMPILER, encoding="utf-8")
    compiler.chmod(0o700)
    cache.mkdir(mode=0o700)
    return {"FPIRHC_CC": str(compiler), "FPIRHC_CACHE": str(cache)}


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="scripts/mutate", description="Count the small faults that the tests notice.")
    parser.add_argument("words", nargs="*", metavar="WORD", help="try the modules whose path has one of these words")
    parser.add_argument("--sample", type=int, default=15, metavar="N", help="most faults of a module (15)")
    parser.add_argument("--show", action="store_true", help="print every fault that survives")
    parser.add_argument("--seed", type=int, default=0, help="of the sample (0)")
    parser.add_argument("--python", default=str(ROOT / ".venv/bin/python"), help="interpreter that runs the tests")
    return parser.parse_args()


def _targets() -> Iterator[tuple[str, str]]:
    """Every module with its tests; files that hold a docstring only are left out."""
    for target in tomllib.loads((ROOT / "scripts/mutation.toml").read_text(encoding="utf-8"))["target"]:
        paths = sorted(path for pattern in target["modules"] for path in ROOT.glob(pattern))
        for path in paths:
            if path.suffix == ".c" or len(ast.parse(path.read_text(encoding="utf-8")).body) > 1:
                yield path.relative_to(ROOT).as_posix(), " ".join([*_lane(target), *target["tests"]])


def _lane(target: dict[str, Any]) -> list[str]:
    """Arguments that choose the lane of a target: the quick one unless it says 'all'."""
    return [] if target.get("lane") == "all" else ["--lane", "quick"]


def _copy_checkout(folder: Path) -> None:
    """Copy what git knows, and new files that it does not ignore."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)


def _try_module(module: str, tests: str, options: argparse.Namespace, worker: Worker) -> Row:
    arguments = ["-x", "-q", "-p", "no:xdist", "-p", "no:cacheprovider", *shlex.split(tests)]
    sound = worker.run(arguments, 600.0)
    if not sound["passed"]:  # else every fault would count as noticed
        raise SystemExit(f"the tests fail without a fault: pytest {shlex.join(arguments)}\n{sound['output']}")
    faults, limit, tried, survivors = _faults(module), SPARE + FACTOR * sound["seconds"], 0, []
    for fault in _sample(faults, random.Random(f"{options.seed} {module}")):
        if tried == options.sample:
            break
        with fault.made() as (before, after):
            answer = worker.run(arguments, limit)
        if NOT_COMPILED in answer["output"]:
            continue  # it was never run
        tried += 1
        if answer["passed"]:
            survivors.append(_difference(module, before, after))
            if options.show:
                print(survivors[-1], flush=True)
    report = SURVIVORS / (module.removesuffix(".py").replace("/", ".") + ".diff")
    report.write_text("\n".join(survivors), encoding="utf-8")
    return Row(module, len(faults), tried, tried - len(survivors), options.seed, tests)


def _difference(path: str, before: str, after: str) -> str:
    return "\n".join(unified_diff(before.splitlines(), after.splitlines(), path, path, n=0, lineterm=""))


class Worker:
    """The process that runs the tests, see `mutation_worker`; it is started again where it was ended from outside."""

    def __init__(self, python: str) -> None:
        self._command = [python, str(ROOT / "scripts/mutation_worker.py")]
        self._start()

    def run(self, arguments: Sequence[str], limit: float) -> dict[str, Any]:
        """Whether the tests pass within the limit (s), how long they took, and what they printed last."""
        order = json.dumps({"arguments": arguments, "limit": limit})
        for _ in range(3):
            try:
                print(order, file=self._process.stdin, flush=True)
                answer = self._process.stdout.readline() if self._process.stdout else ""
            except BrokenPipeError:
                answer = ""
            if answer:
                return json.loads(answer)
            self._start()
        raise SystemExit("the process that runs the tests ended three times")

    def _start(self) -> None:
        self._process = subprocess.Popen(self._command, stdin=PIPE, stdout=PIPE, text=True)


def _faults(module: str) -> Sequence[Fault]:
    """Every fault that is known for a file."""
    path = Path(module)
    return mutation_c.faults(path) if path.suffix == ".c" else mutation_python.faults(path)


def _sample(faults: Sequence[Fault], generator: random.Random) -> Iterator[Fault]:
    """One fault of every place in turn, places and faults shuffled."""
    places: dict[Any, list[Fault]] = {}
    for fault in faults:
        places.setdefault(fault.place, []).append(fault)
    shuffled = [places[key] for key in sorted(places)]
    generator.shuffle(shuffled)
    for one in shuffled:
        generator.shuffle(one)
    return (fault for fault in chain.from_iterable(zip_longest(*shuffled)) if fault is not None)


def _write(row: Row) -> None:
    """Put the line into the table of the page, in place of an older one of the same module."""
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    table, _, after = rest.partition(END)
    rows = {line.split("`")[1]: line for line in table.splitlines() if line.startswith("| `")}
    rows[row.module] = str(row)
    order = {module: place for place, (module, _) in enumerate(_targets())}
    lines = [rows[module] for module in sorted(rows.keys() & order.keys(), key=lambda m: order[m])]
    PAGE.write_text(before + "\n".join([BEGIN, "", HEAD, *lines, "", END]) + after, encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
