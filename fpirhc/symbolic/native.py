"""Compilation of Functions to C, with a content-addressed cache of the compiled libraries.

Theory: docs/theory.md.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import shlex
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.util import find_spec
from pathlib import Path

import casadi as ca

from fpirhc.errors import CompileError, NoCode
from fpirhc.symbolic import driver, program
from fpirhc.symbolic.program import NAME, generate

# -ffp-contract=off: no fused multiply-add, so that C and the virtual machine round alike.
# -z defs: a missing symbol must fail here and not end the process at the first call.
_LINK = ("-shared", *(("-Wl,-z,defs",) if sys.platform == "linux" else ()))
# -falign: where a loop begins in a cache line decides up to 17 % of a plan's time, and any other number of the code moves it.
_ALIGNED = ("-falign-functions=64", "-falign-loops=64")
# -fno-semantic-interposition: CasADi's small functions are no symbols that another library may replace, so they are inlined.
_FLAGS = (*_ALIGNED, "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-fno-semantic-interposition")
_SUFFIX = {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")
_LARGE = 500_000  # bytes of C above which optimising takes longer than it saves: at 1.2 MB -O3 took 52 s and -O1 21 s
_loaded: dict[str, ca.Function] = {}


@dataclass(frozen=True, eq=False)
class Native:
    """A Function that runs as compiled code or in the virtual machine."""

    function: ca.Function  # the Function to call
    compiled: bool  # whether it is compiled
    reason: str  # why it is not compiled; empty otherwise


def find_compiler() -> str | None:
    """Path of the C compiler: FPIRHC_CC, else CC, cc, gcc, clang or ziglang; None where FPIRHC_CC is 'none' or there is none."""
    setting = os.environ.get("FPIRHC_CC", "")
    if setting:
        return None if setting.lower() == "none" else shutil.which(setting)
    for name in (os.environ.get("CC", ""), "cc", "gcc", "clang"):
        path = shutil.which(name) if name else None
        if path:
            return path
    package = find_spec("ziglang")
    return shutil.which("zig", path=str(Path(package.origin).parent)) if package and package.origin else None


def command_of(compiler: str) -> tuple[str, ...]:
    """Return how a compiler of `find_compiler` is called: that of ziglang is a part of zig, whose checks would end the process."""
    return (compiler, "cc", "-fno-sanitize=undefined") if Path(compiler).stem == "zig" else (compiler,)


def native(function: ca.Function, flags: Sequence[str] = (), *, required: bool = False, calls: int = 0) -> Native:
    """Return so many calls of a Function compiled, 0 for itself, or it as it is with the reason; a failure may be an error."""
    if function.is_a("External"):
        return Native(function, True, "")
    compiler = find_compiler()
    if compiler is None:
        return Native(function, False, why_no_compiler())
    try:
        library = _Library(function, compiler, flags, calls)
        if library.key not in _loaded:
            _loaded[library.key] = library.load()
        return Native(_loaded[library.key], True, "")
    except (NoCode, CompileError) as error:
        if required and isinstance(error, CompileError):
            raise
        return Native(function, False, str(error))


def compile_all(wanted: Iterable[tuple[ca.Function, int]]) -> None:
    """Compile so many calls of Functions side by side, where `native` will find them; what fails is its error then."""
    compiler, libraries = find_compiler(), dict[str, _Library]()
    for function, calls in wanted if compiler is not None else ():
        with contextlib.suppress(NoCode):
            library = _Library(function, str(compiler), (), calls)
            if library.key not in _loaded and not library.path.is_file():
                library.units  # noqa: B018 -- its C is written here: CasADi works in one thread
                libraries[library.key] = library
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for one in libraries.values():
            pool.submit(one.make)


def cache_folder() -> Path:
    """Folder of compiled libraries: the user's own one in FPIRHC_CACHE, which may be shared, or fpirhc in the user's cache."""
    setting, posix = os.environ.get("FPIRHC_CACHE"), os.name == "posix"
    try:
        if setting:
            base = Path(setting) / (f"fpirhc-{os.geteuid()}" if posix else "fpirhc")
        else:
            base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fpirhc"
        base = base.absolute()  # a bare file name would be looked for in the system's library folders
        base.mkdir(mode=0o700, parents=True, exist_ok=True)
        facts = base.lstat()  # of a link itself: one of a stranger leads to what is not meant, and what is in it is run
        if posix and (facts.st_uid != os.geteuid() or not stat.S_ISDIR(facts.st_mode) or facts.st_mode & 0o022):
            return Path(_temporary_folder().name)
        with tempfile.TemporaryFile(dir=base):
            return base
    except (OSError, RuntimeError):  # RuntimeError: there is no home folder
        return Path(_temporary_folder().name)


@cache
def _temporary_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="fpirhc-")  # removed with this process


def why_no_compiler() -> str:
    """Return why `find_compiler` finds none."""
    setting = os.environ.get("FPIRHC_CC", "")
    if setting.lower() == "none":
        return "compilation is turned off (FPIRHC_CC=none)"
    if setting:
        return f"the C compiler '{setting}', asked for by FPIRHC_CC, was not found"
    return "no C compiler was found (looked for CC, cc, gcc, clang, ziglang)"


@cache
def _version(compiler: str) -> str:
    process = _run([*command_of(compiler)[:2], "--version"])
    return process.stdout + process.stderr


def _run(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run a compiler with untranslated messages."""
    untranslated = {**os.environ, "LC_ALL": "C"}
    try:
        # A list instead of a shell line: folder names are never read as commands.
        return subprocess.run(command, capture_output=True, text=True, errors="replace", check=False, env=untranslated)
    except OSError as error:
        raise CompileError(f"the C compiler '{command[0]}' cannot be started: {error}") from None


@dataclass(frozen=True)
class _Unit:
    """A C file with the command that compiles it, and the hash of all that its object depends on."""

    source: str
    command: tuple[str, ...]

    @property
    def key(self) -> str:
        facts = (self.source, *self.command, _version(self.command[0]), platform.machine(), ca.CasadiMeta.version())
        return hashlib.sha256("\0".join(facts).encode()).hexdigest()[:32]


def _unit(source: str, compiler: str, more: Sequence[str]) -> _Unit:
    level = "-O3" if len(source) < _LARGE else "-O1"
    return _Unit(source, (*command_of(compiler), level, *_FLAGS, *_machine_flags(), *more, "-c"))


@cache
def _machine_flags() -> tuple[str, ...]:
    """Flags for this machine: where it has wide registers all code uses them. Without fused multiply-add both round alike."""
    with contextlib.suppress(OSError):
        if platform.machine() == "x86_64" and " avx2 " in Path("/proc/cpuinfo").read_text(encoding="utf-8"):
            return ("-mavx2",)
    return ()


@cache
def _writer() -> str:
    """Hash of the code that writes C."""
    files = (Path(__file__), *(Path(module.__file__ or "") for module in (driver, program)))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


class _Library:
    """The library of so many calls of a Function, found by a hash of it, in which names of drivers have one of their text."""

    def __init__(self, function: ca.Function, compiler: str, flags: Sequence[str], calls: int) -> None:
        flags = *flags, *shlex.split(os.environ.get("FPIRHC_CFLAGS", ""))
        self._what, self._compiler, self._flags = (function, calls), compiler, flags
        self._link = (*command_of(compiler), *flags, *_LINK)
        try:
            content = function.serialize()
        except RuntimeError:
            content = "\0".join(generate(function, calls))
        facts = (_writer(), str(calls), *self._link, _unit("", compiler, flags).key, content)
        self.key = hashlib.sha256("\0".join(facts).encode()).hexdigest()[:32]
        self.path = cache_folder() / f"{self.key}{_SUFFIX}"

    @cached_property
    def units(self) -> tuple[_Unit, ...]:
        """Its C files with their commands: its own, and those of the drivers that it calls."""
        own, *drivers = generate(*self._what)
        texts = own.replace(NAME, f"fpirhc_{self.key}"), *drivers
        return tuple(_unit(text, self._compiler, self._flags) for text in texts)

    def load(self) -> ca.Function:
        """Return it from the cache, compiled before where it is not there, or cannot be loaded on this system."""
        if self.path.is_file():
            with contextlib.suppress(RuntimeError):
                return ca.external(f"fpirhc_{self.key}", str(self.path))
        try:
            self.make()
            return ca.external(f"fpirhc_{self.key}", str(self.path))
        except (OSError, RuntimeError) as error:
            if isinstance(error, CompileError):
                raise
            raise CompileError(f"the compiled code cannot be kept in '{self.path.parent}' or loaded: {error}") from None

    def make(self) -> None:
        """Compile it into the cache, its files side by side: its own one, and drivers, whose objects other libraries share."""
        folder = self.path.parent
        with tempfile.TemporaryDirectory(prefix="fpirhc-") as work, ThreadPoolExecutor(os.cpu_count()) as pool:
            places = [Path(work) / "own.o", *(folder / f"{unit.key}.o" for unit in self.units[1:])]
            list(pool.map(_compile, self.units, places, [work] * len(places)))
            _made([*self._link, *map(str, places), "-lm"], self.path, work)


def _compile(unit: _Unit, place: Path, work: str) -> None:
    if not place.is_file():
        text = Path(work) / f"{unit.key}.c"
        text.write_text(unit.source, encoding="utf-8")
        _made([*unit.command, str(text)], place, work)


def _made(command: Sequence[str], place: Path, work: str) -> None:
    """Run a compiler and put what it makes into its place, whole or not at all."""
    with tempfile.TemporaryDirectory(dir=place.parent, prefix="building-", ignore_cleanup_errors=True) as near:
        made = Path(near) / place.name
        process = _run([*command, "-o", str(made)])
        if process.returncode != 0 or not made.is_file():
            lines = [*process.stderr.replace(work + os.sep, "").strip().splitlines(), f"exit code {process.returncode}"]
            # The line that names the error, not the line that names the function around it.
            message = next((line for line in lines if "error" in line or "undefined" in line), lines[0])
            raise CompileError(f"the C compiler '{command[0]}' failed: {message}")
        made.replace(place)
