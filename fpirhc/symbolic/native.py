"""Compiles Functions to C, once: the compiled library is kept in a content-addressed cache.

The key of a library is a hash of the generated C, the compiler and its version, the flags and CasADi's version, so a library can
never be another model's. It is compiled under a temporary name, its checksum is stored, and both are renamed into
place atomically: any number of processes may compile the same or different Functions at once. A library whose checksum does not
fit is compiled again.

FPIRHC_CC names the compiler ('none' turns compilation off); FPIRHC_CACHE names the cache folder.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import casadi as ca

from fpirhc.errors import CompileError

# -ffp-contract=off: no fused multiply-add, so that C and the virtual machine round alike.
_FLAGS = ("-O3", "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared")
_LARGE = 4_000_000  # bytes of C above which optimising takes longer than it saves
_LARGE_FLAGS = ("-O1", *_FLAGS[1:])
_NAME = "fpirhc_native"
_loaded: dict[str, ca.Function] = {}


@dataclass(frozen=True, eq=False)
class Native:
    """A Function and how it runs: compiled, or in the virtual machine for the given reason."""

    function: ca.Function
    compiled: bool
    reason: str


def find_compiler() -> str | None:
    """Path of the C compiler: FPIRHC_CC, then CC, then cc, gcc or clang; None when there is none or it is turned off."""
    wished = os.environ.get("FPIRHC_CC", "")
    if wished.lower() == "none":
        return None
    for name in (wished, os.environ.get("CC", ""), "cc", "gcc", "clang"):
        found = shutil.which(name) if name else None
        if found:
            return found
    return None


def native(function: ca.Function) -> Native:
    """Return `function` compiled, or itself with the reason why not."""
    compiler = find_compiler()
    if compiler is None:
        return Native(function, False, "no C compiler was found")
    source = generate(function)
    if source is None:
        return Native(function, False, "it calls a solver that cannot be written as C")
    try:
        return Native(_library(source, compiler), True, "")
    except CompileError as error:
        return Native(function, False, str(error))


def generate(function: ca.Function) -> str | None:
    """Return the C source of `function` under a fixed name, None when some part of it cannot be written as C."""
    inputs = [ca.MX.sym(function.name_in(k), function.sparsity_in(k)) for k in range(function.n_in())]
    names = (function.name_in(), function.name_out())
    # One call wrapped under a fixed name: the name of a mapaccum is CasADi's own, and must not decide the cache key.
    wrapped = ca.Function(_NAME, inputs, function.call(inputs, False, True), *names)
    generator = ca.CodeGenerator(_NAME, {"with_header": False})
    try:
        generator.add(wrapped)
        return str(generator.dump())
    except RuntimeError as error:
        if "codegen" in str(error).lower() or "not defined" in str(error) or "generat" in str(error).lower():
            return None
        raise


def cache_folder() -> Path:
    """Folder of compiled libraries: FPIRHC_CACHE, or fpirhc in the user's cache; a temporary one if not writable."""
    wished = os.environ.get("FPIRHC_CACHE")
    base = Path(wished) if wished else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fpirhc"
    try:
        base.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=base):
            return base
    except OSError:
        return _temporary_folder()


@cache
def _temporary_folder() -> Path:
    return Path(tempfile.mkdtemp(prefix="fpirhc-"))


@cache
def _version(compiler: str) -> str:
    done = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=False)
    return done.stdout + done.stderr


def _library(source: str, compiler: str) -> ca.Function:
    """Return the external Function of the library for this source, compiling it when needed."""
    flags = _FLAGS if len(source) < _LARGE else _LARGE_FLAGS
    facts = "\0".join((source, compiler, _version(compiler), *flags, ca.CasadiMeta.version()))
    key = hashlib.sha256(facts.encode()).hexdigest()[:32]
    if key not in _loaded:
        path = cache_folder() / f"{key}{_suffix()}"
        if not _is_intact(path):
            _compile(source, compiler, flags, path)
        _loaded[key] = _load(path, source, compiler, flags)
    return _loaded[key]


def _suffix() -> str:
    return {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")


def _load(path: Path, source: str, compiler: str, flags: Sequence[str]) -> ca.Function:
    try:
        return ca.external(_NAME, str(path))
    except RuntimeError:
        _compile(source, compiler, flags, path)
    try:
        return ca.external(_NAME, str(path))
    except RuntimeError as error:
        raise CompileError(f"the compiled library cannot be loaded: {error}") from None


def _checksum_file(path: Path) -> Path:
    return path.with_suffix(".sha256")


def _is_intact(path: Path) -> bool:
    try:
        expected = _checksum_file(path).read_text(encoding="ascii")
        return hashlib.sha256(path.read_bytes()).hexdigest() == expected
    except (OSError, UnicodeDecodeError):
        return False


def _compile(source: str, compiler: str, flags: Sequence[str], path: Path) -> None:
    """Compile into a folder of its own beside the cache entry, then rename library and checksum into place."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix="building-") as work:
        text, library, checksum = (Path(work) / f for f in ("model.c", f"model{_suffix()}", "model.sha256"))
        text.write_text(source, encoding="utf-8")
        # -o before the source, and a list instead of a shell line: folder names are never read as commands.
        command = [compiler, *flags, "-o", str(library), str(text), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0 or not library.is_file():
            first = (done.stderr.strip() or f"exit code {done.returncode}").splitlines()[0]
            raise CompileError(f"the C compiler '{compiler}' failed: {first}")
        checksum.write_text(hashlib.sha256(library.read_bytes()).hexdigest(), encoding="ascii")
        library.replace(path)
        checksum.replace(_checksum_file(path))
