"""What every target knows of a controller that leaves Python: its C, the C names of its numbers, and how large all of it is.

The C is that of `Stepper.function`; no target computes anything of the controller anew.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.controllers.contract import Controller
from fpirhc.controllers.reference_states import given_signals
from fpirhc.errors import InvalidName
from fpirhc.problem_files.settings import unit_of_setting
from fpirhc.simulation.stepper import Stepper
from fpirhc.symbolic.layout import Layout
from fpirhc.symbolic.open import PREFIX
from fpirhc.symbolic.program import generate
from fpirhc.task.problem import Problem

_RAW = "fpirhc_native"  # name of the generated function, before it has its own
_INSIDE = re.compile(r"if \((casadi_f\d+)\(arg1, res1, iw, w, 0\)\) return 1;")  # the call of scalar code
_DRIVER = re.compile(r"\bfpirhc_(\w+_driver)\b")
_C_WORDS = frozenset(
    re.findall(
        r"\w+",
        """auto break case char const continue default do double else enum extern float for goto if inline int long register
        restrict return short signed sizeof static struct switch typedef union unsigned void volatile while _Bool _Complex
        _Imaginary main asm typeof class new delete this template namespace private public protected virtual operator bool
        true false""",
    )
)
# Files beside the controller's own, headers of C whose place it would take, and targets that CMake and make have
_FILES = frozenset(
    re.findall(
        r"\w+",
        """example replay samples layout sizes controller all install clean help package test
        assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdarg stdbool stddef stdint stdio
        stdlib string tgmath time wchar wctype""",
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
    cycles: int  # number of cycles that are recorded for a replay

    @cached_property
    def inputs(self) -> Layout:
        """What a step is given: the time and the sample."""
        stays = {*self.data.names, *self.settings.names}
        return self._read(lambda name: name not in stays)

    @cached_property
    def settings(self) -> Layout:
        """Live settings, with their units as far as they are known, and what follows from them."""
        own = self._read(lambda name: name.startswith(PREFIX)).signals
        units = {s.name: unit_of_setting(s.name.removeprefix(PREFIX), self.problem) for s in own}
        return Layout(tuple(replace(s, units=(units[s.name],) * s.size) for s in own))

    @cached_property
    def data(self) -> Layout:
        """What stays until somebody changes it: parameters and set-points."""
        stays = {"parameters", *(signal.name for signal in given_signals(self.problem))}
        return self._read(lambda name: name in stays)

    @cached_property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Intervals of the live settings, by path."""
        return dict(self.stepper.bounds())

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

    def _read(self, wanted: Callable[[str], bool]) -> Layout:
        return Layout(tuple(s for s in self.stepper.reads.signals if wanted(s.name)))


def c_of(function: ca.Function, name: str) -> tuple[tuple[str, ...], dict[str, int]]:
    """Return the C files of a Function, whose name in C is NAME_raw, and the sizes of its work: arg, res, iw, w.

    Who calls it passes rows for all that it reads and writes.
    """
    texts, files = generate(function), []
    sizes = {key: max(1, int(size)) for key, size in re.findall(r"\*sz_(\w+) = (\d+);", texts[0])}
    text, sizes["w"] = _without_wrapper(texts[0], sizes["w"])
    texts = (text, *texts[1:])
    for text in texts:
        entry = re.match(r"#define ENTRY (\w+)\n", text)
        visible = entry[1] if entry else _RAW
        own = portable(re.sub(r"\bENTRY\b", visible, text[entry.end() :]) if entry else text, visible)
        files.append(_DRIVER.sub(rf"{name}_\1", re.sub(rf"\b{_RAW}\b", f"{name}_raw", own)))
    return tuple(files), sizes


def _without_wrapper(text: str, work: int) -> tuple[str, int]:
    """The C without the copies around the call that its outermost function is, and the work of what is called.

    Results are written where the caller wants them, which is not where the arguments are.
    """
    outer = text[text.index("static int casadi_f0(") :]
    called = _INSIDE.findall(outer)
    if len(called) != 1:
        return text, work
    own = [int(place) for place in re.findall(r"=w\+(\d+)", outer)]
    return text.replace("return casadi_f0(", f"return {called[0]}("), max(1, min([work, *own]))


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
    if re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII) and name not in _C_WORDS | _FILES and len(name) <= _LONGEST:
        return
    offer = default_name(name)
    raise InvalidName(
        f"'{name}' cannot be the name of a controller in C: expected at most {_LONGEST} letters, digits and underscores, a letter "
        f"first, and no word of C or of the files beside it. Did you mean '{offer}'?"
    )


def default_name(text: str) -> str:
    """Return a C name made of a text."""
    name = re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_").lower()[:_LONGEST].rstrip("_")
    return name if re.match(r"[a-z]", name) and name not in _C_WORDS | _FILES else f"c_{name}"[:_LONGEST].rstrip("_")


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
    return f"_{text}" if not re.match(r"[A-Za-z_]", text) or text in _C_WORDS else text


_PORTABLE = re.compile(
    r"^#ifdef PORTABLE\n(.*?)^#else /\* PORTABLE \*/\n.*?^#endif /\* PORTABLE \*/\n", re.MULTILINE | re.DOTALL
)
_TUNED = re.compile(r"^#if [^\n]*\n#pragma GCC optimize[^\n]*\n#endif\n", re.MULTILINE)
_PREFIXES = re.compile(r"^/\* How to prefix internal symbols \*/\n.*?^#endif\n", re.MULTILINE | re.DOTALL)
_PREFIXED = re.compile(
    r"^(/\* Add prefix to internal symbols \*/|#define casadi_\w+ CASADI_PREFIX\(\w+\))\n", re.MULTILINE
)
_VISIBILITY = re.compile(
    r"^/\* Symbol visibility in DLLs \*/\n#ifndef CASADI_SYMBOL_EXPORT\n.*?^#endif\n", re.MULTILINE | re.DOTALL
)
_EXPORTED = re.compile(r"^CASADI_SYMBOL_EXPORT ", re.MULTILINE)
_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
_WORD = re.compile(r"[A-Za-z_]\w*")
_FUNCTION = re.compile(r"\A([^{;=]*?\b(\w+)\s*\(([^{}]*)\)\s*)\{", re.DOTALL)
_TABLE = re.compile(r"\A[^{;=(]*?\b(\w+)\s*(?:\[[^=]*)?=", re.DOTALL)
_NUMBER = re.compile(r"(?<![\w.)])(\d+\.\d*(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+)(?![\w.])")
_MACRO = re.compile(r"\A#define (\w+)(.*)", re.DOTALL)


@dataclass(frozen=True)
class _Part:
    """One definition with the comment before it: its text, its name, empty where it has none, and whether others may call it."""

    text: str
    name: str = ""
    visible: bool = False

    @property
    def words(self) -> set[str]:
        return set(_WORD.findall(_COMMENT.sub(" ", self.text)))


def portable(text: str, visible: str) -> str:
    """Return a C text with what its function `visible` needs, for every compiler of C99.

    What the function does not reach is left out, parameters that a function does not read are named as unread, and alternatives
    for wide registers go. Constants have the type of all numbers, so that float is not computed in double. What is computed stays
    as it is.
    """
    text = _TUNED.sub("", _PORTABLE.sub(r"\1", text))
    for prologue in (_PREFIXES, _PREFIXED, _VISIBILITY):
        text = prologue.sub("", text)
    parts = list(_parts(_EXPORTED.sub("", text), visible))
    needed = _reached(parts)
    body = "".join(_static(part) for part in parts if not part.name or part.name in needed)
    typed = "".join(
        line if "OF_TYPE" in line else _NUMBER.sub(r"(casadi_real)\1", line) for line in body.splitlines(True)
    )
    return re.sub(r"\n{3,}", "\n\n", typed).lstrip("\n")


def _reached(parts: list[_Part]) -> set[str]:
    """Names of the definitions that are needed, from what is visible or has no name."""
    words = dict[str, set[str]]()
    for part in parts:
        words[part.name] = words.get(part.name, set()) | part.words
    needed, waiting = set[str](), [one for part in parts if part.visible or not part.name for one in part.words]
    while waiting:
        name = waiting.pop()
        if name in words and name not in needed:
            needed.add(name)
            waiting.extend(words[name])
    return needed


def _parts(text: str, visible: str) -> Iterator[_Part]:
    """Split a text into definitions; lines of the preprocessor are parts of their own."""
    lines, comment = iter(text.splitlines(keepends=True)), ""
    for line in lines:
        if line.lstrip().startswith("#"):
            line = line.lstrip()
            while line.endswith("\\\n"):
                line += next(lines)
            macro = _MACRO.match(line)
            yield _Part(comment + line, macro[1] if macro else "")
            comment = ""
        elif line.startswith("/*"):
            while "*/" not in line:
                line += next(lines)
            comment = line
        elif line.strip():
            yield _part(comment, _whole(line, lines), visible)
            comment = ""
        else:
            yield _Part(comment + line)
            comment = ""


def _whole(line: str, lines: Iterator[str]) -> str:
    """A definition from its first line on: its braces are closed, and it ends with one or with a semicolon."""
    taken, depth = [line], 0
    while True:
        while taken[-1].count("/*") > taken[-1].count("*/"):
            taken[-1] += next(lines)
        code = _COMMENT.sub(" ", taken[-1])
        depth += code.count("{") - code.count("}")
        if depth == 0 and code.rstrip().endswith((";", "}")):
            return "".join(taken)
        taken.append(next(lines))


def _part(comment: str, text: str, visible: str) -> _Part:
    if text.startswith("typedef"):
        return _Part(comment + text)
    function = _FUNCTION.match(text)
    if function:
        return _Part(comment + _read(text, function), function[2], function[2] == visible)
    table = _TABLE.match(text)
    return _Part(comment + text, table[1] if table else "")


def _read(text: str, function: re.Match[str]) -> str:
    """The function with its unread parameters named as such."""
    head, body = text[: function.end()], text[function.end() :]
    declared = [_WORD.findall(one) for one in function[3].split(",")]  # a lone word is 'void', or a macro
    read = _WORD.findall(_COMMENT.sub(" ", body))
    unread = [f"(void){words[-1]};" for words in declared if len(words) > 1 and words[-1] not in read]
    return f"{head} {' '.join(unread)}{body}" if unread else text


def _static(part: _Part) -> str:
    """The definition, hidden from other files where it is not the visible one."""
    if part.visible or not part.name or re.search(r"^(#define|static|INLINE|APART)\b", part.text, re.MULTILINE):
        return part.text
    return re.sub(r"^(?=\w)", "static ", part.text, count=1, flags=re.MULTILINE)
