"""The examination of an installation: what is there, what is missing, what that is for, and the command that installs it."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable, Iterator
from importlib.metadata import version
from importlib.util import find_spec

import casadi as ca

from fpirhc.symbolic.native import cache_folder, find_compiler, native

Finding = tuple[str, str, str, str]  # name; ok, none (not needed by most), warn or fail; evidence; what to do
_PACKAGES = ("fpirhc", "casadi", "numpy", "scipy")
_SOLVERS = {"ipopt": "the optimiser Ipopt", "fatrop": "the optimiser Fatrop"}
_GCC = "sudo apt install gcc (Debian, Ubuntu), xcode-select --install (macOS), pip install ziglang, or name one by FPIRHC_CC"
_EXTRAS = {
    "tune": ("fpirhc tune", ("optuna",)),
    "test": ("the test that fpirhc new writes", ("pytest",)),
    "fmu": ("fpirhc export --to fmu2, and plants that are units of FMI", ("fmpy",)),
    "compiler": ("fpirhc export --to wasm and --to lab, and C without a compiler of the system", ("ziglang",)),
    "outside": ("plants in simulators of others", ("mujoco", "rotorpy", "tclab", "vehiclemodels")),
}


def _solvers() -> tuple[str, str, str]:
    missing = [f"{name} is missing, needed for {what}" for name, what in _SOLVERS.items() if not ca.has_nlpsol(name)]
    mend = "pip install --force-reinstall --only-binary :all: casadi"
    return ("warn", "; ".join(missing), mend) if missing else ("ok", ", ".join(_SOLVERS), "")


def _compiler() -> tuple[str, str, str]:
    x = ca.SX.sym("x")
    built = native(ca.Function("step", [x], [3 * x + 1]))  # a name of libc: it must have a prefix
    if not built.compiled:
        need = "needed for loops as compiled C, which are quicker, for limits of states in plans, and for --to library"
        return "warn", f"{built.reason}; {need}", _GCC
    value = float(built.function(2))
    return "ok" if value == 7 else "fail", f"{find_compiler()}: 3 * 2 + 1 = {value:g}", _GCC


def _cache() -> tuple[str, str, str]:
    size = sum(file.stat().st_size for file in cache_folder().iterdir() if file.is_file())
    text = f"{size / 1e6:.1f} MB of compiled loops in {cache_folder()}"
    return "ok" if size < 2e9 else "warn", text, f"rm -r {cache_folder()}; loops are compiled anew when they run"


def _extras() -> Iterator[Finding]:
    for extra, (need, packages) in _EXTRAS.items():
        missing = [name for name in packages if find_spec(name) is None]
        install = f"pip install 'fpirhc[{extra}]'"
        if missing:
            yield f"extra {extra}", "none", f"{', '.join(missing)} not installed, needed for {need}", install
        else:
            yield f"extra {extra}", "ok", f"for {need}", install


def examine() -> Iterator[Finding]:
    """Yield the finding of every check; a check that raises has failed."""
    known = ", ".join(f"{name} {version(name)}" for name in _PACKAGES)
    yield "versions", "ok", f"{known}, Python {platform.python_version()}, {os.cpu_count()} cores", ""
    checks: dict[str, Callable[[], tuple[str, str, str]]]
    checks = {"solvers": _solvers, "compiler": _compiler, "cache": _cache}
    for name, check in checks.items():
        try:
            yield name, *check()
        except Exception as error:  # noqa: BLE001 -- a broken installation may raise anything, and the other checks count
            yield name, "fail", f"{type(error).__name__}: {error}", "install fpirhc again in a fresh environment"
    yield from _extras()


def written(findings: list[Finding], as_json: bool) -> str:
    """Return the findings as text, or as JSON."""
    if as_json:
        names = ("name", "outcome", "evidence", "remedy")
        return json.dumps([dict(zip(names, one, strict=True)) for one in findings], indent=1)
    return "\n".join(f"{o:4s}  {n}: {e}" + (f"; to do: {r}" if o != "ok" else "") for n, o, e, r in findings)
