"""What of scalar code is read together: rows through one pointer, numbers asked together, values inside of what reads them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence

from fpirhc.export.choices import AND, BOUNDED, CHOICE, EVERY, NOT, OR, POINTER, ROW, SUM, Graph

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
        found, waiting = set[int](), list(nodes)
        while waiting:
            node = waiting.pop()
            if node not in found:
                found.add(node)
                waiting += self.graph.operands[node]
        return found

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
