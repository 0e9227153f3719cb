"""Generated C as somebody else's compiler and reviewer take it: nothing unused, nothing for one machine, one visible function.

A text is split into its definitions at the outermost level. What the visible function does not reach is left out, parameters that a
function does not read are named as unread, and alternatives for wide registers go. Constants have the type of all numbers, so that
float is not computed in double. What is computed stays as it is.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

_PORTABLE = re.compile(
    r"^#ifdef PORTABLE\n(.*?)^#else /\* PORTABLE \*/\n.*?^#endif /\* PORTABLE \*/\n", re.MULTILINE | re.DOTALL
)
_TUNED = re.compile(
    r"^#if defined\(__GNUC__\) && !defined\(__clang__\)\n#pragma GCC optimize[^\n]*\n#endif\n", re.MULTILINE
)
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

    Args:
        visible: name of the only function that other files call; declarations of other files stay.
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
