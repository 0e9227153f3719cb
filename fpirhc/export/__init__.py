"""A controller that leaves Python: its C, the C names of its numbers, targets and libraries.

The C is that of `Stepper.function`; no target computes anything of the controller anew. A module of
this folder with `TARGETS`, values that turn a `Device` into files, adds them.
"""

from __future__ import annotations

import platform
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from fpirhc.controllers.contract import Controller
from fpirhc.errors import CompileError, InvalidName, NotSupported, OutputError, package, writing
from fpirhc.members import within
from fpirhc.simulation.stepper import Stepper
from fpirhc.symbolic.layout import Layout
from fpirhc.symbolic.native import command_of, find_compiler
from fpirhc.symbolic.program import generate
from fpirhc.task.problem import Problem

_RAW = "fpirhc_native"  # name of the generated function, before it has its own
_DRIVER = re.compile(r"\bfpirhc_(\w+_driver)\b")
_WORDS, _FILES = (  # of C and C++; beside the controller's own, headers of C, and targets that CMake and make have
    frozenset(re.findall(r"\w+", text))
    for text in (
        """auto break case char const continue default do double else enum extern float for goto if inline int long register
        restrict return short signed sizeof static struct switch typedef union unsigned void volatile while main asm typeof class
        new delete this template namespace private public protected virtual operator bool true false""",
        """example replay samples layout controller all install clean help package test assert complex ctype errno fenv inttypes
        iso646 limits locale math setjmp signal stdarg stdbool stddef stdint stdio stdlib string tgmath time wchar wctype""",
    )
)
_LONGEST = 40  # characters of a name


@dataclass(frozen=True, eq=False)
class Device:
    """A controller for a device."""

    name: str  # prefix of everything in C
    title: str  # of problem and controller, as a comment may have it
    problem: Problem  # of the controller
    controller: Controller  # as the problem file has it
    # of the controller; compiled where there is a compiler, so that its numbers are those of C to the last bit
    stepper: Stepper

    @cached_property
    def inputs(self) -> Layout:
        """What a step is given: the time and the sample."""
        return Layout(tuple(s for s in self.stepper.reads.signals if s.name in self._sampled))

    @cached_property
    def data(self) -> Layout:
        """What stays until somebody changes it."""
        return Layout(tuple(s for s in self.stepper.reads.signals if s.name not in self._sampled))

    @property
    def _sampled(self) -> set[str]:
        return {self.problem.plant.time.name, *(signal.name for signal in self.problem.sample)}

    @cached_property
    def sources(self) -> tuple[str, ...]:
        """The C files of the Function, for every compiler: its own, and the loops that it calls."""
        return self._generated[0]

    @cached_property
    def sizes(self) -> dict[str, int]:
        """Numbers of pointers, whole numbers and numbers that the Function needs to work: arg, res, iw, w."""
        return self._generated[1]

    @cached_property
    def _generated(self) -> tuple[tuple[str, ...], dict[str, int]]:
        return c_of(self.stepper.function, self.name)


def c_of(function: ca.Function, name: str) -> tuple[tuple[str, ...], dict[str, int]]:
    """Return the C files of a Function, whose name in C is NAME_raw, and the sizes of its work: arg, res, iw, w."""
    texts = generate(function)
    sizes = {key: max(1, int(size)) for key, size in re.findall(r"\*sz_(\w+) = (\d+);", texts[0])}
    own = (portable(re.sub(rf"\b{_RAW}\b", f"{name}_raw", _DRIVER.sub(rf"{name}_\1", text))) for text in texts)
    return tuple(own), sizes


def identifiers(names: Sequence[str]) -> list[str]:
    """Return C names for names of signals, each once: q1'' is q1_dd."""
    used: dict[str, int] = {}
    chosen = []
    for name in names:
        one = _identifier(name)
        used[one] = used.get(one, 0) + 1
        chosen.append(one if used[one] == 1 else f"{one}_{used[one]}")
    return chosen


def check_name(name: str) -> None:
    """Raise for a name that C does not take as a prefix."""
    if re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII) and name not in _WORDS | _FILES and len(name) <= _LONGEST:
        return
    offer = default_name(name)
    raise InvalidName(
        f"'{name}' cannot be the name of a controller in C: expected at most {_LONGEST} letters, digits and underscores, a letter "
        f"first, and no word of C or of the files beside it. Did you mean '{offer}'?"
    )


def default_name(text: str) -> str:
    """Return a C name made of a text."""
    name = re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_").lower()[:_LONGEST].rstrip("_")
    return name if re.match(r"[a-z]", name) and name not in _WORDS | _FILES else f"c_{name}"[:_LONGEST].rstrip("_")


def in_comment(text: str) -> str:
    """Return a text of a problem file as a comment of C may have it: one line that neither ends the comment nor begins another."""
    return " ".join(text.replace("*/", "* /").replace("/*", "/ *").split())


def literal(value: float) -> str:
    """Return a number with all its digits, in the form that `driver.of_type` recognises."""
    return f"{float(np.clip(value, -1.7e308, 1.7e308)):.16e}"


def _identifier(name: str) -> str:
    base = name.rstrip("'")
    primes = len(name) - len(base)
    text = re.sub(r"\W", "_", base, flags=re.ASCII) + ("_" + "d" * primes if primes else "")
    return f"_{text}" if not re.match(r"[A-Za-z_]", text) or text in _WORDS else text


_TUNED = re.compile(r"^#if [^\n]*\n#pragma GCC optimize[^\n]*\n#endif\n", re.MULTILINE)
_ENTRY = re.compile(r"\A#define ENTRY (\w+)\n")
_FUNCTION = re.compile(
    r"^(?:CASADI_SYMBOL_EXPORT )?((?:const )?(?:int|void|char|casadi_\w+)\*? (\w+)\([^;{\n]*\{)", re.MULTILINE
)
_NUMBER = re.compile(r"(?<![\w.)])(\d+\.\d*(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+)(?![\w.])")
_UNUSED = (
    f'#pragma GCC diagnostic ignored "-Wunused-{what}"\n' for what in ("function", "parameter", "const-variable")
)
_HEAD = f"#define PORTABLE\n#ifdef __GNUC__ /* what a step does not need the compiler leaves out */\n{''.join(_UNUSED)}#endif\n"


def portable(text: str) -> str:
    """Return a C text for every compiler of C99, with one function that other files see: the entry of a driver, or NAME_raw.

    Constants have the type of all numbers, so that float is not computed in double. What is computed stays as it is.
    """
    entry = _ENTRY.match(text)
    visible = re.compile(re.escape(entry[1]) if entry else r"\w+_raw")
    text = _TUNED.sub("", re.sub(r"\bENTRY\b", entry[1], text[entry.end() :]) if entry else text)
    text = _FUNCTION.sub(lambda m: m[1] if visible.fullmatch(m[2]) else f"static {m[1]}", text)
    lines = (line if "OF_TYPE" in line else _NUMBER.sub(r"(casadi_real)\1", line) for line in text.splitlines(True))
    return _HEAD + "".join(lines)


@dataclass(frozen=True)
class Target:
    """A kind of place where a controller runs."""

    name: str  # word after --to
    files: Callable[[Device], Mapping[str, str | bytes]]  # contents of all files by name


@cache
def targets() -> dict[str, Target]:
    """Return all targets by name."""
    members = [target for module in within("fpirhc.export") for target in getattr(module, "TARGETS", ())]
    return {target.name: target for target in sorted(members, key=lambda one: one.name)}


def device_of(
    problem: Problem, controller: Controller, title: str, *, name: str | None = None, **of_stepper: Any
) -> Device:
    """Return a controller for a device, of arguments of a `Stepper`; `name` is the prefix in C, None: made of the title."""
    whole = f"{problem.name} {title}"
    chosen = default_name(whole) if name is None else name
    check_name(chosen)
    try:
        # A solver without a bound of its time is refused below, for what it is.
        stepper = Stepper(problem, controller, bounded=False, **of_stepper)
        device = Device(chosen, in_comment(whole), problem, controller, stepper)
        _ = device.sources, stepper.bounds()
    except NotSupported as error:
        raise NotSupported(f"'{title}' cannot be exported: {error}{_instead(controller)}") from None
    return device


def write(device: Device, target: Target, folder: Path) -> list[Path]:
    """Write the files of a target into a new or empty folder, and return their paths."""
    with writing(folder, "--out"):
        taken = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
        contents = {} if taken else target.files(device)
        for name, content in contents.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    if taken:
        raise OutputError(f"'{folder}' is not an empty folder; nothing in it is replaced; choose another with --out")
    return [folder / name for name in contents]


def _instead(controller: Controller) -> str:
    """What to use in place of an optimiser that needs a library; empty for a controller without one."""
    optimiser = None if controller.planner is None else type(controller.planner.optimiser).__name__
    if optimiser in (None, "FixedPointSolver"):
        return ""
    return f". In place of {optimiser} use FixedPointSolver(iterations=1, tolerance=...), which is C of its own"


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
    own, machine = find_compiler(), platform.machine().lower()
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
