"""Small faults of C texts: one operator, number, condition or statement changed, for scripts/mutation.py.

The text is changed and compiled anew: compiled libraries are kept by their text, so that a changed one never runs an old one.
What is changed compiles: pointers, declarations and sizes of arrays are left alone.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

_SKIPPED = re.compile(  # comments, texts, the preprocessor's lines, attributes
    r"/\*.*?\*/|//[^\n]*|\"[^\"]*\"|^[ \t]*#[^\n]*|__attribute__\(\([^\n]*?\)\)|\brestrict\b", re.DOTALL | re.MULTILINE
)
# Sizes of arrays are constants in capitals, in the line of a type. Generated functions do not read their last argument, and
# never fail.
_SIZES = re.compile(r"\[[A-Z0-9 *+/()]*\]")
_DECLARATION = re.compile(
    r"^\s*(?:static |const |typedef )*(?:In|Out|int|casadi_real|casadi_int|Plan|Search|INLINE)\b.*$", re.MULTILINE
)
_UNREAD = re.compile(
    r"(?<=s->w, )0(?=\))|(?<=scratch\.w, )0(?=\))|(?<=s->w, 0\)\) )return \d|(?<=s->w, 0\)\) )return \d"
)
_OPERATORS = {
    r"(?<=\S) (<=) ": ("<", ">="),
    r"(?<=\S) (>=) ": (">", "<="),
    r"(?<=\S) (<) ": ("<=", ">="),
    r"(?<=\S) (>) ": (">=", "<="),
    r"(?<=\S) (==) ": ("!=",),
    r"(?<=\S) (!=) ": ("==",),
    r"(?<=\S) (&&) ": ("||",),
    r"(?<=\S) (\|\|) ": ("&&",),
    r"(?<=\S) (\+) ": ("-",),
    r"(?<=\S) (-) ": ("+",),
    r"(?<=\S) (\*) ": ("/",),
    r"(?<=\S) (/) ": ("*",),
    r"(?<=\S) (\+=) ": ("-=", "="),
    r"(?<=\S) (-=) ": ("+=",),
    r"(?<=\S) (\*=) ": ("/=",),
    r"(?<=\S) (&=) ": ("=", "|="),
    r"(?<=\S) (\|=) ": ("=", "&="),
    r"[(&|=?:,] ?(!)\w": ("",),
    r"(?<=[=(,?:] )(-)[a-z]": ("",),
}
_NUMBER = re.compile(r"(?<![\w.\[])(\d+\.?\d*(?:e-?\d+)?)(?![\w.\]])")
_CONDITION = re.compile(r"\b(?:if|while) \(")
_STATEMENT = re.compile(
    r"^([ \t]*)((?:\*?[a-z]\w*(?:->|\.)?[\w>.\[\] +*()%-]*?) [-+*/&|]?= [^;{}]*;)[ \t]*$", re.MULTILINE
)
_TYPES = re.compile(r"^(?:In|Out|int|casadi_\w+|const|static|struct|Plan|Search|INLINE|typedef|long)\b")


@dataclass(frozen=True)
class TextFault:
    """A piece of a file and what stands in its place.

    Args:
        path: of the file.
        begin: offset of the piece.
        end: offset behind it.
        text: in its place.
    """

    path: Path
    begin: int
    end: int
    text: str

    @property
    def place(self) -> tuple[int, int]:
        """Where it is; faults of one place are alternatives."""
        return self.begin, self.end

    @contextmanager
    def made(self) -> Iterator[tuple[str, str]]:
        """The file with the fault, while the context lasts: its text before and after."""
        before = self.path.read_text(encoding="utf-8")
        after = before[: self.begin] + self.text + before[self.end :]
        self.path.write_text(after, encoding="utf-8")
        try:
            yield before, after
        finally:
            self.path.write_text(before, encoding="utf-8")


def faults(path: Path) -> list[TextFault]:
    """Every fault of a C file, in order."""
    text = path.read_text(encoding="utf-8")
    code = _UNREAD.sub(_blank, _SKIPPED.sub(_blank, text))
    code = _DECLARATION.sub(lambda m: _SIZES.sub(_blank, m.group()), code)
    found = [*_operators(path, code), *_numbers(path, code), *_conditions(path, code), *_statements(path, code)]
    return sorted(set(found), key=lambda f: (f.place, f.text))


def _blank(match: re.Match[str]) -> str:
    """As many spaces, and the ends of lines."""
    return re.sub(r"[^\n]", " ", match.group())


def _operators(path: Path, code: str) -> Iterator[TextFault]:
    for pattern, others in _OPERATORS.items():
        for match in re.finditer(pattern, code):
            for other in others:
                yield TextFault(path, *match.span(1), other)


def _numbers(path: Path, code: str) -> Iterator[TextFault]:
    """A number that is one more, or nothing."""
    for match in _NUMBER.finditer(code):
        number = match.group(1)
        more = str(int(number) + 1) if number.isdigit() else f"({number} + 1)"
        for other in (more, "0" if number != "0" else "2"):
            yield TextFault(path, *match.span(1), other)


def _conditions(path: Path, code: str) -> Iterator[TextFault]:
    """A condition turned round."""
    for match in _CONDITION.finditer(code):
        begin, depth = match.end() - 1, 0
        for end in range(begin, len(code)):
            depth += (code[end] == "(") - (code[end] == ")")
            if depth == 0:
                yield TextFault(path, begin, end + 1, f"(!{code[begin : end + 1]})")
                break


def _statements(path: Path, code: str) -> Iterator[TextFault]:
    """An assignment that is left out."""
    for match in _STATEMENT.finditer(code):
        if not _TYPES.match(match.group(2)):
            yield TextFault(path, *match.span(2), ";")
