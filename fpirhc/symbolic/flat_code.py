"""Composed Functions as one C function each, in which a value is written once, where it is wanted.

CasADi writes a function for every block and gives all arguments and results places of their own. Operations and their order are
the same here. A Function with an operation that is not known here is left to CasADi.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from itertools import pairwise

import casadi as ca

from fpirhc.symbolic.dataflow import (
    ONE,
    Call,
    Callee,
    Choice,
    Dataflow,
    Node,
    Operation,
    Region,
    Unwritten,
    Value,
    Words,
    branches_of,
    call_sites,
    is_graph,
    is_written,
    length,
    part,
    whole,
)
from fpirhc.symbolic.placement import Place, Placement

_VARIABLE, _ASSIGNED = re.compile(r"\bv\d+\b"), re.compile(r"^ *(v\d+) = [^\n]*\n", re.MULTILINE)
HEAD = "static int {}(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem) {{\n"


_DECLARED = {
    "a": "const casadi_real* {0} = arg[{1}]",
    "r": "casadi_real* {0} = res[{1}]",
    "v": "casadi_real {0}",
    "p": "const casadi_real* {0}",
}


class FlatCode:
    """C functions of a Function and of all that it calls.

    Args:
        outside: returns how a Function is called that is not written here.

    Attributes:
        texts: C functions, callees first.
        tables: C text of constants, without their names.
    """

    def __init__(self, outside: Callable[[ca.Function], Callee], words: Words = ONE) -> None:
        self._outside, self._words = outside, words
        self.texts: list[str] = []
        self.tables: list[str] = []
        self._known: dict[int, Callee] = {}
        self._sites: Counter[int] = Counter()

    def callee(self, function: ca.Function, *, always: bool = False) -> Callee:
        """Return how a Function is called, and write it where it is not written yet; `always` where it is scalar code, too."""
        key = hash(function)
        if not self._sites:
            self._sites = call_sites(function)
        if key not in self._known:
            composed = is_graph(function) or branches_of(function) is not None or (always and is_written(function))
            self._known[key] = self.written(function) if composed else self._outside(function)
        return self._known[key]

    def written(self, function: ca.Function) -> Callee:
        """Write a graph, a choice, or scalar code of known operations."""
        inputs = [Node(function.nnz_in(k), f"a{k}") for k in range(function.n_in())]
        try:
            region = Dataflow(self.callee, self._sites, self._words, self.tables).region(
                function, [whole(node) for node in inputs]
            )
        except Unwritten:
            return self._outside(function)
        name = f"flat_{len(self.texts)}"
        text, room = _Writer(region, self._words).text()
        self.texts.append(f"/* {function.name()} */\n{HEAD.format(name)}{text}")
        return Callee(name, (function.n_in(), function.n_out()), room, sure=True)


class _Writer:
    def __init__(self, region: Region, words: Words) -> None:
        self._region, self._placed, self._words = region, Placement(region, apart=words.side_by_side), words
        self._lines: list[str] = []
        self._filled: set[Node] = set()

    def text(self) -> tuple[str, int]:
        """Return what follows the head, and the numbers that it needs in w."""
        self._write(self._region, "  ")
        for k, value in enumerate(self._region.outputs):
            self._copy(value, Node(length(value), f"r{k}"), "  ")
        body = _read_later("".join(self._lines))
        used = sorted(set(re.findall(r"\b[arvp]\d+\b", body)), key=lambda name: (name[0], int(name[1:])))
        heads = [_DECLARED[name[0]].format(name, name[1:]) for name in used] + ["casadi_int i"] * ("(i=0" in body)
        return "".join([*(f"  {head};\n" for head in heads), body, "  return 0;\n}\n\n"]), self._placed.room

    def _write(self, region: Region, indent: str) -> None:
        for step in region.steps:
            if isinstance(step, Call) and step.scalar is not None:
                self._scalar(step, step.scalar, indent)
            elif isinstance(step, Call):
                self._call(step, indent)
            elif isinstance(step, Choice):
                self._choice(step, indent)
            elif not step.fused and self._placed.uses[step]:
                self._operation(step, indent)

    def _operation(self, step: Operation, indent: str) -> None:
        if step.start:
            target = _entry(step, 0)
            self._lines.append(f"{indent}{target} = {step.start};\n")
            for node, at, size in step.operands[0]:
                texts = (step.code.format(target, _entry(node, at + k)) for k in range(size))
                self._lines.extend(f"{indent}{target} = {text};\n" for text in texts)
            return
        ends = {0, step.size}
        for value in step.reads:
            if length(value) > 1:
                ends.update(length(value[:k]) for k in range(len(value)))
        for low, high in pairwise(sorted(ends)):
            self._loop(high - low, _entry(step, low, "i"), _expression(step, low, "i"), indent)

    def _loop(self, size: int, target: str, value: str, indent: str) -> None:
        """Write an assignment of so many entries; [i+4] of one is [4]."""
        if size > 1:
            self._lines.append(f"{indent}for (i=0; i<{size}; ++i) {target} = {value};\n")
        else:
            once = re.sub(r"\[i\+?", "[", f"{target} = {value}").replace("[]", "[0]")
            self._lines.append(f"{indent}{once};\n")

    def _copy(self, value: Value, target: Node, indent: str) -> None:
        """Copy what of a value does not lie there already."""
        at = 0
        for node, begin, size in value:
            if node.base != target.base or node.offset + begin != target.offset + at:
                self._loop(size, _entry(target, at, "i"), _entry(node, begin, "i"), indent)
            at += size

    def _call(self, step: Call, indent: str) -> None:
        for value, row in zip(step.arguments, step.rows, strict=True):
            if row != value and row[0].node not in self._filled:
                self._filled.add(row[0].node)
                self._copy(value, row[0].node, indent)
        wanted = [node if node.size and self._placed.wanted(node, step) else None for node in step.results]
        many, room, pointers = step.times > 1, self._placed.callees.get(step, 0), step.callee.pointers
        columns = [0 if same else length(v) // step.times for v, same in zip(step.arguments, step.same, strict=True)]
        given = [
            _pointer(*row[0][:2], many * size) if row else "0" for row, size in zip(step.rows, columns, strict=True)
        ]
        made = ["0" if node is None else _pointer(node, 0, many * node.size // step.times) for node in wanted]
        lines = [f"const casadi_real* arg1[{max(1, pointers[0])}]", f"casadi_real* res1[{max(1, pointers[1])}]"]
        lines += [f"arg1[{k}]={text}" for k, text in enumerate(given)]
        lines += [f"res1[{k}]={text}" for k, text in enumerate(made)]
        lines.append(f"if ({step.callee.name}(arg1, res1, iw, {f'w+{room}' if room else 'w'}, 0)) return 1")
        loop = f"for (i=0; i<{step.times}; ++i) " if many else ""
        self._lines.extend([f"{indent}{loop}{{\n", *(f"{indent}  {line};\n" for line in lines), f"{indent}}}\n"])

    def _scalar(self, step: Call, code: ca.Function, indent: str) -> None:
        """Write the instructions of scalar code, each number in a variable."""
        given = [[_entry(node, at + k) for node, at, size in value for k in range(size)] for value in step.arguments]
        places, lines = set[int](), list[str]()
        for k in range(code.n_instructions()):
            what, read, made = code.instruction_id(k), code.instruction_input(k), code.instruction_output(k)
            if what == ca.OP_OUTPUT:
                if self._placed.wanted(step.results[made[0]], step):
                    lines.append(f"{_entry(step.results[made[0]], made[1])} = s{read[0]}")
                continue
            if what == ca.OP_INPUT:
                text = given[read[0]][read[1]]
            elif what == ca.OP_CONST:
                text = self._words.constant(code.instruction_constant(k))
            else:
                text = self._words.operations[what].format(*(f"s{i}" for i in read))
            places.add(made[0])
            lines.append(f"s{made[0]} = {text}")
        lines.insert(0, f"casadi_real {', '.join(f's{k}' for k in sorted(places))}")
        self._lines.extend([f"{indent}{{\n", *(f"{indent}  {line};\n" for line in lines if places), f"{indent}}}\n"])

    def _choice(self, step: Choice, indent: str) -> None:
        condition, side_by_side = _entry(step.condition[0].node, step.condition[0].at), self._words.side_by_side
        heads = f"if ((casadi_int){condition})", "else"
        if side_by_side:  # both, where some go one way and some the other
            self._lines.append(f"{indent}{{ const M first = {condition} != 0;\n")
            heads = "if (ANY(first))", "if (!EVERY(first))"
        for head, inner in zip(heads, step.regions, strict=True):
            self._lines.append(f"{indent}{head} {{\n")
            self._write(inner, f"{indent}  ")
            for node, value in zip(step.results, inner.outputs, strict=True):
                if node in self._placed.pointed:
                    self._lines.append(f"{indent}  {node.base} = {_pointer(value[0].node, value[0].at)};\n")
                elif side_by_side and inner is step.regions[1]:
                    self._blend(value, node, f"{indent}  ")
                else:
                    self._copy(value, node, f"{indent}  ")
            self._lines.append(f"{indent}}}\n")
        self._lines.append(f"{indent}}}\n" * side_by_side)

    def _blend(self, value: Value, target: Node, indent: str) -> None:
        """Copy a value where the first way was not gone."""
        at = 0
        for node, begin, size in value:
            place = _entry(target, at, "i")
            self._loop(size, place, f"either(first, {place}, {_entry(node, begin, 'i')})", indent)
            at += size


def _read_later(body: str) -> str:
    """The lines without variables that nothing reads: scalar code may leave an argument alone."""
    while True:
        named = Counter(_VARIABLE.findall(body))
        read = _ASSIGNED.sub(lambda line, named=named: line[0] if named[line[1]] > 1 else "", body)  # type: ignore[misc]
        if read == body:
            return body
        body = read


def _expression(step: Operation, at: int, index: str) -> str:
    """The text of an operation at an entry, and of what is written into it."""
    texts = []
    for value in step.operands:
        single, inner = length(value) == 1, Operation.inside(value)
        if inner is not None:
            texts.append(_expression(inner, 0 if single else at, "" if single else index))
        elif single:
            texts.append(_entry(value[0].node, value[0].at))
        else:
            [(node, begin, _)] = part(value, at, at + 1)
            texts.append(_entry(node, begin, index))
    return step.code.format(*texts)


def _entry(node: Node, at: int, index: str = "") -> str:
    if isinstance(node.base, str) and node.base[0] in "=&":
        return node.base[1:]
    base, place = ("w", node.base.begin) if isinstance(node.base, Place) else (node.base, 0)
    place += node.offset + at
    return f"{base}[{f'{index}+{place}' if index and place else index or place}]"


def _pointer(node: Node, at: int, column: int = 0) -> str:
    """The text of a pointer; with columns of some length, to the i-th one."""
    if isinstance(node.base, str) and node.base[0] == "&":
        return node.base
    base, place = ("w", node.base.begin) if isinstance(node.base, Place) else (node.base, 0)
    place += node.offset + at
    return f"{base}{f'+{place}' if place else ''}{f'+{column}*i' if column else ''}"
