"""Generated scalar code, written shorter for processors that compute numbers by calls.

CasADi writes a choice as (c ? x : 0) + (!c ? y : 0), a comparison as a number, and NaN as asin(2). Here a choice is one expression,
a comparison is a byte, and every value is computed just before it is needed, an elementary function only where a choice takes what
follows from it. Values that are taken stay as they are, except that a chosen -0 is no longer +0.
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
_TWICE, _ARCSINE = re.compile(r"\(2\.\*(v\d+)\)\Z"), re.compile(r"asin\((v\d+)\)\Z")
_NO_NUMBER = re.compile(r"\((v\d+)\?NAN:0\)\Z")
_BOTH = re.compile(r"casadi_f(min|max)\((v\d+),(v\d+)\)\Z")
_WHOLE_CHOICE = re.compile(r"\((v\d+)\?(\w+):(\w+)\)\Z")
_ELEMENTARY = re.compile(r"(?:exp|log|pow|sin|cos|tan|tanh|atanh|asin|acos|atan|sinh|cosh)\(")
_Way = tuple[tuple[str, bool], ...]  # flags, outermost first, and what they are where a value is taken


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
        flags: names of the values that are 0 or 1.
    """

    values: dict[str, str] = field(default_factory=dict)
    flags: set[str] = field(default_factory=set)
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
                value = self._without_numbers(self._chosen(_OLD.sub(lambda one: now[one[0]], assigned[2])))
                self.values[name] = value
                chosen = _CHOICE.match(value)
                if _FLAG.match(value) or (chosen and {chosen[1], chosen[2]} <= self.flags | {"0"}):
                    self.flags.add(name)
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

    def _without_numbers(self, value: str) -> str:
        """What flags decide as a choice or as a flag, where it is written as arithmetic."""
        arcsine, both, sum_ = _ARCSINE.match(value), _BOTH.match(value), _SUM.match(value)
        twice = _TWICE.match(self.values[arcsine[1]]) if arcsine else None
        if twice and twice[1] in self.flags:
            return f"({twice[1]}?NAN:0)"
        if both and {both[2], both[3]} <= self.flags:
            return f"({both[2]}{'&&' if both[1] == 'min' else '||'}{both[3]})"
        for one, other in (sum_.groups(), sum_.groups()[::-1]) if sum_ else ():
            none = _NO_NUMBER.match(self.values[one])
            if none:
                return f"({none[1]}?NAN:{other})"
        return value

    def _ways(self) -> dict[str, _Way]:
        """For every value the choices behind which alone it is taken."""
        ways: dict[str, _Way] = {name: () for _, name in self.stored}
        for name, value in reversed(self.values.items()):
            if name not in ways:
                continue  # nobody takes it
            way, choice = ways[name], _WHOLE_CHOICE.match(value)
            for one in _NEW.findall(value):
                apart = choice is not None and choice[2] != choice[3] and one != choice[1]
                side = {choice[2]: True, choice[3]: False}.get(one) if choice and apart else None
                here = (*way, (choice[1], side)) if choice and side is not None else way
                ways[one] = _shared(ways[one], here) if one in ways else here
        return ways

    def _where_taken(self) -> None:
        """Compute elementary functions where they are taken, 0 elsewhere, as far as it is known before."""
        for name, way in self._ways().items():
            known = [("" if yes else "!") + flag for flag, yes in way if int(flag[1:]) < int(name[1:])]
            if known and _ELEMENTARY.match(self.values[name]):
                self.values[name] = f"({'&&'.join(dict.fromkeys(known))}?{self.values[name]}:0)"

    def text(self) -> str:
        """The lines, the results first that need the least that is not yet computed: few values then wait at a time."""
        self._where_taken()
        flags, lines = self.flags, list[str]()
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


def _shared(one: _Way, other: _Way) -> _Way:
    """The choices with which both ways begin."""
    same = [a == b for a, b in zip(one, other, strict=False)]
    return one[: same.index(False) if False in same else len(same)]
