"""The examination of an installation: checks of installed parts and of folders that must be writable, and their findings."""

from __future__ import annotations

import json
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import casadi as ca

from fpirhc.symbolic.native import cache_folder, find_compiler, native

_LARGE_CACHE = 2e9  # bytes
_SOLVERS = ("ipopt", "fatrop", "sqpmethod")  # of nonlinear programs, that optimisers here call
_QUADRATIC = ("qrqp", "osqp")
_OTHERS = ("alpaqa", "bonmin", "knitro", "madnlp", "snopt", "worhp")
_EXPORT = (  # module or program, what it is for, and what brings it
    ("ziglang", "WebAssembly, labs, Cortex-M and other platforms", "pip install 'fpirhc[compiler]'"),
    ("fmpy", "functional mock-up units", "pip install 'fpirhc[fmu]'"),
    ("unicorn", "a Cortex-M without a board", "pip install 'fpirhc[cortex]'"),
    ("avr-gcc", "sizes on Arduino boards", "packages gcc-avr and avr-libc"),
    ("cppcheck", "deviations from MISRA C", "package cppcheck"),
)


class Outcome(IntEnum):
    """Outcomes of a check, from best to worst."""

    OK = 0
    WARN = 1
    FAIL = 2


@dataclass(frozen=True)
class Finding:
    """The result of one check."""

    name: str  # name of the check
    outcome: Outcome
    evidence: str  # the facts in a sentence
    remedy: str = ""  # what to do; empty: nothing


_Check = Callable[[], tuple[Outcome, str, str]]


def ask(checks: Sequence[_Check]) -> list[Finding]:
    """Run checks one by one; a check that raises has failed."""
    findings = []
    for check in checks:
        name = check.__name__.replace("_", "-")
        try:
            findings.append(Finding(name, *check()))
        except Exception as error:  # noqa: BLE001 -- a broken installation may raise anything, and the other checks count
            lines = str(error).strip().splitlines() or [""]
            remedy = "install fpirhc and its dependencies again in a fresh environment"
            findings.append(Finding(name, Outcome.FAIL, f"{type(error).__name__}: {lines[0]}", remedy))
    return findings


def _fine(text: str) -> tuple[Outcome, str, str]:
    """Return OK, with nothing to do."""
    return Outcome.OK, text, ""


def judged(holds: bool, text: str, remedy: str, otherwise: Outcome = Outcome.FAIL) -> tuple[Outcome, str, str]:
    """Return OK where a condition holds, else `otherwise` with the remedy."""
    return (Outcome.OK, text, "") if holds else (otherwise, text, remedy)


def versions() -> dict[str, str]:
    """Return versions of fpirhc and of what its numbers depend on, the machine, and the cores that this process may use."""
    packages = {name: version(name) for name in ("fpirhc", "casadi", "numpy", "scipy", "osqp", "control")}
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    machine = f"{platform.system()} {platform.machine()}, {usable} of {os.cpu_count() or usable} cores"
    return {**packages, "python": platform.python_version(), "machine": machine}


def solver_plugins() -> tuple[Outcome, str, str]:
    """Check the solvers that the optimisers call, and list others that CasADi can load."""
    needed = {**{n: ca.has_nlpsol(n) for n in _SOLVERS}, **{n: ca.has_conic(n) for n in _QUADRATIC}}
    missing = [name for name, there in needed.items() if not there]
    others = [name for name in _OTHERS if ca.has_nlpsol(name)]
    text = f"found {', '.join(n for n in needed if n not in missing)}"
    text += f", also {', '.join(others)}" if others else ""
    text += f"; missing {', '.join(missing)}" if missing else ""
    return judged(
        not missing, text, "install casadi from its wheel: pip install --force-reinstall casadi", Outcome.WARN
    )


def c_compiler() -> tuple[Outcome, str, str]:
    """Compile, load and evaluate a small Function, whose name is one of libc on purpose."""
    compiler = find_compiler()
    x = ca.SX.sym("x")
    # A function with the name of one of libc would be called in its place: the name must have a prefix.
    built = native(ca.Function("step", [x], [3 * x + 1]))
    if not built.compiled:
        remedy = "install gcc or clang, or name a compiler by FPIRHC_CC; without one loops run several times slower"
        return Outcome.WARN, built.reason, remedy
    value = float(built.function(2))
    name = built.function.name()
    holds = value == 7 and name.startswith("fpirhc_")
    return judged(holds, f"{compiler}; compiled {name}: 3 * 2 + 1 = {value:g}", "name another compiler by FPIRHC_CC")


def cache() -> tuple[Outcome, str, str]:
    """Check the folder of compiled libraries: its place and its size. `cache_folder` closes it to other users."""
    folder = cache_folder()
    wished = os.environ.get("FPIRHC_CACHE") or os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    files = [f for f in folder.iterdir() if f.is_file()]
    size = sum(f.stat().st_size for f in files)
    text = f"{folder}: {sum(f.suffix != '.sha256' for f in files)} libraries, {size / 1e6:.1f} MB"
    if not folder.is_relative_to(Path(wished).absolute()):
        remedy = f"make '{wished}' writable or name another folder by FPIRHC_CACHE; now every process compiles afresh"
        return Outcome.WARN, f"'{wished}' cannot be written, so a temporary folder is used: {folder}", remedy
    remedy = f"remove old libraries from '{folder}'; they are compiled again when needed"
    return judged(size < _LARGE_CACHE, text, remedy, Outcome.WARN)


def results_folder() -> tuple[Outcome, str, str]:
    """Check that results can be written without --out."""
    folder = next(f for f in (Path("results"), Path()) if f.is_dir())
    try:
        with tempfile.TemporaryFile(dir=folder):
            return _fine(f"'{folder.absolute()}' can be written")
    except OSError as error:
        text = f"'{folder.absolute()}' cannot be written: {error.strerror}"
        return Outcome.WARN, text, "go to a folder of your own, or give --out to run, compare and solve"


def python_threads() -> tuple[Outcome, str, str]:
    """Check the global lock; two threads that share a Function end the process, and sooner without the lock."""
    enabled = getattr(sys, "_is_gil_enabled", lambda: True)()
    remedy = "use a Python with its global lock, and processes instead of threads"
    return judged(
        enabled, f"global lock {'on' if enabled else 'off'}; run many loops in processes, never in threads", remedy
    )


def export_tools() -> tuple[Outcome, str, str]:
    """Name what `fpirhc export` and `fpirhc lab` can use beside the C compiler, and how to get the rest; none of it is a must."""
    there, missing = [], []
    for name, what, how in _EXPORT:
        if shutil.which(name):
            there.append(name)
        elif find_spec(name) is not None:
            there.append(f"{name} {version(name)}")
        else:
            missing.append(f"{name} for {what}: {how}")
    return _fine("; ".join([f"here: {', '.join(there) or 'none'}", *(f"without {one}" for one in missing)]))


CHECKS: tuple[_Check, ...] = (solver_plugins, c_compiler, export_tools, cache, results_folder, python_threads)


@dataclass(frozen=True)
class Diagnosis:
    """The results of all checks."""

    versions: dict[str, str]  # versions of fpirhc and of what its numbers depend on
    findings: Sequence[Finding]  # findings in the order of the checks

    @property
    def outcome(self) -> Outcome:
        """The worst of all findings."""
        return max((f.outcome for f in self.findings), default=Outcome.OK)

    def text(self) -> str:
        """Return one line per finding, with the remedy under each that is not OK."""
        lines = [", ".join(f"{name} {number}" for name, number in self.versions.items())]
        for finding in self.findings:
            lines.append(f"{finding.outcome.name.lower():4s}  {finding.name}: {finding.evidence}")
            if finding.remedy:
                lines.append(f"      to do: {finding.remedy}")
        counts = [sum(f.outcome == outcome for f in self.findings) for outcome in Outcome]
        return "\n".join([*lines, f"{counts[0]} ok, {counts[1]} to look at, {counts[2]} failed"])

    def json(self) -> str:
        """Return one JSON object."""
        checks = [
            {"name": f.name, "outcome": f.outcome.name.lower(), "evidence": f.evidence, "remedy": f.remedy}
            for f in self.findings
        ]
        return json.dumps({"outcome": self.outcome.name.lower(), "versions": self.versions, "checks": checks}, indent=2)


def examine() -> Diagnosis:
    """Return the versions of the installation and the results of all checks."""
    return Diagnosis(versions(), ask(CHECKS))
