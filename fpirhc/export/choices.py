"""Values of generated scalar code, each once and in its shortest form: what flags decide is a flag; and what is read together."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence

POINTER, FLAG, NUMBER = "const casadi_real*", "const signed char", "const casadi_real"  # types of variables
ROW = re.compile(r"(\w+)\[(\d+)\]\Z")
DIGITS = re.compile(r"-?(?:\d+\.\d*|\d+)(?:[eE][+-]?\d+)?\Z")
CHOICE, NOT, AND, OR, SUM = "({}?{}:{})", "(!{})", "({}&&{})", "({}||{})", "({}+{})"
COMPARED = {"({}<{})": float.__lt__, "({}<={})": float.__le__, "({}=={})": float.__eq__, "({}!={})": float.__ne__}
BOUNDED = "BOUNDED({})"  # whether a number is finite
EVERY = "every:"  # whether all are, before the text that says it of their sum
_FLAGS = (*COMPARED, NOT, AND, OR, BOUNDED)
_MAGNITUDE, _LARGEST = "casadi_fabs({})", "(1.0 * FINITE)"
_SMALL = 100  # whole numbers below it are kept in a byte


class Graph:
    """Values, each once: the text of an operation with gaps for its operands."""

    def __init__(self) -> None:
        self.templates: list[str] = []
        self.operands: list[tuple[int, ...]] = []
        self._known: dict[tuple[str, tuple[int, ...]], int] = {}
        self.zero, self.one = self.leaf("0"), self.leaf("1")

    def leaf(self, text: str) -> int:
        """A number or a place."""
        return self._kept(text, ())

    def _kept(self, template: str, operands: tuple[int, ...]) -> int:
        key = template, operands
        if key not in self._known:
            self._known[key] = len(self.templates)
            self.templates.append(template)
            self.operands.append(operands)
        return self._known[key]

    def parts(self, node: int, template: str) -> tuple[int, ...]:
        """The operands of a node of this template; none of another one."""
        return self.operands[node] if self.templates[node] == template else ()

    def number(self, node: int) -> float | None:
        """The value of a constant; None of what is none, or a multiple of the largest number."""
        text = self.templates[node]
        return float(text) if not self.operands[node] and DIGITS.match(text) else None

    def is_constant(self, node: int) -> bool:
        """Whether it is a number."""
        return not self.operands[node] and not ROW.match(self.templates[node])

    def is_flag(self, node: int) -> bool:
        """Whether it is 0 or 1."""
        template = self.templates[node]
        if node in (self.zero, self.one) or template in _FLAGS or template.startswith(EVERY):
            return True
        choice = self.parts(node, CHOICE)
        return bool(choice) and self.is_flag(choice[1]) and self.is_flag(choice[2])

    def node(self, template: str, operands: tuple[int, ...]) -> int:
        """A value, in its shortest form."""
        if not operands:
            number = float(template) if DIGITS.match(template) and template[0] != "-" else None
            return self.zero if number == 0 else self.one if number == 1 else self.leaf(template)
        if template == "({}?{}:0)":
            return self.choice(operands[0], operands[1], self.zero)
        special: dict[str, Callable[..., int]] = {
            NOT: self.opposite,
            AND: self.both,
            OR: self.either,
            SUM: self.sum,
            "casadi_fmin({},{})": self._least,
            "casadi_fmax({},{})": self._most,
            "({}-{})": self._difference,
            "({}*{})": self._product,
            "asin({})": self._arcsine,
        }
        if template in special:
            return special[template](*operands)
        if template in COMPARED:
            return self._compared(template, *operands)
        if template == "(-{})" and self.number(operands[0]) is not None:
            return self.leaf(f"-{self.templates[operands[0]]}".replace("--", ""))
        return self._kept(template, operands)

    def choice(self, flag: int, one: int, other: int) -> int:
        """(flag ? one : other)."""
        turned = self.parts(flag, NOT)
        if turned:
            return self.choice(turned[0], other, one)
        first, second = self.parts(one, CHOICE), self.parts(other, CHOICE)
        one = first[1] if first and first[0] == flag else one
        other = second[2] if second and second[0] == flag else other
        if one == other or flag == self.one:
            return one
        if flag == self.zero:
            return other
        if (one, other) == (self.one, self.zero) and self.is_flag(flag):
            return flag
        if (one, other) == (self.zero, self.one):
            return self.opposite(flag)
        return self._kept(CHOICE, (flag, one, other))

    def opposite(self, flag: int) -> int:
        """!flag."""
        turned = self.parts(flag, NOT)
        if turned and self.is_flag(turned[0]):
            return turned[0]
        if flag in (self.zero, self.one):
            return self.one if flag == self.zero else self.zero
        return self._kept(NOT, (flag,))

    def both(self, one: int, other: int) -> int:
        """Both flags: one && other."""
        if self.zero in (one, other):
            return self.zero
        for a, b in ((one, other), (other, one)):
            if a == self.one and self.is_flag(b):
                return b
        return self._kept(AND, (one, other))

    def either(self, one: int, other: int) -> int:
        """One of the flags: one || other."""
        if self.one in (one, other):
            return self.one
        for a, b in ((one, other), (other, one)):
            if a == self.zero and self.is_flag(b):
                return b
        return self._kept(OR, (one, other))

    def sum(self, one: int, other: int) -> int:
        """The two halves of a choice as one; a flag that is added, and NaN, as a choice."""
        for a, b in ((one, other), (other, one)):
            whole = self._no_number(a, b) or self._of_halves(a, b)
            if whole:
                return whole
            if self.is_flag(b) and b not in (self.zero, self.one) and not self.is_flag(a):
                return self.choice(b, self._kept(SUM, (a, self.one)), a)
        return self._kept(SUM, (one, other))

    def _no_number(self, half: int, value: int) -> int | None:
        """(flag ? NaN : 0) + value, or with the sides exchanged, as a choice."""
        choice = self.parts(half, CHOICE)
        if choice and (self.templates[choice[1]], choice[2]) == ("NAN", self.zero):
            return self.choice(choice[0], choice[1], value)
        if choice and (choice[1], self.templates[choice[2]]) == (self.zero, "NAN"):
            return self.choice(choice[0], value, choice[2])
        return None

    def _of_halves(self, half: int, rest: int) -> int | None:
        """(f ? 0 : x) + (f && e ? y : 0) as one choice, and (f ? x : 0) + (!f && e ? y : 0); e may be missing."""
        first, second = self.parts(half, CHOICE), self.parts(rest, CHOICE)
        if not first or not second or second[2] != self.zero or self.zero not in first[1:]:
            return None
        flag, opened = first[0], first[1] == self.zero
        if opened and second[0] == flag:
            return self.choice(flag, second[1], first[2])
        wanted, flags = flag if opened else self.opposite(flag), self.parts(second[0], AND)
        if wanted not in flags:
            return None
        inner = self.choice(flags[1 - flags.index(wanted)], second[1], self.zero)
        return self.choice(flag, inner, first[2]) if opened else self.choice(flag, first[1], inner)

    def _least(self, one: int, other: int) -> int:
        flags = self.is_flag(one) and self.is_flag(other)
        return self.both(one, other) if flags else self._kept("casadi_fmin({},{})", (one, other))

    def _most(self, one: int, other: int) -> int:
        flags = self.is_flag(one) and self.is_flag(other)
        return self.either(one, other) if flags else self._kept("casadi_fmax({},{})", (one, other))

    def _difference(self, one: int, other: int) -> int:
        if one == self.one and self.is_flag(other):
            return self.opposite(other)
        return self._kept("({}-{})", (one, other))

    def _product(self, one: int, other: int) -> int:
        for a, b in ((one, other), (other, one)):
            if self.number(a) is not None and self.is_flag(b):
                return self.choice(b, a, self.zero)
        return self._kept("({}*{})", (one, other))

    def _arcsine(self, of: int) -> int:
        twice = self.parts(of, "(2.*{})")
        if twice and self.is_flag(twice[0]):
            return self.choice(twice[0], self.leaf("NAN"), self.zero)
        return self._kept("asin({})", (of,))

    def _compared(self, template: str, one: int, other: int) -> int:
        values = self.number(one), self.number(other)
        if values[0] is not None and values[1] is not None:
            return self.one if COMPARED[template](values[0], values[1]) else self.zero
        for k, node in enumerate((one, other)):
            choice = self.parts(node, CHOICE)
            if choice and values[1 - k] is not None and all(self.number(side) is not None for side in choice[1:]):
                pairs = [(side, other) if k == 0 else (one, side) for side in choice[1:]]
                return self.choice(choice[0], *(self._compared(template, *pair) for pair in pairs))
        magnitude = self.parts(one, _MAGNITUDE)
        if template == "({}<={})" and magnitude and self.templates[other] == _LARGEST:
            return self._kept(BOUNDED, magnitude)
        return self._kept(template, (one, other))

    def is_whole(self, node: int) -> bool:
        """Whether it is a choice of small whole numbers, so that a byte holds it."""
        choice = self.parts(node, CHOICE)
        return bool(choice) and all(self.is_whole(side) or self._is_small(side) for side in choice[1:])

    def _is_small(self, node: int) -> bool:
        number = self.number(node)
        return self.is_flag(node) or (number is not None and number == int(number) and abs(number) < _SMALL)

    def kind(self, node: int) -> str:
        """The type of a variable that holds it."""
        if self.templates[node].startswith("({} ? "):
            return POINTER
        return FLAG if self.is_flag(node) or self.is_whole(node) else NUMBER

    def bytes_of(self, node: int) -> int:
        """The bytes of a variable that holds it on the smallest processors."""
        return 1 if self.kind(node).endswith("char") else 4

    def takes(self, node: int, template: str, operands: tuple[int, ...]) -> None:
        """Give a value another form."""
        self.templates[node], self.operands[node] = template, operands


FEW = 3  # values that are taken one by one, and not by a pointer or in a loop
Way = tuple[tuple[int, bool], ...]  # flags, outermost first, and what they are where a value is taken


class Forms:
    """The values of a function in the form in which they are written.

    Args:
        name: of the function.
        graph: its values, some of which take another form.
        stored: its results, (place, value).

    Attributes:
        live: values that a result needs.
        uses: how often each is read.
        inline: those without a line of their own.
        ways: for every value the choices behind which alone it is taken.
    """

    def __init__(self, name: str, graph: Graph, stored: Sequence[tuple[str, int]]) -> None:
        self.graph, self.stored, self._name = graph, list(stored), name
        self._tables: list[str] = []
        self._widest = 0
        self._count()
        self.ways = self._all_ways()
        self._with_pointers()
        self._with_sums()
        self._count()
        self.inline = {node for node in self.live if self._stands_inside(node)}

    @property
    def tables(self) -> str:
        """C text of the constants that pointers point to."""
        none = f"static const casadi_real {self._name}_none[{self._widest}] = {{0}};\n" if self._widest else ""
        return none + "".join(self._tables)

    def _count(self) -> None:
        """Count where values are read, and by what."""
        self.live = self.closure(node for _, node in self.stored)
        pairs = [(one, node) for node in self.live for one in self.graph.operands[node]]
        self.uses = Counter(one for one, _ in pairs)
        self.uses.update(node for _, node in self.stored)
        self._users = dict(pairs)

    def closure(self, nodes: Iterable[int]) -> set[int]:
        """Return values with all that they need."""
        needed, waiting = set[int](), list(nodes)
        while waiting:
            node = waiting.pop()
            if node not in needed:
                needed.add(node)
                waiting += self.graph.operands[node]
        return needed

    def _with_pointers(self) -> None:
        """Read entries of a row that are there or are constants, by one flag, through one pointer."""
        graph = self.graph
        groups: dict[tuple[int, str], dict[int, int]] = {}
        for node in sorted(self.live):
            choice = graph.parts(node, CHOICE)
            row = ROW.match(graph.templates[choice[1]]) if choice else None
            if row and graph.is_constant(choice[2]):
                groups.setdefault((choice[0], row[1]), {})[int(row[2])] = node
        for k, ((flag, array), members) in enumerate(groups.items()):
            if len(members) < FEW:
                continue
            low, width = min(members), max(members) + 1 - min(members)
            values = {place: graph.templates[graph.operands[node][2]] for place, node in members.items()}
            table = f"{self._name}_none"
            if any(value != "0" for value in values.values()):
                table = f"{self._name}_{k}"
                entries = ", ".join(values.get(low + j, "0") for j in range(width))
                self._tables.append(f"static const casadi_real {table}[] = {{{entries}}};\n")
            else:
                self._widest = max(self._widest, width)
            pointer = graph.node(f"({{}} ? {array}+{low} : {table})", (flag,))
            for place, node in members.items():
                graph.takes(node, f"{{}}[{place - low}]", (pointer,))

    def _with_sums(self) -> None:
        """Ask whether numbers are finite by one question for all of them: of their sum, or of each of them."""
        graph = self.graph
        for node in sorted(self.live, reverse=True):
            bounded = graph.parts(node, BOUNDED)
            if bounded:
                template, leaves = self._tree(bounded[0], SUM)
                if len(leaves) >= FEW:
                    graph.takes(node, f"{EVERY}(casadi_fabs({template}) <= FINITE)", leaves)
            elif graph.parts(node, AND) and not self._is_part(node):
                template, leaves = self._tree(node, AND)
                asked = [graph.parts(leaf, BOUNDED) for leaf in leaves]
                if len(leaves) >= FEW and all(asked) and all(self.uses[leaf] == 1 for leaf in leaves):
                    whole = template.format(*["(casadi_fabs({}) <= FINITE)"] * len(leaves))
                    graph.takes(node, f"{EVERY}{whole}", tuple(one[0] for one in asked))

    def _is_part(self, node: int) -> bool:
        """Whether it is one of several that are asked together."""
        return self.uses[node] == 1 and bool(self.graph.parts(self._users.get(node, 0), AND))

    def _tree(self, node: int, template: str) -> tuple[str, tuple[int, ...]]:
        """The text of a tree of one operation, and its leaves."""
        texts, leaves, parts = list[str](), list[int](), self.graph.parts(node, template)
        if not parts:
            return "{}", (node,)
        for one in parts:
            inner = self.graph.parts(one, template)
            text, below = self._tree(one, template) if inner and self.uses[one] == 1 else ("{}", (one,))
            texts.append(text)
            leaves += below
        return template.format(*texts), tuple(leaves)

    def _stands_inside(self, node: int) -> bool:
        """Whether it is written where it is read: a choice, or a question that is not always asked, reads it alone."""
        graph = self.graph
        template = graph.templates[node]
        if re.match(r"\{\}\[\d+\]\Z", template) or not graph.operands[node]:
            return True
        if self.uses[node] != 1 or node not in self._users or graph.kind(node) == POINTER:
            return False
        user = self._users[node]
        if graph.templates[user].startswith(EVERY):
            return False
        return graph.templates[user] in (CHOICE, AND, OR, NOT) or self._stands_inside(user)

    def _all_ways(self) -> dict[int, Way]:
        """For every value the choices behind which alone it is taken."""
        graph = self.graph
        ways: dict[int, Way] = {node: () for _, node in self.stored}
        for node in sorted(self.live, reverse=True):
            way, choice = ways.get(node, ()), graph.parts(node, CHOICE)
            for one in graph.operands[node]:
                side = {choice[1]: True, choice[2]: False}.get(one) if choice and one != choice[0] else None
                here = (*way, (choice[0], side)) if side is not None else way
                ways[one] = _shared(ways[one], here) if one in ways else here
        return ways


def _shared(one: Way, other: Way) -> Way:
    """The choices with which both ways begin."""
    same = [a == b for a, b in zip(one, other, strict=False)]
    return one[: same.index(False) if False in same else len(same)]
