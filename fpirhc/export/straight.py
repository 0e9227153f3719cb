"""Generated scalar code, written shorter for processors that compute numbers by calls.

CasADi writes a choice as (c ? x : 0) + (!c ? y : 0), a comparison as a number, NaN as asin(2), and every result as a choice of its
own. Here a comparison is a byte, results that follow one flag stand in one branch, what a branch alone needs is computed there, and
a row that is taken or replaced by its start values is read through one pointer. An elementary function is computed where a choice
takes what follows from it. Values that are taken stay as they are, except that a chosen -0 is no longer +0.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile

from fpirhc.export.choices import AND, CHOICE, COMPARED, DIGITS, EVERY, NOT, NUMBER, OR, POINTER, ROW, Forms, Graph, Way

_BODY = re.compile(
    r"(^static int \w+\([^{]*\{[^\n]*\n)((?:  casadi_real a\d[^;]*;\n)+)((?:  (?:a\d+=|if \(res\[)[^\n]*;\n)+)(?=  return 0;\n\})",
    re.MULTILINE,
)
_LINE = re.compile(r"  (a\d+)=(.*);\Z")
_STORED = re.compile(r"  if \(res\[(\d+)\]!=0\) res\[\1\]\[(\d+)\]=(a\d+);\Z")
_READ = re.compile(r"arg\[(\d+)\]\? arg\[\1\]\[(\d+)\] : 0\Z")
_OLD = re.compile(r"\ba\d+\b")
_COPY = re.compile(r"( *)(\w+)\[(\d+)\] = (\w+)\[(\d+)\];\n\Z")
_ELEMENTARY = re.compile(r"(?:exp|log|pow|sin|cos|tan|tanh|atanh|asin|acos|atan|sinh|cosh)\(")
_DIVIDED, _MINUS = "({}/{})", ("({}-{})", "(-{})")
_ORDERED = ("({}<{})", "({}<={})")  # a byte is below 2.5 where it is below 3; none is 2.5
_LARGEST_WHOLE = 126  # some bytes are above it, and some below its opposite
_COSTS = {"/": 2, "*": 1}  # operations that are worth a branch, by what stands between their operands
_Names = dict[int, tuple[str, ...]]  # where a value can be read, the best place first
_Sure = Mapping[int, bool]  # flags, and what they are in a block


def condensed(text: str) -> str:
    """Return the C text of a step with its functions of straight lines condensed.

    `text`: generated C, whose caller passes rows for all that is read and written, and none for both.
    """
    shorter = _BODY.sub(lambda found: _function(found[1], found[3].splitlines()), text)
    return shorter.replace("#include <math.h>\n", "#include <math.h>\n#include <string.h>\n", 1)


def _function(head: str, lines: Sequence[str]) -> str:
    graph, now, stored = Graph(), dict[str, int](), list[tuple[str, int]]()
    for line in lines:
        place, assigned = _STORED.match(line), _LINE.match(line)
        if place:
            stored.append((f"res{place[1]}[{place[2]}]", now[place[3]]))
        elif assigned:
            row = _READ.match(assigned[2])
            operands = tuple(now[name] for name in _OLD.findall(assigned[2]))
            template = _OLD.sub("{}", assigned[2])
            now[assigned[1]] = graph.leaf(f"arg{row[1]}[{row[2]}]") if row else graph.node(template, operands)
    tables, body = _Writer(Forms(head[11 : head.index("(")], graph, stored)).text()
    return f"{_CHECKS}{tables}{head}{body}"


_CHECKS = """#ifndef BOUNDED
#ifdef __AVR__ /* the first byte says it, and numbers are compared by calls */
static signed char every_bounded(const casadi_real* x, unsigned char n) {
  const unsigned char* byte = (const unsigned char*)x + 3;
  do {
    if ((*byte & 0x7f) >= 0x72) return 0;
    byte += 4;
  } while (--n);
  return 1;
}
static inline signed char bounded(casadi_real x) {
  union { casadi_real x; unsigned char bytes[4]; } of = {x};
  return (of.bytes[3] & 0x7f) < 0x72;
}
#define BOUNDED(x) bounded(x)
#define EVERY(bits, numbers) (bits)
#else
#define BOUNDED(x) (casadi_fabs(x) <= FINITE)
#define EVERY(bits, numbers) (numbers)
#endif
#endif
"""


@dataclass
class _Group:
    """Results that follow one flag: (place, value where it is set, value where it is not); None: nothing is written there.

    Attributes:
        flag: that decides.
        stored: the results.
        early: values that are written before, and where; they are replaced where the flag is not set.
    """

    flag: int
    stored: list[tuple[str, int | None, int]] = field(default_factory=list)
    early: list[tuple[str, int]] = field(default_factory=list)

    @property
    def taken(self) -> list[int]:
        """Values where the flag is set."""
        return [one for _, one, _ in self.stored if one is not None]

    @property
    def others(self) -> list[int]:
        """Values where it is not."""
        return [other for _, _, other in self.stored]


class _Writer:
    def __init__(self, forms: Forms) -> None:
        self._forms, self._graph = forms, forms.graph
        self._lines: list[str] = []

    def text(self) -> tuple[str, str]:
        """Tables, and the lines."""
        self._block(self._forms.stored, {}, "  ", {})
        body = "".join(self._lines)
        words = sorted(set(re.findall(r"\b(?:arg|res)\d+\b", body)))
        heads = [f"  {'const ' * (w[:3] == 'arg')}casadi_real* {w} = {w[:3]}[{w[3:]}];\n" for w in words]
        return self._forms.tables, "".join(heads) + _with_copies(body)

    def _known(self, node: int, sure: _Sure) -> int:
        """The side of a choice that a block has made, or the value itself."""
        choice = self._graph.parts(node, CHOICE)
        while choice and choice[0] in sure:
            node = choice[1] if sure[choice[0]] else choice[2]
            choice = self._graph.parts(node, CHOICE)
        return node

    def _needed(self, nodes: Iterable[int], names: _Names, sure: _Sure) -> set[int]:
        """The values with lines of their own that are still missing."""
        return {node for node in self._reached(nodes, names, sure)[0] if node not in self._forms.inline}

    def _reached(self, nodes: Iterable[int], names: _Names, sure: _Sure) -> tuple[set[int], set[int]]:
        """The values that are still missing, and those that are there and read."""
        missing, there, waiting = set[int](), set[int](), list(nodes)
        while waiting:
            node = waiting.pop()
            if names.get(node):
                there.add(node)
            elif self._known(node, sure) != node:
                waiting.append(self._known(node, sure))
            elif node not in missing:
                missing.add(node)
                waiting += self._graph.operands[node]
        return missing, there

    def _block(self, stored: Sequence[tuple[str, int]], names: _Names, indent: str, sure: _Sure) -> None:
        """Write stores, the results first that need the least that is not yet computed: few values then wait at a time."""
        plain, groups = self._grouped(stored, names)
        while plain or groups:
            wants = [self._needed([node], names, sure) for _, node in plain]
            sides = [[self._needed(part, names, sure) for part in ([g.flag], g.taken, g.others)] for g in groups]
            owners = Counter(one for want in wants for one in want)
            owners.update(one for parts in sides for part in parts for one in part)
            outer = [flag | {one for one in yes | no if owners[one] > 1} for flag, yes, no in sides]
            ready = self._ends_others(set().union(*wants, *outer), plain, groups, names, sure)
            if ready:
                self._lines_of(ready, names, indent, sure)
                continue
            costs = [(len(want - {plain[k][1]}), 0, k) for k, want in enumerate(wants)]
            costs += [(len(outer[k]), 1, k) for k, g in enumerate(groups) if not set(g.early) & set(plain)]
            _, is_group, k = min(costs)
            if is_group:
                group = groups.pop(k)
                self._lines_of(outer[k], names, indent, sure)
                later = [n for _, n in plain] + [n for g in groups for n in (g.flag, *g.taken, *g.others)]
                self._branch(group, names, indent, sure, self._reached([*later, *group.others], names, sure)[1])
            else:
                place, node = plain.pop(k)
                self._lines_of(wants[k] - {node}, names, indent, sure)
                self._store(place, node, names, indent, sure)

    def _ends_others(
        self, nodes: Iterable[int], plain: list[tuple[str, int]], groups: list[_Group], names: _Names, sure: _Sure
    ) -> list[int]:
        """A value that needs nothing but what is there, and after which as many bytes of variables are not needed any more."""
        ends = [n for _, n in plain] + [n for g in groups for n in (g.flag, *g.taken, *g.others)]
        missing = self._needed(ends, names, sure)
        reads = {node: self._read_by(node, names, sure) for node in missing}
        readers = Counter(one for several in reads.values() for one in several)
        readers.update(one for end in ends for one in ({end} if names.get(end) else self._read_by(end, names, sure)))
        for node in sorted(set(nodes) & missing):
            if not reads[node] & missing:
                ended = [one for one in reads[node] if readers[one] == 1 and names[one][0][0] == "v"]
                if sum(map(self._graph.bytes_of, ended)) > self._graph.bytes_of(node):
                    return [node]
        return []

    def _read_by(self, node: int, names: _Names, sure: _Sure) -> set[int]:
        """The values with names or lines of their own that a line of this value reads."""
        operands, waiting = set[int](), list(self._graph.operands[self._known(node, sure)])
        while waiting:
            one = waiting.pop()
            if names.get(one):
                operands.add(one)
                continue
            one = self._known(one, sure)
            if one in self._forms.inline and not names.get(one):
                waiting += self._graph.operands[one]
            else:
                operands.add(one)
        return operands

    def _grouped(self, stored: Sequence[tuple[str, int]], names: _Names) -> tuple[list[tuple[str, int]], list[_Group]]:
        """Stores one by one, and those that follow a flag."""
        graph = self._graph
        inside = self._forms.closure(one for _, node in stored for one in graph.operands[node])
        free = [(p, n) for p, n in stored if graph.parts(n, CHOICE) and not names.get(n) and n not in inside]
        often = Counter(graph.operands[node][0] for _, node in free)
        free = [(p, n) for p, n in free if often[graph.operands[n][0]] > 1]
        rest = [one for one in stored if one not in free]
        groups: dict[int, _Group] = {}
        for place, node in free:
            flag, one, other = graph.operands[node]
            groups.setdefault(flag, _Group(flag)).stored.append((place, one, other))
        for group in groups.values():  # what is needed elsewhere too is written at once, and replaced
            nodes = [n for g in groups.values() if g is not group for n in (g.flag, *g.taken, *g.others)]
            needed = self._forms.closure([*nodes, group.flag, *(node for _, node in rest)])
            for k, (place, taken, other) in enumerate(group.stored):
                if taken in needed and graph.operands[taken] and not names.get(taken):
                    group.early.append((place, taken))
                    group.stored[k] = place, None, other
            rest = [*rest, *group.early]
        return sorted(rest, key=lambda one: _numbered(one[0])), list(groups.values())

    def _branch(self, group: _Group, names: _Names, indent: str, sure: _Sure, wanted: set[int]) -> None:
        replaced = {place for place, _ in group.early}
        for node, texts in list(names.items()):
            left = tuple(text for text in texts if text not in replaced)
            if texts and not left and node in wanted:
                self._lines.append(f"{indent}const casadi_real v{node} = {texts[0]};\n")
                left = (f"v{node}",)
            names[node] = left
        flag = self._asked(group.flag, self._read(group.flag, names, sure))
        yes = [(place, one) for place, one, _ in group.stored if one is not None]
        no = [(place, other) for place, _, other in group.stored]
        self._lines.append(f"{indent}if ({flag}) {{\n" if yes else f"{indent}if (!{flag}) {{\n")
        if yes:
            self._block(yes, dict(names), f"{indent}  ", {**sure, group.flag: True})
            self._lines.append(f"{indent}}} else {{\n")
        self._block(no, dict(names), f"{indent}  ", {**sure, group.flag: False})
        self._lines.append(f"{indent}}}\n")

    def _lines_of(self, nodes: Iterable[int], names: _Names, indent: str, sure: _Sure) -> None:
        """Write variables; several in a row that one way alone needs stand in a branch where they are costly."""
        waiting = self._in_order(set(nodes))
        while waiting:
            way = self._known_way(waiting[0], names, sure)
            same = takewhile(lambda node, way=way: way and self._known_way(node, names, sure) == way, waiting)  # type: ignore[misc]
            run = list(same) or waiting[:1]
            numbers = all(self._graph.kind(node) == NUMBER for node in run)
            if way and numbers and sum(_COSTS.get(self._graph.templates[node][3:4], 0) for node in run) > 1:
                self._lines_of_way(run, dict(way), names, indent, sure)
            else:
                run = run[:1]
                self._line(run[0], names, indent, sure)
            del waiting[: len(run)]

    def _line(self, node: int, names: _Names, indent: str, sure: _Sure) -> None:
        kind = self._graph.kind(node)
        name = f"p{node}" if kind.endswith("*") else f"v{node}"
        self._lines.append(f"{indent}{kind} {name} = {self._read(node, names, sure)};\n")
        names[node] = (name,)

    def _lines_of_way(self, members: list[int], way: _Sure, names: _Names, indent: str, sure: _Sure) -> None:
        """Write numbers in a branch; those that are read behind it are 0 where it is not gone."""
        known, graph = {**sure, **way}, self._graph
        behind = [n for n in members if any(n in graph.operands[one] for one in self._forms.live - set(members))]
        condition = "&&".join(("" if yes else "!") + names[flag][0] for flag, yes in way.items())
        self._lines.append(f"{indent}casadi_real {', '.join(f'v{node} = 0' for node in behind)};\n")
        self._lines.append(f"{indent}if ({condition}) {{\n")
        for node in members:
            if node in behind:
                self._lines.append(f"{indent}  v{node} = {self._read(node, names, known)};\n")
                names[node] = (f"v{node}",)
            else:
                self._line(node, names, f"{indent}  ", known)
        self._lines.append(f"{indent}}}\n")

    def _known_way(self, node: int, names: _Names, sure: _Sure) -> Way:
        """The flags behind which alone a value is taken, as far as they are known and not known to be set."""
        return tuple(
            (flag, yes) for flag, yes in self._forms.ways.get(node, ()) if flag not in sure and names.get(flag)
        )

    def _in_order(self, nodes: Iterable[int]) -> list[int]:
        """The values, each behind those that it needs; a pointer stands behind its flag."""
        operands, kind = self._graph.operands, self._graph.kind
        return sorted(nodes, key=lambda node: operands[node][0] + 0.5 if kind(node) == POINTER else node)

    def _store(self, place: str, node: int, names: _Names, indent: str, sure: _Sure) -> None:
        graph = self._graph
        kept = graph.kind(node) == NUMBER
        if graph.operands[node] and not kept and self._forms.uses[node] > 1 and not names.get(node):
            self._lines_of([node], names, indent, sure)
        self._lines.append(f"{indent}{place} = {self._read(node, names, sure)};\n")
        if graph.operands[node] and kept and not (names.get(node) or ("",))[0].startswith("v"):
            names[node] = (place, *names.get(node, ()))

    def _read(self, node: int, names: _Names, sure: _Sure) -> str:
        return names[node][0] if names.get(node) else self._value(self._known(node, sure), names, sure)

    def _asked(self, node: int, text: str) -> str:
        """The text of a truth: a number says whether it is not 0."""
        return f"({text}!=0)" if self._graph.kind(node) == NUMBER else text

    def _value(self, node: int, names: _Names, sure: _Sure) -> str:
        graph = self._graph
        if names.get(node):
            return names[node][0]
        template, operands = graph.templates[node], graph.operands[node]
        texts = [self._read(one, names, sure) for one in operands]
        if template in COMPARED and any(map(graph.is_whole, operands)):
            texts = [_whole(text, template, k) for k, text in enumerate(texts)]
        elif graph.is_whole(node):
            texts = [str(int(float(text))) if DIGITS.match(text) else text for text in texts]
        if template == _DIVIDED:
            texts[0] = texts[0] if NUMBER in map(graph.kind, operands) else f"(casadi_real){texts[0]}"
            texts[1] = "(casadi_real)0" if texts[1] == "0" else texts[1]
        if template in _MINUS:
            texts = [f"({text})" if text.startswith("-") else text for text in texts]
        asked = {AND: 2, OR: 2, NOT: 1, CHOICE: 1}.get(template, 0)
        texts[:asked] = [self._asked(one, text) for one, text in zip(operands, texts[:asked], strict=False)]
        if template.startswith(EVERY):
            return f"EVERY({_bits(texts)}, {template.removeprefix(EVERY).format(*texts)})"
        text = template.format(*texts)
        if node in self._forms.inline or not _ELEMENTARY.match(text):
            return text
        known = [("" if yes else "!") + names[flag][0] for flag, yes in self._known_way(node, names, sure)]
        return f"({'&&'.join(dict.fromkeys(known))}?{text}:0)" if known else text


def _whole(text: str, template: str, k: int) -> str:
    """A number beside a whole one in a comparison, as a whole one where the answers are the same."""
    if not DIGITS.match(text):
        return text
    value = float(text)
    if abs(value) > _LARGEST_WHOLE or (value != int(value) and template not in _ORDERED):
        return text
    up = (template == "({}<{})") == (k == 1)
    return str(int(-(-value // 1) if up else value // 1))


def _bits(texts: Sequence[str]) -> str:
    """The question whether every number is finite, of rows where several of them stand there."""
    rows, single = dict[str, set[int]](), list[str]()
    for text in dict.fromkeys(texts):
        row = ROW.match(text)
        if row:
            rows.setdefault(row[1], set()).add(int(row[2]))
        else:
            single.append(text)
    asked = list[str]()
    for array, places in rows.items():
        for low in sorted(places):
            if low - 1 not in places:
                count = next(n for n in range(1, len(places) + 1) if low + n not in places)
                asked.append(f"every_bounded({array}+{low}, {count})")
    return "&&".join([*asked, *(f"bounded({text})" for text in single)])


def _numbered(place: str) -> tuple[str, int]:
    row = ROW.match(place)
    assert row is not None
    return row[1], int(row[2])


def _with_copies(body: str) -> str:
    """The lines with neighbours that are copied one after the other copied as one."""
    lines = list[str]()
    runs: list[tuple[str, str, int, str, int, int]] = []
    for line in [*body.splitlines(keepends=True), ""]:
        copied = _COPY.match(line)
        here = (copied[1], copied[2], int(copied[3]), copied[4], int(copied[5])) if copied else None
        if here and runs:
            indent, to, k, source, j, count = runs[-1]
            if here == (indent, to, k + count, source, j + count):
                runs[-1] = indent, to, k, source, j, count + 1
                continue
        for indent, to, k, source, j, count in runs:
            if count > 1:
                lines.append(f"{indent}memcpy({to}+{k}, {source}+{j}, {count} * sizeof(casadi_real));\n")
            else:
                lines += [f"{indent}{to}[{k + n}] = {source}[{j + n}];\n" for n in range(count)]
        runs = [(*here, 1)] if here else []
        if not here:
            lines.append(line)
    return "".join(lines)
