"""Bodies in C for Functions whose composed graph is slow to run as generated code.

A driver is a hand-written loop around generated leaf functions, with the same results as a composed Function. The composed
Function stays the definition: the virtual machine runs it, and it is compiled where a driver does not fit. When C is generated
for a Function that calls it, its body is replaced by a call of the driver. The first one finds out whether a column is finite.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache

import casadi as ca

from fpirhc.errors import NotSupported
from fpirhc.symbolic.expression import FINITE, TINY, Expression, graph
from fpirhc.symbolic.latest import Latest

SIGNATURE = "(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem)"
_FUNCTION = re.compile(r"^/\*[^\n]*\*/\nstatic int (casadi_f\d+)\([^\n]*\{\n.*?^\}\n", re.MULTILINE | re.DOTALL)
_CALL = re.compile(r"\bcasadi_f\d+\b")
# Large leaves are compiled without much optimising; the loops around them never are. The loops use wider registers than the
# leaves: with registers allocated across calls GCC forgets to clear their upper halves, and every leaf then runs at half speed.
_FAST = """#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize ("O3", "no-ipa-ra")
#endif"""
# Constants of the type that computes: a float is not a double with fewer digits. Compilers fold them.
OF_TYPE = """#include <float.h>
#define OF_TYPE(of_double, of_float) ((casadi_real)(sizeof(casadi_real) == sizeof(float) ? (of_float) : (of_double)))
#define FINITE (OF_TYPE(DBL_MAX, FLT_MAX) / 134217728)
#define TINY (OF_TYPE(DBL_MIN, FLT_MIN) * 67108864)
"""
_LARGE_OR_SMALL = re.compile(r"(?<![\w.])\d\.\d{16}e[+-](?:[3-9]\d|\d{3})\b")
_drivers: dict[str, str] = {}
_rooms: dict[str, int] = {}
_LATEST: Latest[ca.Function] = Latest(16)
_BODY = re.compile(
    r"(?:^/\* (\w+):\([^\n]*\*/\n)?^static int (casadi_f\d+)\([^\n]*\) \{\n(.*?)^\}$", re.MULTILINE | re.DOTALL
)
_OWN = re.compile(r"(?<=[ *])(w\d+)=w\+(\d+)(?=[,;])")
_CALLED = re.compile(r"\b(casadi_f\d+|\w+_driver)\([^;\n]*, w, (?:0|mem)\)")
_USE = re.compile(r"\bw\b")
_EXPORTED = re.compile(r"^CASADI_SYMBOL_EXPORT int (\w+)_work\(.*?\*sz_w = (\d+)", re.MULTILINE | re.DOTALL)
_SIZE = re.compile(r"(\*sz_w = )(\d+)")


@dataclass(frozen=True, eq=False)
class Driver:
    """The C text of a driver.

    Args:
        text: C code that defines `int ENTRY(arg, res, iw, w, mem)`, CasADi's C signature, and calls the leaves by their keys.
            ROOM is defined there as the numbers that it has in w. Leaves are scalar code, which needs no w and no iw.
        leaves: generated Functions by key.
        constants: preprocessor definitions by name.
        room: numbers that the driver needs in w.
    """

    text: str
    leaves: Mapping[str, ca.Function]
    constants: Mapping[str, object]
    room: int = 0

    def source(self) -> str:
        """Return the whole C file, in which the entry is called ENTRY."""
        generator = ca.CodeGenerator("fpirhc_leaves", {"with_header": False, "with_mem": False})
        renamed = [_renamed(leaf, f"fpirhc_leaf_{name}") for name, leaf in self.leaves.items()]
        for leaf in renamed:
            generator.add(leaf)
        lines = [f"#define {name} {value}" for name, value in self.constants.items()]
        lines += [f"#define {name} fpirhc_leaf_{name}" for name in self.leaves]
        lines.append(f"#define ROOM {self.room}")
        # The leaves belong to this file alone: the same names in other drivers must not meet in one library.
        generated = re.sub(r"^CASADI_SYMBOL_EXPORT ", "static ", generator.dump(), flags=re.MULTILINE)
        return "\n".join([of_type(generated), *lines, _FAST, self.text])


def with_driver(name: str, driver: Driver, build: Callable[[str], ca.Function]) -> ca.Function:
    """Return `build(unique name)` with this driver as its body in C; the same body has the same Function."""
    unique = registered(name, driver)
    return _LATEST.of((), (unique,), lambda: build(unique))


def registered(name: str, driver: Driver) -> str:
    """Return the unique name of a driver: a Function of this name has it as its body in C."""
    source = driver.source()
    unique = f"{name}_{hashlib.sha256(source.encode()).hexdigest()[:16]}"
    _drivers[unique], _rooms[f"{unique}_driver"] = source, driver.room
    return unique


@contextmanager
def compiled_plans() -> Iterator[None]:
    """Within it a loop of the virtual machine calls the compiled plan: a short run is not worth a compiler, its plans are.

    What is composed within calls a library, so it cannot be compiled as a whole.
    """
    token = _COMPILED.set(True)
    try:
        yield
    finally:
        _COMPILED.reset(token)


def plans_are_compiled() -> bool:
    """Whether plans are called as libraries here; what keeps a composed loop keeps it by this too."""
    return _COMPILED.get()


_COMPILED = ContextVar("fpirhc_compiled_plans", default=False)


def of_type(source: str) -> str:
    """Return generated C in which multiples of `FINITE` and `TINY` are written as such, so that they are those of its type."""
    return OF_TYPE + _LARGE_OR_SMALL.sub(_multiple, source)


def _multiple(number: re.Match[str]) -> str:
    value = float(number[0])
    for name, unit in (("FINITE", FINITE), ("TINY", TINY)):
        share = value / unit
        if 2**-10 <= share <= 2**10 and share * unit == value:
            return f"({share!r} * {name})"
    return number[0]


def substitute(source: str) -> tuple[str, list[str]]:
    """Return generated C with the bodies of Functions that have a driver replaced, and the drivers' own C files."""
    files = []
    for name in dict.fromkeys(re.findall(r"^/\* (fpirhc_\w+):\(", source, re.MULTILINE)):
        if name not in _drivers:
            continue
        body = re.compile(
            rf"(^/\* {name}:\([^\n]*\*/\nstatic int \w+\([^\n]*\) \{{\n).*?^\}}$", re.MULTILINE | re.DOTALL
        )
        entry = f"{name}_driver"
        source, count = body.subn(rf"\1  return {entry}(arg, res, iw, w, mem);\n}}", source)
        if count:
            declaration = f"int {entry}{SIGNATURE};\n"
            source = source.replace(f"/* {name}:(", f"{declaration}/* {name}:(", 1)
            files.append(f"#define ENTRY {entry}\n{_drivers[name]}")
    return (_without_unused(source) if files else source), files


def _without_unused(source: str) -> str:
    """Drop the static functions that nothing calls any more: a compiler would read and then discard them."""
    definitions = {m[1]: m[0] for m in _FUNCTION.finditer(source)}
    rest = re.sub(r"^#define .*$", "", _FUNCTION.sub("", source), flags=re.MULTILINE)
    called, waiting = set[str](), [rest]
    while waiting:
        for name in set(_CALL.findall(waiting.pop())) & definitions.keys() - called:
            called.add(name)
            waiting.append(definitions[name].partition("{")[2])
    for name in definitions.keys() - called:
        source = source.replace(definitions[name], "")
    return source


def _renamed(leaf: ca.Function, name: str) -> ca.Function:
    inputs = [ca.SX.sym(f"i{k}", leaf.sparsity_in(k)) for k in range(leaf.n_in())]
    results = leaf.call(inputs)
    return ca.Function(name, inputs, results)


@dataclass(frozen=True)
class _Body:
    """One generated function: its text, its name, its callees, and where its own values begin and end, None if unknown."""

    name: str
    text: str
    callees: tuple[str, ...]
    begin: int | None
    end: int | None
    plain: bool  # only calls use the begin of w


def with_less_work(source: str, sizes: Mapping[str, int], functions: Mapping[str, ca.Function]) -> str:
    """Return a program with the same results and a shorter work vector.

    CasADi gives every Function of a program one work vector w: its callees get w from its begin, and its own values stand behind
    what the largest callee needs. A driver needs another number of them than the graph that it replaces. So its callers' own
    values move, mostly down, and the program needs less. CasADi also keeps room for values that its C only points to: a Function
    ends behind the last value that its text has. A Function is changed only where its text shows that nothing but calls uses the
    begin of w.

    Args:
        source: generated C, in which calls of drivers stand in place of bodies.
        sizes: of the work vectors of all Functions, by name, as CasADi made them; of Functions with the same name the largest.
        functions: by name, without those that share a name.

    Raises:
        NotSupported: a driver has more numbers than the graph that it replaces, and its callers cannot make room for them.
    """
    exported = _EXPORTED.search(source)
    if exported is None:
        return source
    sizes = {**sizes, exported[1]: int(exported[2])}
    bodies = {m[2]: _body(m[1] or "", m[3], functions.get(m[1] or "")) for m in _BODY.finditer(source)}
    needs = dict[str, int | None]()
    for key in bodies:
        _need(key, bodies, sizes, needs)
    top = [key for key, body in bodies.items() if body.name == exported[1]]
    if len(top) != 1 or any(need is None for need in needs.values()):
        raise NotSupported("the work of its loops cannot be laid out")
    source = _BODY.sub(lambda m: m[0].replace(m[3], _moved(bodies[m[2]], needs)), source)
    return _SIZE.sub(lambda m: f"{m[1]}{needs[top[0]]}", source)


def _body(name: str, text: str, function: ca.Function | None) -> _Body:
    own = [int(m[2]) for m in _OWN.finditer(text)]
    callees = tuple(m[1] for m in _CALLED.finditer(text))
    plain = not _USE.search(_CALLED.sub("", _OWN.sub("", text)))
    return _Body(name, text, callees, min(own) if own else None, _end(text, function), plain)


def _end(text: str, function: ca.Function | None) -> int | None:
    """Where the last own value of a function ends, None where it is not known.

    The value w12 is place 12 of the Function's work. The lengths of all places must explain where every value begins.
    """
    if function is None or not function.is_a("MXFunction"):
        return None
    begins = {int(m[1][1:]): int(m[2]) for m in _OWN.finditer(text)}
    places = sorted(begins, key=begins.__getitem__)
    lengths = _lengths(function)
    if not places or any(lengths.get(place) is None for place in places):
        return None
    ends = [begins[place] + int(lengths[place] or 0) for place in places]
    return ends[-1] if all(end == begins[k] for end, k in zip(ends, places[1:], strict=False)) else None


def _lengths(function: ca.Function) -> dict[int, int | None]:
    """Length of every place of a Function's work; None where its uses disagree."""
    lengths = dict[int, int | None]()
    for k in range(function.n_instructions()):
        if function.instruction_id(k) == ca.OP_OUTPUT:  # its number is that of a result
            continue
        places, made = list(function.instruction_output(k)), function.instruction_MX(k)
        for j, place in enumerate(places):
            if made.is_call():  # a call itself has no length
                length = int(made.which_function().nnz_out(j))
            else:
                length = int(made.nnz() if len(places) == 1 else made.get_output(j).nnz())
            lengths[place] = length if lengths.get(place, length) == length else None
    return lengths


def _need(key: str, bodies: Mapping[str, _Body], sizes: Mapping[str, int], needs: dict[str, int | None]) -> int | None:
    """What a function needs after the move; None where that is not known."""
    if key not in bodies:
        return _rooms.get(key, 0) if key.endswith("_driver") else None
    if key not in needs:
        body = bodies[key]
        inner = [_need(callee, bodies, sizes, needs) for callee in body.callees]
        below = None if None in inner else max((n for n in inner if n is not None), default=0)
        if below is None:
            needs[key] = None
        elif not body.plain:  # it stays as it is, and CasADi's begin of its own values must be behind its callees
            begin, size = body.begin, sizes.get(body.name)
            fits = size is not None and below <= (size if begin is None else begin)
            needs[key] = size if fits else None
        elif body.begin is None:
            needs[key] = below
        else:
            size = body.end if body.end is not None else sizes.get(body.name)
            needs[key] = None if size is None else size - (body.begin - below)
    return needs[key]


def _moved(body: _Body, needs: Mapping[str, int | None]) -> str:
    """The text with the function's own values directly behind what its callees need."""
    if body.begin is None or not body.plain:
        return body.text
    below = max((needs.get(callee) or 0 for callee in body.callees), default=0)
    shift = body.begin - below
    return _OWN.sub(lambda m: f"{m[1]}=w+{int(m[2]) - shift}", body.text)


_TEXT = f"""
int ENTRY{SIGNATURE} {{
  casadi_real sums[8] = {{0, 0, 0, 0, 0, 0, 0, 0}}, total = 0;
  const casadi_real large = 134217728;
  const casadi_real* x = arg[0];
  int k = 0, j;
  for (; k + 8 <= SIZE; k += 8)
    for (j = 0; j < 8; ++j) sums[j] += x[k + j] * large - x[k + j] * large;
  for (; k < SIZE; ++k) total += x[k] * large - x[k] * large;
  for (j = 0; j < 8; ++j) total += sums[j];
  if (res[0]) res[0][0] = total == 0;
  return 0;
}}
"""

_KEPT = f"""
int ENTRY{SIGNATURE} {{
  casadi_real sums[8] = {{0, 0, 0, 0, 0, 0, 0, 0}}, total = 0;
  const casadi_real large = 134217728;
  const casadi_real *x = arg[0], *old = arg[1];
  casadi_real* kept = res[0];
  int k = 0, j;
  for (; k + 8 <= SIZE; k += 8)
    for (j = 0; j < 8; ++j) {{ kept[k + j] = x[k + j]; sums[j] += x[k + j] * large - x[k + j] * large; }}
  for (; k < SIZE; ++k) {{ kept[k] = x[k]; total += x[k] * large - x[k] * large; }}
  for (j = 0; j < 8; ++j) total += sums[j];
  if (res[1]) res[1][0] = total == 0;
  if (!(total == 0 && arg[2][0]))
    for (k = 0; k < SIZE; ++k) kept[k] = old[k];
  return 0;
}}
"""


def finite(column: Expression, *, opaque: bool) -> Expression:
    """Return 1 where every entry of the column is finite, else 0; `opaque` is that of the block."""
    return _function(graph(column).numel())(column) if opaque else every_finite(column)


def every_finite(column: Expression) -> Expression:
    """Return the same in scalar code: a sum is not finite where a summand is not. A tree of sums is not a chain of waits."""
    parts = ca.vertsplit(column)
    while len(parts) > 1:
        pairs = [a + b for a, b in zip(parts[::2], parts[1::2], strict=False)]
        parts = [*pairs, parts[-1]] if len(parts) % 2 else pairs
    return ca.fabs(parts[0]) <= FINITE


def kept_if_finite(new: Expression, old: Expression, good: Expression) -> tuple[Expression, Expression]:
    """Return (new where it is good and finite, else old; whether new is finite) of columns of a graph; C passes over them once."""
    kept, fine = _kept(graph(new).numel())(new, old, good)
    return kept, fine


@cache
def _kept(size: int) -> ca.Function:
    new, old, good = ca.MX.sym("new", size), ca.MX.sym("old", size), ca.MX.sym("good")
    driver = Driver(_KEPT, {}, {"SIZE": size})
    fine = _none_large(new)
    kept = ca.if_else(
        ca.logic_and(good, fine), new, old, True
    )  # a short circuit copies; else every entry is selected by itself
    return with_driver("fpirhc_kept", driver, lambda name: ca.Function(name, [new, old, good], [kept, fine]))


@cache
def _function(size: int) -> ca.Function:
    column = ca.MX.sym("column", size)
    driver = Driver(_TEXT, {}, {"SIZE": size})
    return with_driver("fpirhc_finite", driver, lambda name: ca.Function(name, [column], [_none_large(column)]))


def _none_large(column: ca.MX) -> ca.MX:
    """Whether every entry is finite: a sum of sizes, because the virtual machine then passes over the column once."""
    return ca.norm_1(column) <= FINITE
