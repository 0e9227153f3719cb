"""Libraries of C files: for this machine by its compiler, for others and for the web where ziglang is installed."""

from __future__ import annotations

import platform
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from fpirhc.errors import CompileError, package
from fpirhc.symbolic.native import find_compiler

# No fused multiply-add: the numbers are those of Python. Symbols that FMI or a caller does not need stay inside.
_FLAGS = ("-std=c99", "-O2", "-s", "-ffp-contract=off")
_SHARED = ("-shared", "-fvisibility=hidden")
_ZIG = (sys.executable, "-m", "ziglang", "cc", "-target")
_MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}
_SYSTEMS = {"linux": "linux", "darwin": "darwin", "win32": "windows"}
ENDINGS = {"linux": ".so", "darwin": ".dylib", "windows": ".dll"}
PLATFORMS = {  # and the names that zig has for them
    "x86_64-linux": "x86_64-linux-gnu.2.17",
    "aarch64-linux": "aarch64-linux-gnu.2.17",
    "x86_64-windows": "x86_64-windows-gnu",
    "x86_64-darwin": "x86_64-macos",
    "aarch64-darwin": "aarch64-macos",
}
WEB_STACK = 262144  # bytes, which hold the deepest plan


def shared_libraries(files: Mapping[str, str]) -> dict[str, bytes]:
    """Return a shared library by platform, "x86_64-linux" and so on; nothing where there is no compiler."""
    return {place: _compiled(files, command, place) for place, command in _compilers().items()}


def web_module(files: Mapping[str, str]) -> bytes:
    """Return a WebAssembly module of C files, without imports."""
    package("ziglang", "compiler", "the target wasm")
    # zig's own 16 MB are all that a page would ask for.
    flags = ("-mexec-model=reactor", f"-Wl,-z,stack-size={WEB_STACK}", "-Wl,--no-entry")
    return _compiled(files, [*_ZIG, "wasm32-wasi", *flags], "wasm32")


def _done(command: Sequence[str], otherwise: str) -> str:
    """Run a command and return what it complains of."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise CompileError(f"{otherwise}: '{command[0]}' cannot be started: {error.strerror}") from None
    if done.returncode != 0:
        raise CompileError(f"{otherwise}: {done.stderr.strip()[-2000:]}")
    return done.stderr


def _compilers() -> dict[str, list[str]]:
    """The command of the compiler for each platform."""
    commands = {}
    if find_spec("ziglang") is not None:
        # The plainest processor of each kind, for a library that goes to other machines.
        for place, target in PLATFORMS.items():
            commands[place] = [*_ZIG, target, "-mcpu=baseline", *_SHARED]
    own = find_compiler()
    if own is not None:
        commands[_here()] = [own, *_SHARED]
    return commands


def _here() -> str:
    machine = platform.machine().lower()
    return f"{_MACHINES.get(machine, machine)}-{_SYSTEMS.get(sys.platform, sys.platform)}"


def _compiled(files: Mapping[str, str], command: Sequence[str], place: str) -> bytes:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in files.items():
            (folder / file).write_text(text, encoding="utf-8")
        library, sources = folder / "library", [str(folder / file) for file in files if file.endswith(".c")]
        elsewhere = ("-fPIC", "-lm") if place.endswith(("linux", "darwin")) else ()
        _done([*command, *_FLAGS, *sources, *elsewhere, "-o", str(library)], f"no library for {place}")
        return library.read_bytes()
