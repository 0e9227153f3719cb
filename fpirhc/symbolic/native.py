"""Compilation of Functions to C, with a content-addressed cache of the compiled libraries.

Theory: docs/theory.md.
"""

from __future__ import annotations

import atexit
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
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cache, cached_property, partial
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
_LARGE = 500_000  # bytes of C above which optimising takes longer than it saves: at 1.2 MB -O3 took 52 s and -O1 21 s
_loaded: dict[str, ca.Function] = {}
_begun: dict[Path, Future[None]] = {}  # compilers at work, by the library that they make
_places: dict[Path, threading.Lock] = {}  # of objects that are being made


@dataclass(frozen=True, eq=False)
class Native:
    """A Function that runs as compiled code or in the virtual machine."""

    function: ca.Function  # the Function to call
    compiled: bool  # whether it is compiled
    reason: str  # why it is not compiled; empty otherwise


def find_compiler() -> str | None:
    """Path of the C compiler: FPIRHC_CC, else CC, cc, gcc or clang; None where FPIRHC_CC is 'none' or there is none.

    Where FPIRHC_CC names a compiler, no other one replaces it.
    """
    setting = os.environ.get("FPIRHC_CC", "")
    if setting:
        return None if setting.lower() == "none" else shutil.which(setting)
    for name in (os.environ.get("CC", ""), "cc", "gcc", "clang"):
        path = shutil.which(name) if name else None
        if path:
            return path
    return None


def native(function: ca.Function, flags: Sequence[str] = (), *, required: bool = False, calls: int = 0) -> Native:
    """Return `function` compiled, or as it is with the reason why not.

    What FPIRHC_CFLAGS has goes to the compiler behind all other flags: with -O0 a plan compiles in a ninth of the time, runs many
    times as long, and has the same bits.

    Args:
        required: whether a failure of the compiler is an error; without a compiler `function` is returned as it is all the same.
        calls: number of calls in a row that the compiled Function makes, see `program.chained`; 0: one call of `function` itself.

    Raises:
        CompileError: `required`, and the compiler failed.
    """
    if function.is_a("External"):
        return Native(function, True, "")
    compiler = find_compiler()
    if compiler is None:
        return Native(function, False, why_no_compiler())
    try:
        library = _Library(function, compiler, _with_own(flags), calls)
        if library.key not in _loaded:
            _loaded[library.key] = library.load()
        return Native(_loaded[library.key], True, "")
    except (NoCode, CompileError) as error:
        if required and isinstance(error, CompileError):
            raise
        return Native(function, False, str(error))


@contextlib.contextmanager
def compiling_ahead() -> Iterator[Callable[..., None]]:
    """Yield a function that starts the compiler for what `native` will be asked later with the same arguments, and does not wait.

    `native` waits for a compiler that has been started, so several are at work side by side while Python goes on. What fails here
    fails again there, with its message.
    """
    pool, begun = ThreadPoolExecutor(os.cpu_count()), list[Path]()

    def begin(function: ca.Function, flags: Sequence[str] = (), *, calls: int = 0) -> None:
        compiler = find_compiler()
        if compiler is None:
            return
        with contextlib.suppress(NoCode):
            library = _Library(function, compiler, _with_own(flags), calls)
            if library.key in _loaded or library.path in _begun or _is_intact(library.path):
                return
            library.units  # noqa: B018 -- its C is written here: CasADi works in one thread
            _begun[library.path] = pool.submit(library.make)
            begun.append(library.path)

    try:
        yield begin
    finally:
        pool.shutdown(cancel_futures=True)
        for path in begun:
            _begun.pop(path, None)


def _with_own(flags: Sequence[str]) -> Sequence[str]:
    """The flags, and behind them those of the user."""
    return (*flags, *shlex.split(os.environ.get("FPIRHC_CFLAGS", "")))


def cache_folder() -> Path:
    """Folder of compiled libraries: the user's own one in FPIRHC_CACHE, which may be shared, or fpirhc in the user's cache.

    It is a temporary folder of this process where that one cannot be written, or belongs to another user.
    """
    setting = os.environ.get("FPIRHC_CACHE")
    try:
        if setting:
            base = Path(setting) / own_name()
        else:
            base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fpirhc"
        base = base.absolute()  # a bare file name would be looked for in the system's library folders
        private_folder(base)
        with tempfile.TemporaryFile(dir=base):
            return base
    except (OSError, RuntimeError):  # RuntimeError: there is no home folder
        return _temporary_folder()


@cache
def _temporary_folder() -> Path:
    """A folder for this process, removed when it ends, and not when a process that was forked from it ends."""
    folder, owner = Path(tempfile.mkdtemp(prefix="fpirhc-")), os.getpid()

    def remove() -> None:
        if os.getpid() == owner:
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    return folder


def why_no_compiler() -> str:
    """Return why `find_compiler` finds none."""
    setting = os.environ.get("FPIRHC_CC", "")
    if setting.lower() == "none":
        return "compilation is turned off (FPIRHC_CC=none)"
    if setting:
        return f"the C compiler '{setting}', asked for by FPIRHC_CC, was not found"
    return "no C compiler was found (looked for CC, cc, gcc, clang)"


@cache
def _version(compiler: str) -> str:
    process = _run([compiler, "--version"])
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
    return _Unit(source, (compiler, level, *_FLAGS, *_machine_flags(), *more, "-c"))


@cache
def _processor() -> str:
    """What Linux says of the processors; empty elsewhere."""
    try:
        return Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return ""


def _machine_flags() -> tuple[str, ...]:
    """Flags for this machine: where it has wide registers all code uses them, and the optimisers' loops have no other code."""
    return ("-DALWAYS_WIDE", "-mavx2") if platform.machine() == "x86_64" and " avx2 " in _processor() else ()


@cache
def _writer() -> str:
    """Hash of the code that writes C."""
    files = (Path(__file__), *(Path(module.__file__ or "") for module in (driver, program)))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


class _Library:
    """The library of so many calls of a Function, which is found without writing its C.

    Its key is a hash of the Function, in which the names of drivers have a hash of their text, and of all else that decides it:
    compiler, flags, machine, CasADi, and the code that writes C.

    Raises:
        NoCode: a Function that cannot be written as C.
    """

    def __init__(self, function: ca.Function, compiler: str, flags: Sequence[str], calls: int) -> None:
        self._what, self._compiler, self._flags = (function, calls), compiler, flags
        self._link = (compiler, *flags, *_LINK)
        try:
            content = function.serialize()
        except RuntimeError:
            content = "\0".join(generate(function, calls))
        facts = (_writer(), str(calls), *self._link, _unit("", compiler, flags).key, content)
        self.key = hashlib.sha256("\0".join(facts).encode()).hexdigest()[:32]
        self.path = cache_folder() / f"{self.key}{_suffix()}"

    @cached_property
    def units(self) -> tuple[_Unit, ...]:
        """Its C files with their commands: its own, and those of the drivers that it calls."""
        own, *drivers = generate(*self._what)
        texts = own.replace(NAME, f"fpirhc_{self.key}"), *drivers
        return tuple(_unit(text, self._compiler, self._flags) for text in texts)

    def make(self) -> None:
        """Compile it into the cache."""
        _compile(self.units, self._link, self.path)

    def load(self) -> ca.Function:
        """Return it from the cache, compiled before where it is not there, or was made on another system."""
        begun = _begun.pop(self.path, None)
        if begun is not None:
            wait([begun])
        if _is_intact(self.path):
            with contextlib.suppress(RuntimeError):
                return ca.external(f"fpirhc_{self.key}", str(self.path))
        try:
            self.make()
            return ca.external(f"fpirhc_{self.key}", str(self.path))
        except (OSError, RuntimeError) as error:
            if isinstance(error, CompileError):
                raise
            raise CompileError(
                f"the compiled library cannot be kept in '{self.path.parent}' or loaded: {error}"
            ) from None


def _suffix() -> str:
    return {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")


def _checksum_file(path: Path) -> Path:
    return path.with_suffix(".sha256")


def _is_intact(path: Path) -> bool:
    try:
        return hashlib.sha256(read_own(path)).hexdigest().encode() == read_own(_checksum_file(path))
    except OSError:
        return False


def _compile(units: Sequence[_Unit], link: Sequence[str], path: Path) -> None:
    """Compile into a folder of its own beside the cache entry, files side by side, then link and put the library into place.

    The first file is of this library alone. Others are drivers, whose objects are kept for the libraries that share them. What
    killed processes left behind is removed here and not where a library is found: a cache of thousands of files is slow to list.
    """
    _remove_abandoned(path.parent)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=BUILDING, ignore_cleanup_errors=True) as work:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            own = pool.submit(_object, Path(work), 0, units[0])
            shared = pool.map(partial(_driver, path.parent, Path(work)), range(1, len(units)), units[1:])
            objects = [own.result(), *shared]
        library = Path(work) / f"model{_suffix()}"
        _succeed([*link, "-o", str(library), *map(str, objects), "-lm"], library, work)
        _publish(library, path)


def _driver(folder: Path, work: Path, number: int, unit: _Unit) -> Path:
    """The object of a driver: one of two threads that need the same one compiles it, and the other one waits."""
    place = folder / f"{unit.key}.o"
    with _places.setdefault(place, threading.Lock()):
        if not _is_intact(place):
            _publish(_object(work, number, unit), place)
    return place


def _object(work: Path, number: int, unit: _Unit) -> Path:
    text, made = (work / f"part{number}{suffix}" for suffix in (".c", ".o"))
    text.write_text(unit.source, encoding="utf-8")
    _succeed([*unit.command, "-o", str(made), str(text)], made, str(work))
    return made


def _succeed(command: Sequence[str], made: Path, work: str) -> None:
    process = _run(command)
    if process.returncode != 0 or not made.is_file():
        message = _first_error(process.stderr.replace(work + os.sep, "")) or f"exit code {process.returncode}"
        raise CompileError(f"the C compiler '{command[0]}' failed: {message}")


def _publish(made: Path, path: Path) -> None:
    """Put a file and its checksum into their places in the cache."""
    checksum = made.with_suffix(".sha256")
    checksum.write_text(hashlib.sha256(made.read_bytes()).hexdigest(), encoding="ascii")
    made.chmod(0o700)
    checksum.chmod(0o600)
    made.replace(path)
    checksum.replace(_checksum_file(path))


def _first_error(messages: str) -> str:
    """The line that names the error, not the line that names the function around it."""
    lines = messages.strip().splitlines()
    return next((line for line in lines if "error" in line or "undefined" in line), lines[0] if lines else "")


BUILDING = "building-"  # beginning of the names of folders in which something is being compiled
_ABANDONED = 3600.0  # s; no compilation takes that long, so its process was killed


def private_folder(folder: Path) -> Path:
    """Create the folder where needed, and close it to others.

    Raises:
        OSError: it cannot be made, or it belongs to another user.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    facts = folder.stat()
    if not _is_own(facts) or not _is_own(folder.lstat()):  # a link of a stranger leads to what is not meant
        raise PermissionError(f"'{folder}' belongs to another user")
    if os.name == "posix" and stat.S_IMODE(facts.st_mode) & 0o077:
        folder.chmod(0o700)
    return folder


def own_name() -> str:
    """Return the name of the user's folder in a folder that several users may share."""
    return f"fpirhc-{os.geteuid()}" if os.name == "posix" else "fpirhc"


def read_own(path: Path) -> bytes:
    """Return the contents of a file that nobody else can have written."""
    # Without O_NONBLOCK the opening of a FIFO would wait for a writer.
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    with os.fdopen(os.open(path, flags), "rb") as file:
        facts = os.fstat(file.fileno())
        shared = os.name == "posix" and stat.S_IMODE(facts.st_mode) & 0o022
        if not stat.S_ISREG(facts.st_mode) or not _is_own(facts) or shared:
            raise PermissionError(f"'{path}' is no file of the user's own, or others may write to it")
        return file.read()


def _is_own(facts: os.stat_result) -> bool:
    return os.name != "posix" or facts.st_uid == os.geteuid()


def _remove_abandoned(folder: Path) -> None:
    for path in folder.glob(f"{BUILDING}*"):
        try:
            facts = path.lstat()
        except OSError:
            continue  # another process has just removed it
        if stat.S_ISDIR(facts.st_mode) and _is_own(facts) and time.time() - facts.st_mtime > _ABANDONED:
            shutil.rmtree(path, ignore_errors=True)
