"""Where the values of a function lie: in its results, in a row that a call reads, or in its work, which they share over time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from fpirhc.symbolic.dataflow import Call, Choice, Node, Operation, Region, Step, Value, length, whole


@dataclass(eq=False)
class Place:
    """Some numbers in the work of a function, in use from the first step that writes them to the last that reads them."""

    size: int
    first: int | None = None
    last: int = -1
    begin: int = -1

    def use(self, time: int) -> None:
        """Note that a step uses it."""
        self.first = time if self.first is None else min(self.first, time)
        self.last = max(self.last, time)

    def meets(self, other: Place) -> bool:
        """Return whether both are in use at one time."""
        if self.first is None or other.first is None:
            return False
        return self.first <= other.last and other.first <= self.last


class Placement:
    """Decides where everything lies that a region computes.

    Args:
        region: of a function.
        apart: whether the ends of a choice lie apart from its results, which are mixed of both.

    Attributes:
        uses: how often every node is read.
        pointed: results of a choice between values that stay where they are: a pointer tells which one it is.
        callees: where the work of a call begins.
        room: numbers of work in all.
    """

    def __init__(self, region: Region, *, apart: bool = False) -> None:
        self._apart = apart
        self.uses: Counter[Node] = Counter()
        self.pointed: set[Node] = set()
        self.callees: dict[Call, int] = {}
        self._places: list[Place] = []
        self._rooms: dict[Call, Place] = {}
        self._joins: dict[tuple[Region, Value], Node] = {}
        self._readers: dict[Node, list[Step | Region]] = {}
        self._locals, self._time = 0, 0
        self._fuse(region)
        for k, value in enumerate(region.outputs):
            self._claim(value, f"r{k}", 0, region)
        self._settle(region)
        self._measure(region)
        for value in region.outputs:
            self._use(value, self._time)
        self.room = self._arrange()

    def wanted(self, node: Node, call: Call) -> bool:
        """Return whether a call must write this result."""
        return bool(self.uses[node]) or call.callee.sure

    def _fuse(self, region: Region) -> None:
        """Write an operation into the one that reads it, where nothing else does."""
        readers = self._readers
        _note_readers(region, readers)
        self.uses.update({node: len(found) for node, found in readers.items()})
        for node, found in readers.items():
            reader = found[0]
            if isinstance(node, Operation) and not node.start and len(found) == 1 and isinstance(reader, Operation):
                alone = any(value == whole(node) for value in reader.operands)
                node.fused = alone and reader.region is node.region and not reader.start

    def _claim(self, value: Value, base: object, offset: int, region: Region) -> None:
        """Let nodes of the region lie where this value is wanted, if they lie nowhere yet."""
        for node, _, size in value:
            fused = isinstance(node, Operation) and node.fused
            if not node.base and size == node.size and node.region is region and not fused:
                node.base, node.offset = base, offset
            offset += size

    def _settle(self, region: Region) -> None:
        for step in region.steps:
            if isinstance(step, Call) and step.scalar is None:
                self._share(step, region)
                step.rows = [
                    self._row_in_place(value, step, k, region) or self._row(value, region)
                    for k, value in enumerate(step.arguments)
                ]
        for step in region.steps:
            for k, node in enumerate(step.results):
                if not node.base and self._needs_place(step, node) and not self._is_pointer(step, k):
                    node.base = self._own(node.size)
            for inner in step.regions:
                for node, value in zip(step.results, inner.outputs, strict=True):
                    if node not in self.pointed and not self._apart:
                        self._claim(value, node.base, node.offset, inner)
                self._settle(inner)

    def _share(self, step: Call, region: Region) -> None:
        """Let an argument that nothing else reads lie where the result is wanted that the call computes in its place."""
        if step.callee.in_place is not None:
            argument, result = step.callee.in_place
            value, node = step.arguments[argument], step.results[result]
            if node.base and len(value) == 1 and self.uses[value[0].node] == 1 and isinstance(value[0].node, Operation):
                self._claim(value, node.base, node.offset, region)

    def _needs_place(self, step: Step, node: Node) -> bool:
        if isinstance(step, Operation):
            return not step.fused
        return not isinstance(step, Call) or self.wanted(node, step)

    def _is_pointer(self, step: Step, k: int) -> bool:
        """Whether a result is one of two values that stay where they are."""
        if self._apart or not isinstance(step, Choice) or step.results[k].size == 1:
            return False
        ends = [inner.outputs[k] for inner in step.regions]
        if not all(len(end) == 1 and _stays(end[0].node) for end in ends):
            return False
        step.results[k].base = f"p{len(self.pointed)}"
        self.pointed.add(step.results[k])
        return True

    def _row_in_place(self, value: Value, step: Call, argument: int, region: Region) -> Value:
        """A row of several values where the result lies that the call computes in its place; nothing where it may not.

        What is read later, too, does not lie there: the call writes over it.
        """
        if len(value) < 2 or step.callee.in_place is None or step.callee.in_place[0] != argument:
            return ()
        result = step.results[step.callee.in_place[1]]
        if not result.base or (region, value) in self._joins:
            return ()
        row = Node(length(value), result.base, result.offset, region)
        at = row.offset
        for piece in value:
            if self._ends_with(piece.node, step):
                self._claim((piece,), row.base, at, region)
            at += piece.size
        return whole(row)

    def _ends_with(self, node: Node, step: Call) -> bool:
        """Whether nothing reads a node after this call; a fused operation reads where it is written."""
        readers = self._readers[node]
        return readers[-1] is step and not any(isinstance(one, Operation) and one.fused for one in readers)

    def _row(self, value: Value, region: Region) -> Value:
        """The value in one row: a new one where it lies in several, or nowhere."""
        if not value or (len(value) == 1 and not value[0].node.literal):
            return value
        if (region, value) not in self._joins:
            node = Node(length(value), region=region)
            node.base = self._own(node.size)
            self._claim(value, node.base, 0, region)
            self._joins[region, value] = node
        return whole(self._joins[region, value])

    def _own(self, size: int) -> Place | str:
        """A new place, or the address of a variable for one number."""
        if size == 1:
            self._locals += 1
            return f"&v{self._locals}"
        self._places.append(Place(size))
        return self._places[-1]

    def _measure(self, region: Region) -> None:
        """Find when every place is in use."""
        for step in region.steps:
            if isinstance(step, Operation) and step.fused:
                continue
            self._time += 1
            for value in step.reads:
                self._use(value, self._time)
            self._use([piece for node in step.results for piece in whole(node)], self._time)
            if isinstance(step, Call) and step.callee.room:
                self._rooms[step] = Place(step.callee.room, self._time, self._time)
            for inner in step.regions:
                self._measure(inner)
                for node, value in zip(step.results, inner.outputs, strict=True):
                    self._use((*value, *whole(node)), self._time)
        self._time += 1

    @staticmethod
    def _use(value: Sequence[tuple[Node, int, int]], time: int) -> None:
        for node, _, _ in value:
            if isinstance(node.base, Place):
                node.base.use(time)

    def _arrange(self) -> int:
        """Lay the places out, the work of calls among them; return the numbers that they need together."""
        laid: list[Place] = []
        for place in sorted([*self._places, *self._rooms.values()], key=lambda one: -one.size):
            place.begin = 0
            for other in sorted((one for one in laid if one.meets(place)), key=lambda one: one.begin):
                if place.begin + place.size <= other.begin:
                    break
                place.begin = max(place.begin, other.begin + other.size)
            laid.append(place)
        self.callees = {call: place.begin for call, place in self._rooms.items()}
        return max((one.begin + one.size for one in laid if one.first is not None), default=0)


def _note_readers(region: Region, readers: dict[Node, list[Step | Region]]) -> None:
    for step in region.steps:
        for value in step.reads:
            for piece in value:
                readers.setdefault(piece.node, []).append(step)
        for inner in step.regions:
            _note_readers(inner, readers)
    for value in region.outputs:
        for piece in value:
            readers.setdefault(piece.node, []).append(region)


def _stays(node: Node) -> bool:
    """Whether a node is an argument or a table."""
    return node.region is None and not node.literal
