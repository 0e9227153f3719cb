"""What a composed Function computes: its values, of which pieces they consist, and the steps that make them.

Blocks are read into the Function that calls them. Splits and joins compute nothing: they are pieces of values.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import casadi as ca

from fpirhc.symbolic.driver import is_driver

_TWO = {
    ca.OP_ADD: "({0}+{1})", ca.OP_SUB: "({0}-{1})", ca.OP_MUL: "({0}*{1})", ca.OP_DIV: "({0}/{1})",
    ca.OP_LT: "({0}<{1})", ca.OP_LE: "({0}<={1})", ca.OP_EQ: "({0}=={1})", ca.OP_NE: "({0}!={1})",
    ca.OP_AND: "({0}&&{1})", ca.OP_OR: "({0}||{1})", ca.OP_IF_ELSE_ZERO: "({0}?{1}:0)",
    ca.OP_FMIN: "fmin({0},{1})", ca.OP_FMAX: "fmax({0},{1})",
}  # fmt: skip
_ONE = {
    ca.OP_ASSIGN: "{0}", ca.OP_NEG: "(-{0})", ca.OP_NOT: "(!{0})", ca.OP_SQ: "({0}*{0})", ca.OP_TWICE: "(2.*{0})",
    ca.OP_INV: "(1./{0})", ca.OP_FABS: "fabs({0})", ca.OP_SQRT: "sqrt({0})",
}  # fmt: skip
_OF_ALL = {
    ca.OP_MMIN: ("fmin({0},{1})", math.inf), ca.OP_MMAX: ("fmax({0},{1})", -math.inf),
    ca.OP_NORMINF: ("fmax({0},fabs({1}))", 0.0),
}  # fmt: skip
_NAMED = ("exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "log1p",
          "expm1", "floor", "ceil", "pow", "atan2", "hypot", "fmod", "copysign", "erf")  # fmt: skip
SCALAR = {
    **_TWO, **_ONE, ca.OP_SIGN: "({0}<0 ? -1 : {0}>0 ? 1 : {0})", ca.OP_CONSTPOW: "pow({0},{1})",
    **{getattr(ca, f"OP_{name.upper()}"): f"{name}({{0}}{',{1}' * (name in ('pow', 'atan2', 'hypot', 'fmod', 'copysign'))})"
       for name in _NAMED},
}  # fmt: skip
_SIDE_BY_SIDE = {
    ca.OP_LT: "truth({0}<{1})", ca.OP_LE: "truth({0}<={1})", ca.OP_EQ: "truth({0}=={1})", ca.OP_NE: "truth({0}!={1})",
    ca.OP_AND: "truth(({0}!=0)&({1}!=0))", ca.OP_OR: "truth(({0}!=0)|({1}!=0))", ca.OP_IF_ELSE_ZERO: "where({0}!=0,{1})",
    ca.OP_NOT: "truth({0}==0)", ca.OP_SIGN: "either({0}<0, ALL(-1), either({0}>0, ALL(1), {0}))",
}  # fmt: skip
_ON_DEVICES = {  # in OpenCL a number of double precision is no condition
    ca.OP_AND: "(({0}!=0)&&({1}!=0))", ca.OP_OR: "(({0}!=0)||({1}!=0))", ca.OP_NOT: "({0}==0)",
    ca.OP_IF_ELSE_ZERO: "({0}!=0?{1}:0.)",
}  # fmt: skip
_ENDS = "(-INFINITY)", "INFINITY"
_MOST = 4000  # instructions of scalar code that is written into its caller
_LONG = 32  # numbers of a part of a choice that gets a place of its own
_SPLITS = (ca.OP_VERTSPLIT, ca.OP_HORZSPLIT)


class Unwritten(Exception):
    """An operation that only CasADi writes."""


class Words(NamedTuple):
    """How operations and constants are written in C."""

    operations: Mapping[int, str]  # by CasADi's number of them; `{0}` and `{1}` are the operands
    side_by_side: bool  # whether a value is a row of numbers, one of each loop, see `lanes.c`

    def constant(self, number: float) -> str:
        """Return a number of an expression."""
        text = f"{number:.16e}" if math.isfinite(number) else "NAN" if math.isnan(number) else _ENDS[number > 0]
        return f"ALL({text})" if self.side_by_side else text

    def entry(self, number: float) -> str:
        """Return a number of a table."""
        return f"ROW({number:.16e})" if self.side_by_side else f"{number:.16e}"


ONE = Words(SCALAR, side_by_side=False)
DEVICE = Words({**SCALAR, **_ON_DEVICES}, side_by_side=False)
SIDE_BY_SIDE = Words({**SCALAR, **_SIDE_BY_SIDE}, side_by_side=True)


class Callee(NamedTuple):
    """How a C function is called: its name, the pointers that it needs in arg and res, its numbers in w, and its kind.

    One that writes all of its results, and asks for no address whether there is one, is `sure`. An argument and a result that are
    `in_place` may lie at one place.
    """

    name: str
    pointers: tuple[int, int]
    room: int
    sure: bool = False
    in_place: tuple[int, int] | None = None


@dataclass(eq=False)
class Node:
    """A row of numbers. `base` and `offset` say where it lies, once that is decided; "=1." is the number itself."""

    size: int
    base: object = ""
    offset: int = 0
    region: Region | None = None

    @property
    def literal(self) -> bool:
        """Whether it is written as a number, and lies nowhere."""
        return isinstance(self.base, str) and self.base[:1] == "="


class Piece(NamedTuple):
    """Some numbers of a node that follow each other."""

    node: Node
    at: int
    size: int


Value: TypeAlias = tuple[Piece, ...]


@dataclass(eq=False)
class Operation(Node):
    """An operation on entries; with `start`, on all entries of one value one after the other, which begins there.

    One that is `fused` is written into the operation that reads it.
    """

    code: str = ""
    operands: tuple[Value, ...] = ()
    start: str = ""
    fused: bool = False

    @property
    def results(self) -> list[Node]:
        """Itself."""
        return [self]

    regions = ()

    @property
    def reads(self) -> Iterator[Value]:
        """Everything that it reads, also by what is written into it."""
        for value in self.operands:
            inner = self.inside(value)
            if inner is None:
                yield value
            else:
                yield from inner.reads

    @staticmethod
    def inside(value: Value) -> Operation | None:
        """Return the operation that is written in place of an operand, where there is one."""
        node = value[0].node
        return node if isinstance(node, Operation) and node.fused and len(value) == 1 else None


@dataclass(eq=False)
class Call:
    """A call of a C function; with `times` above 1, so often along the columns of all arguments that are not the same for all."""

    callee: Callee
    arguments: list[Value]
    results: list[Node]
    times: int = 1
    same: tuple[bool, ...] = ()
    rows: list[Value] = field(default_factory=list)  # the arguments, each in one row
    scalar: ca.Function | None = None  # code that is written in place of the call

    @property
    def regions(self) -> tuple[Region, ...]:
        """None."""
        return ()

    @property
    def reads(self) -> Iterator[Value]:
        """Everything that it reads."""
        yield from self.arguments
        yield from self.rows


@dataclass(eq=False)
class Choice:
    """The first region where a number is not 0, else the second."""

    condition: Value
    regions: tuple[Region, Region]
    results: list[Node]

    @property
    def reads(self) -> Iterator[Value]:
        """What decides."""
        yield self.condition


Step: TypeAlias = Operation | Call | Choice


@dataclass(eq=False)
class Region:
    """Steps in order, and the values with which they end."""

    steps: list[Step] = field(default_factory=list)
    outputs: list[Value] = field(default_factory=list)

    def include(self, other: Region) -> list[Value]:
        """Make the steps of another region its own; return that one's outputs."""
        for step in other.steps:
            for node in step.results:
                node.region = self
        self.steps += other.steps
        return other.outputs


def whole(node: Node) -> Value:
    """Return a node as a value."""
    return (Piece(node, 0, node.size),) if node.size else ()


def joined(pieces: Iterable[Piece]) -> Value:
    """Return pieces as a value; neighbours in one node become one."""
    result: list[Piece] = []
    for piece in pieces:
        last = result[-1] if result else None
        if last and last.node is piece.node and last.at + last.size == piece.at:
            result[-1] = last._replace(size=last.size + piece.size)
        elif piece.size:
            result.append(piece)
    return tuple(result)


def part(value: Value, begin: int, end: int) -> Value:
    """Return the entries from begin to end."""
    result, at = list[Piece](), 0
    for node, start, size in value:
        low, high = max(begin - at, 0), min(end - at, size)
        if low < high:
            result.append(Piece(node, start + low, high - low))
        at += size
    return tuple(result)


def _parted(ends: tuple[Value, Value]) -> list[tuple[Value, Value]]:
    """The two ways of a result, with its longest part by itself: it need not stay where the others are wanted."""
    parts = ((piece.size, length(end[:k])) for end in ends if len(end) > 1 for k, piece in enumerate(end))
    size, begin = max(parts, default=(0, 0))
    cuts = {0, length(ends[0])} | ({begin, begin + size} if size >= _LONG else set())
    return [(part(ends[0], low, high), part(ends[1], low, high)) for low, high in pairwise(sorted(cuts))] or [ends]


def length(value: Value) -> int:
    """Return the number of entries."""
    return sum(piece.size for piece in value)


@dataclass
class Dataflow:
    """What Functions compute."""

    callee: Callable[[ca.Function], Callee]  # returns how a Function is called that is not read into its caller
    # in how many places of the whole program every Function is called, by its hash; see `call_sites`
    sites: Counter[int]
    words: Words  # of the operations
    tables: list[str] = field(default_factory=list)  # C text of constants, without their names

    def region(self, function: ca.Function, inputs: Sequence[Value]) -> Region:
        """Return the steps of a Function, of a choice between two, or of scalar code."""
        region, branches = Region(), branches_of(function)
        if branches is not None:
            region.outputs = self._chosen(region, branches, inputs)
            return region
        if function.is_a("SXFunction"):
            region.outputs = self._scalar(region, function, inputs)
            return region
        values, outputs = dict[int, Value](), [dict[int, Value]() for _ in range(function.n_out())]
        for k in range(function.n_instructions()):
            code, made = function.instruction_id(k), function.instruction_MX(k)
            given, places = function.instruction_input(k), function.instruction_output(k)
            if code == ca.OP_INPUT:
                facts = made.info()
                values[places[0]] = part(inputs[facts["ind"]], facts["offset"], facts["offset"] + made.nnz())
            elif code == ca.OP_OUTPUT:
                facts = made.info()
                outputs[facts["ind"]][facts["offset"]] = values[given[0]]
            elif min(given, default=0) < 0:
                raise Unwritten
            else:
                results = self._results(region, code, made, [values[i] for i in given], len(places))
                values |= {place: result for place, result in zip(places, results, strict=True) if place >= 0}
        for k, parts in enumerate(outputs):
            region.outputs.append(joined(piece for at in sorted(parts) for piece in parts[at]))
            if length(region.outputs[-1]) != function.numel_out(k):
                raise Unwritten
        return region

    def _results(self, region: Region, code: int, made: ca.MX, operands: list[Value], count: int) -> list[Value]:
        if code == ca.OP_CALL:
            return self._called(region, made.which_function(), operands)
        if code in (ca.OP_VERTSPLIT, ca.OP_VERTCAT) and any(made.dep(k).size2() != 1 for k in range(made.n_dep())):
            raise Unwritten
        if code in _SPLITS:
            sizes = [made.get_output(k).nnz() for k in range(count)] if count > 1 else [made.nnz()]
            return [part(operands[0], sum(sizes[:k]), sum(sizes[: k + 1])) for k in range(count)]
        if not made.is_dense():
            raise Unwritten
        if code in _MOVES:
            return [joined(_MOVES[code](made, operands))]
        return [self._computed(region, code, made, operands)]

    def _computed(self, region: Region, code: int, made: ca.MX, operands: list[Value]) -> Value:
        """The value of a constant or of an operation."""
        if not made.nnz():
            return ()
        if code == ca.OP_CONST:
            return whole(self._constant([float(v) for v in made.to_DM().nonzeros()]))
        if code in _OF_ALL:
            text, start = _OF_ALL[code]
            node = Operation(1, code=text, operands=(operands[0],), start=self.words.constant(start))
        elif {length(value) for value in operands} <= {1, made.nnz()} and (code in _TWO or code in _ONE):
            node = Operation(made.nnz(), code=self.words.operations[code], operands=tuple(operands))
        else:
            raise Unwritten
        node.region = region
        region.steps.append(node)
        return whole(node)

    def _constant(self, values: list[float]) -> Node:
        if not all(map(math.isfinite, values)):
            raise Unwritten
        if len(values) == 1:
            return Node(1, f"=({self.words.constant(values[0])})")
        table = f"[{len(values)}] = {{{', '.join(map(self.words.entry, values))}}};"
        if table not in self.tables:
            self.tables.append(table)
        return Node(len(values), f"flat_table_{self.tables.index(table)}")

    def _called(self, region: Region, function: ca.Function, operands: Sequence[Value]) -> list[Value]:
        """The results of a call; a Function that is called in one place is read in there."""
        dense = [function.sparsity_in(k) for k in range(function.n_in())]
        if not all(one.is_dense() for one in (*dense, *map(function.sparsity_out, range(function.n_out())))):
            raise Unwritten
        if self.sites[hash(function)] == 1 and is_graph(function):
            try:
                return region.include(self.region(function, operands))
            except Unwritten:
                pass  # CasADi writes it
        if self.sites[hash(function)] == 1 and is_written(function):
            return self._scalar(region, function, operands)
        branches = branches_of(function)
        if branches is not None and self.sites[hash(function)] == 1:
            return self._chosen(region, branches, operands)
        results = [Node(function.nnz_out(k), region=region) for k in range(function.n_out())]
        region.steps.append(self._call(function, operands, results))
        return [whole(node) for node in results]

    @staticmethod
    def _scalar(region: Region, function: ca.Function, operands: Sequence[Value]) -> list[Value]:
        results = [Node(function.nnz_out(k), region=region) for k in range(function.n_out())]
        region.steps.append(Call(Callee("", (0, 0), 0), list(operands), results, 1, (), list(operands), function))
        return [whole(node) for node in results]

    def _chosen(
        self, region: Region, branches: tuple[ca.Function, ca.Function], operands: Sequence[Value]
    ) -> list[Value]:
        regions = Region(), Region()
        for inner, branch in zip(regions, branches, strict=True):
            inner.outputs = self._called(inner, branch, operands[1:])
        parted = [_parted(ends) for ends in zip(*(inner.outputs for inner in regions), strict=True)]
        for k, inner in enumerate(regions):
            inner.outputs = [ends[k] for parts in parted for ends in parts]
        made = [[Node(length(ends[0]), region=region) for ends in parts] for parts in parted]
        region.steps.append(Choice(operands[0], regions, [node for nodes in made for node in nodes]))
        return [joined(piece for node in nodes for piece in whole(node)) for nodes in made]

    def _call(self, function: ca.Function, operands: Sequence[Value], results: list[Node]) -> Call:
        if function.class_name() != "Map":
            return Call(self.callee(function), list(operands), results, 1, (False,) * len(operands))
        facts = function.info()
        times, arguments, same = facts["n"], list[Value](), list[bool]()
        for value in operands:
            size = length(value) // times
            first = part(value, 0, size)
            same.append(all(part(value, k * size, (k + 1) * size) == first for k in range(1, times)))
            arguments.append(first if same[-1] else value)
        return Call(self.callee(facts["f"]), arguments, results, times, tuple(same))


def is_written(function: ca.Function) -> bool:
    """Return whether a Function is scalar code whose operations are all known here, and short enough for its caller."""
    if not function.is_a("SXFunction") or function.n_instructions() > _MOST:
        return False
    codes = [function.instruction_id(k) for k in range(function.n_instructions())]
    constants = (function.instruction_constant(k) for k, code in enumerate(codes) if code == ca.OP_CONST)
    return {*codes} <= {*SCALAR, ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST} and all(map(math.isfinite, constants))


def is_graph(function: ca.Function) -> bool:
    """Return whether a Function consists of instructions that can be read."""
    return function.is_a("MXFunction") and not is_driver(function.name())


def branches_of(function: ca.Function) -> tuple[ca.Function, ca.Function] | None:
    """Return what a choice calls where its number is not 0, and where it is; None: it is no such choice."""
    if function.class_name() != "Switch":
        return None
    facts = function.info()
    if len(facts["f"]) != 1 or facts["project_in"] or facts["project_out"]:
        return None
    return facts["f_def"], facts["f"][0]


def call_sites(function: ca.Function) -> Counter[int]:
    """Return in how many places of the whole program every Function is called; a loop counts as two."""
    sites, seen, waiting = Counter[int](), set[int](), [function]
    while waiting:
        one = waiting.pop()
        if hash(one) in seen:  # Functions are compared by their wrappers
            continue
        seen.add(hash(one))
        called = list(branches_of(one) or ())
        if one.class_name() == "Map":
            called = [one.info()["f"]] * 2
        elif is_graph(one):
            calls = (k for k in range(one.n_instructions()) if one.instruction_id(k) == ca.OP_CALL)
            called = [one.instruction_MX(k).which_function() for k in calls]
        sites.update(map(hash, called))
        waiting += called
    return sites


def _entries(facts: dict[str, object]) -> Sequence[int]:
    """The places that a selection takes."""
    some, places = facts.get("slice"), facts.get("nz")
    if isinstance(some, dict):
        return range(some["start"], some["stop"], some["step"])
    if not isinstance(places, list) or min(places, default=0) < 0:
        raise Unwritten
    return places


def _pieces(_: ca.MX, operands: list[Value]) -> Iterable[Piece]:
    return (piece for value in operands for piece in value)


def _selected(made: ca.MX, operands: list[Value]) -> Iterable[Piece]:
    return (piece for i in _entries(made.info()) for piece in part(operands[0], i, i + 1))


def _replaced(made: ca.MX, operands: list[Value]) -> Iterable[Piece]:
    """The first operand with the entries of the second in some places."""
    facts = made.info()
    if facts["add"]:
        raise Unwritten
    new = {place: k for k, place in enumerate(_entries(facts))}
    chosen = ((operands[1], new[i]) if i in new else (operands[0], i) for i in range(length(operands[0])))
    return (piece for value, i in chosen for piece in part(value, i, i + 1))


_MOVES: dict[int, Callable[[ca.MX, list[Value]], Iterable[Piece]]] = {
    **dict.fromkeys((ca.OP_VERTCAT, ca.OP_HORZCAT, ca.OP_RESHAPE), _pieces),
    ca.OP_HORZREPMAT: lambda made, operands: operands[0] * (made.nnz() // length(operands[0])),
    ca.OP_GETNONZEROS: _selected,
    ca.OP_SETNONZEROS: _replaced,
}
