"""Generated scalar code, written shorter for processors that compute numbers by calls.

CasADi writes a choice as (c ? x : 0) + (!c ? y : 0), and a comparison as a number. Here a choice is one expression, a comparison is
a byte, and every value is computed just before it is needed. Values stay as they are, except that a chosen -0 is no longer +0.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

_BODY = re.compile(
    r"(^static int \w+\([^{]*\{[^\n]*\n)((?:  casadi_real a\d[^;]*;\n)+)((?:  (?:a\d+=|if \(res\[)[^\n]*;\n)+)(?=  return 0;\n\})",
    re.MULTILINE,
)
_LINE = re.compile(r"  (a\d+)=(.*);\Z")
_STORED = re.compile(r"  if \(res\[(\d+)\]!=0\) res\[\1\]\[(\d+)\]=(a\d+);\Z")
_READ = re.compile(r"arg\[(\d+)\]\? arg\[\1\]\[(\d+)\] : 0\Z")
_OLD, _NEW = re.compile(r"\ba\d+\b"), re.compile(r"\bv\d+\b")
_FLAG = re.compile(r"\((?:!\w+|\w+(?:<=|<|==|!=|&&|\|\|)\w+)\)\Z")
_NOT = re.compile(r"\(!(v\d+)\)\Z")
_HALF = re.compile(r"\((v\d+)\?(v\d+):0\)\Z")
_CHOICE = re.compile(r"\(v\d+\?(v\d+):(0|v\d+)\)\Z")
_SUM = re.compile(r"\((v\d+)\+(v\d+)\)\Z")


def condensed(text: str) -> str:
    """Return the C text of a step with its functions of straight lines condensed.

    Args:
        text: generated C, whose caller passes rows for all that is read and written, and none for both.
    """
    return _BODY.sub(lambda found: found[1] + _Lines().read(found[3].splitlines()).text(), text)


@dataclass
class _Lines:
    """Values of a function by name, each written once, and what is stored of them.

    Attributes:
        values: expressions by name, in the order in which they are computed.
        rows: where a value is read, by name.
        stored: (place, name).
    """

    values: dict[str, str] = field(default_factory=dict)
    rows: dict[str, str] = field(default_factory=dict)
    stored: list[tuple[str, str]] = field(default_factory=list)

    def read(self, lines: Sequence[str]) -> _Lines:
        """Take the lines in; return itself."""
        now = dict[str, str]()
        for line in lines:
            stored, assigned = _STORED.match(line), _LINE.match(line)
            if stored:
                self.stored.append((f"res{stored[1]}[{stored[2]}]", now[stored[3]]))
            elif assigned:
                name, read = f"v{len(self.values)}", _READ.match(assigned[2])
                self.values[name] = self._chosen(_OLD.sub(lambda one: now[one[0]], assigned[2]))
                if read:
                    self.rows[name] = f"arg{read[1]}[{read[2]}]"
                now[assigned[1]] = name
        return self

    def _chosen(self, value: str) -> str:
        """A sum of the two halves of a choice as one expression; others as they are."""
        both = _SUM.match(value)
        halves = [_HALF.match(self.values[name]) for name in both.groups()] if both else []
        for first, second in zip(halves, reversed(halves), strict=True):
            opposite = _NOT.match(self.values[second[1]]) if first and second else None
            if first and second and opposite and opposite[1] == first[1]:
                return f"({first[1]}?{first[2]}:{second[2]})"
        return value

    def text(self) -> str:
        """The lines, the results first that need the least that is not yet computed: few values then wait at a time."""
        flags, lines = self._flags(), list[str]()
        left = [(place, name, self._needed(name)) for place, name in self.stored]
        while left:
            place, name, missing = left.pop(min(range(len(left)), key=lambda k: len(left[k][2])))
            for one in sorted(missing, key=lambda value: int(value[1:])):
                kind = "signed char" if one in flags else "casadi_real"
                lines.append(f"const {kind} {one} = {self._with_rows(self.values[one])};")
            lines.append(f"{place} = {self._with_rows(name)};")
            for other in left:
                other[2].difference_update(missing)
        words = sorted(set(re.findall(r"\b(?:arg|res)\d+\b", " ".join(lines))))
        heads = [f"{'const ' * (w[:3] == 'arg')}casadi_real* {w} = {w[:3]}[{w[3:]}];" for w in words]
        return "".join(f"  {line}\n" for line in (*heads, *lines))

    def _needed(self, name: str) -> set[str]:
        """The values that a value needs, with itself."""
        needed, waiting = set[str](), [name]
        while waiting:
            one = waiting.pop()
            if one not in needed and one not in self.rows:
                needed.add(one)
                waiting += _NEW.findall(self.values[one])
        return needed

    def _with_rows(self, value: str) -> str:
        return _NEW.sub(lambda one: self.rows.get(one[0], one[0]), value)

    def _flags(self) -> set[str]:
        """Names of the values that are 0 or 1."""
        flags = set[str]()
        for name, value in self.values.items():
            chosen = _CHOICE.match(value)
            if _FLAG.match(value) or (chosen and {chosen[1], chosen[2]} <= flags | {"0"}):
                flags.add(name)
        return flags
