"""The examination of an installation: versions, solvers, compiler, cache."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable, Iterator
from importlib.metadata import version

import casadi as ca

from fpirhc.symbolic.native import cache_folder, find_compiler, native

Finding = tuple[str, str, str, str]  # name; ok, warn or fail; evidence; what to do
_PACKAGES = ("fpirhc", "casadi", "numpy", "scipy", "osqp", "control")


def _solvers() -> tuple[str, str, str]:
    missing = [name for name in ("ipopt", "fatrop", "sqpmethod") if not ca.has_nlpsol(name)]
    return "warn" if missing else "ok", f"missing: {', '.join(missing) or 'none'}", "install casadi from its wheel"


def _compiler() -> tuple[str, str, str]:
    x = ca.SX.sym("x")
    built = native(ca.Function("step", [x], [3 * x + 1]))  # a name of libc: it must have a prefix
    if not built.compiled:
        return (
            "warn",
            built.reason,
            "install gcc or clang, or name a compiler by FPIRHC_CC; without one loops are slower",
        )
    value = float(built.function(2))
    return "ok" if value == 7 else "fail", f"{find_compiler()}: 3 * 2 + 1 = {value:g}", "name another one by FPIRHC_CC"


def _cache() -> tuple[str, str, str]:
    size = sum(file.stat().st_size for file in cache_folder().iterdir() if file.is_file())
    return "ok" if size < 2e9 else "warn", f"{cache_folder()}: {size / 1e6:.1f} MB", "remove old libraries from it"


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


def written(findings: list[Finding], as_json: bool) -> str:
    """Return the findings as text, or as JSON."""
    if as_json:
        names = ("name", "outcome", "evidence", "remedy")
        return json.dumps([dict(zip(names, one, strict=True)) for one in findings], indent=1)
    return "\n".join(f"{o:4s}  {n}: {e}" + (f"; to do: {r}" if o != "ok" else "") for n, o, e, r in findings)
