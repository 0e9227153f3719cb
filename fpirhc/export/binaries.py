"""Libraries of C files: for this machine by its compiler, and for the web by ziglang."""

from __future__ import annotations

import platform
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from fpirhc.errors import CompileError, package
from fpirhc.symbolic.native import command_of, find_compiler

# No fused multiply-add: the numbers are those of Python. Symbols that FMI or a caller does not need stay inside.
_FLAGS = ("-std=c99", "-O2", "-s", "-ffp-contract=off")
_SHARED = ("-shared", "-fvisibility=hidden")
_MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}
_SYSTEMS = {"linux": "linux", "darwin": "darwin", "win32": "windows"}
_ENDINGS = {"linux": ".so", "darwin": ".dylib", "windows": ".dll"}
_WEB_STACK = 262144  # bytes, which hold the deepest plan


@dataclass(frozen=True)
class Library:
    """A shared library for this machine."""

    platform: str  # "x86_64-linux" and so on
    content: bytes

    @property
    def ending(self) -> str:
        """The ending of its file's name."""
        return _ENDINGS[self.platform.rpartition("-")[2]]


def shared_library(files: Mapping[str, str]) -> Library | None:
    """Return C files as a shared library; None where there is no compiler."""
    own = find_compiler()
    machine = platform.machine().lower()
    here = f"{_MACHINES.get(machine, machine)}-{_SYSTEMS.get(sys.platform, sys.platform)}"
    return None if own is None else Library(here, _compiled(files, [*command_of(own), *_SHARED], here))


def web_module(files: Mapping[str, str]) -> bytes:
    """Return a WebAssembly module of C files, without imports."""
    package("ziglang", "compiler", "the target wasm")
    # zig's own 16 MB are all that a page would ask for.
    flags = ("-mexec-model=reactor", f"-Wl,-z,stack-size={_WEB_STACK}", "-Wl,--no-entry")
    return _compiled(files, [sys.executable, "-m", "ziglang", "cc", "-target", "wasm32-wasi", *flags], "wasm32")


def _compiled(files: Mapping[str, str], command: Sequence[str], place: str) -> bytes:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in files.items():
            (folder / file).write_text(text, encoding="utf-8")
        library, sources = folder / "library", [str(folder / file) for file in files if file.endswith(".c")]
        elsewhere = ("-fPIC", "-lm") if place.endswith(("linux", "darwin")) else ()
        whole, otherwise = [*command, *_FLAGS, *sources, *elsewhere, "-o", str(library)], f"no library for {place}"
        try:
            done = subprocess.run(whole, capture_output=True, text=True, check=False)
        except OSError as error:
            raise CompileError(f"{otherwise}: '{command[0]}' cannot be started: {error.strerror}") from None
        if done.returncode != 0:
            raise CompileError(f"{otherwise}: {done.stderr.strip()[-2000:]}")
        return library.read_bytes()
