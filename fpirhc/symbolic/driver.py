"""Bodies in C for Functions whose composed graph is slow to run as generated code.

A driver is a hand-written loop around generated leaf functions. The virtual machine runs a composed Function in its place, which
has the same results, or calls its compiled library. When C is generated for a Function that calls it, its body is replaced by a
call of the driver. The first one keeps a column where it is finite.
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

from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import FINITE, TINY, Expression, expression, graph, kind

SIGNATURE = "(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem)"
# Large leaves are compiled without much optimising; the loops around them never are. The loops use wider registers than the
# leaves: with registers allocated across calls GCC forgets to clear their upper halves, and every leaf then runs at half speed.
_FAST = """#if defined(__OPTIMIZE__) && defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize ("O3", "no-ipa-ra")
#endif"""
# Constants of the type that computes: a float is not a double with fewer digits. Compilers fold them.
OF_TYPE = """#include <float.h>
#define OF_TYPE(of_double, of_float) ((casadi_real)(sizeof(casadi_real) == sizeof(float) ? (of_float) : (of_double)))
#define FINITE (OF_TYPE(DBL_MAX, FLT_MAX) / 134217728)
#define TINY (OF_TYPE(DBL_MIN, FLT_MIN) * 67108864)
"""
# The words with which the loops in C are written.
WORDS = """#if defined(__GNUC__)
#define INLINE static inline __attribute__((always_inline)) /* so that sizes are constants in every loop */
#else
#define INLINE static inline
#endif
#if defined(__GNUC__) && !defined(__clang__)
#define NOT_UNROLLED _Pragma("GCC unroll 1") /* small matrices stay in memory, so that their columns fill wide registers */
#else
#define NOT_UNROLLED
#endif
#include <stdint.h>
#include <string.h>
/* Whether all are at most FINITE, 2^-27 of the largest number. Their exponents say it, without comparisons of numbers: those that
   are too large carry into the first bit. */
INLINE int all_finite(const casadi_real* v, int n) {
  int i;
  uint32_t carried = 0;
  for (i = 0; i < n; ++i) {
    uint64_t wide;
    uint32_t bits;
    if (sizeof *v == sizeof wide) {
      memcpy(&wide, v + i, sizeof wide), carried |= ((uint32_t)(wide >> 32) & 0x7fffffffu) + (28UL << 20);
    } else {
      memcpy(&bits, v + i, sizeof bits), carried |= (bits & 0x7fffffffu) + (28UL << 23);
    }
  }
  return !(carried >> 31);
}
"""
# CasADi lets every argument and result be absent; those of leaves never are.
_ABSENT = re.compile(r"if \(res\[\d+\]!=0\) |(?<==)(arg\[\d+\])\? (\1\[\d+\]) : 0(?=;)")
_LARGE_OR_SMALL = re.compile(r"(?<![\w.])\d\.\d{16}e[+-](?:[3-9]\d|\d{3})\b")
_drivers: dict[str, tuple[Driver, str]] = {}
_LATEST: Latest[ca.Function] = Latest(16)


@dataclass(frozen=True, eq=False)
class Driver:
    """The C text of a driver."""

    # C code that defines `int ENTRY(arg, res, iw, w, mem)`, with ROOM numbers in w, and calls the leaves by their keys, without w
    # and iw: one that needs room for its work, as tables of `ca.interpolant` do, has its own. No argument or result is absent.
    text: str
    leaves: Mapping[str, ca.Function]  # generated Functions by key
    constants: Mapping[str, object]  # preprocessor definitions by name
    room: int = 0  # numbers that the driver needs in w

    def source(self) -> str:
        """Return the whole C file, in which the entry is called ENTRY."""
        generator = ca.CodeGenerator("fpirhc_leaves", {"with_header": False, "with_mem": False})
        named = [renamed(leaf, f"fpirhc_leaf_{name}") for name, leaf in self.leaves.items()]
        for leaf in named:
            generator.add(leaf)
        # The leaves belong to this file alone: the same names in other drivers must not meet in one library.
        generated = re.sub(r"^CASADI_SYMBOL_EXPORT ", "static ", generator.dump(), flags=re.MULTILINE)
        working = [leaf for leaf in named if leaf.find_functions()]
        if not working:
            generated = _ABSENT.sub(lambda found: found[2] or "", generated)
        called = {
            k: f"{f.name()}{'_at_work' * bool(f.find_functions())}" for k, f in zip(self.leaves, named, strict=True)
        }
        definitions = (
            f"#define {name} {value}" for name, value in {**self.constants, **called, "ROOM": self.room}.items()
        )
        return "\n".join([of_type(generated), *map(_at_work, working), WORDS, *definitions, _FAST, self.text])


def _at_work(leaf: ca.Function) -> str:
    """A C function that calls a leaf with room for its work."""
    name, given, made = leaf.name(), leaf.sz_arg(), leaf.sz_res()
    return f"""static int {name}_at_work{SIGNATURE} {{
  const casadi_real* given[{max(given, 1)}];
  casadi_real *made[{max(made, 1)}], work[{max(leaf.sz_w(), 1)}];
  casadi_int places[{max(leaf.sz_iw(), 1)}], k;
  for (k = 0; k < {leaf.n_in()}; ++k) given[k] = arg[k];
  for (k = 0; k < {leaf.n_out()}; ++k) made[k] = res[k];
  (void)iw, (void)w, (void)mem;
  return {name}(given, made, places, work, 0);
}}"""


def with_driver(name: str, driver: Driver, build: Callable[[str], ca.Function]) -> ca.Function:
    """Return `build(unique name)` with this driver as its body in C; the same body has the same Function."""
    unique = registered(name, driver)
    return _LATEST.of((), (unique,), lambda: build(unique))


def registered(name: str, driver: Driver) -> str:
    """Return the unique name of a driver: a Function of this name has it as its body in C."""
    source = driver.source()
    unique = f"{name}_{hashlib.sha256(source.encode()).hexdigest()[:16]}"
    _drivers[unique] = driver, source
    return unique


@contextmanager
def compiled_plans(yes: bool = True) -> Iterator[None]:
    """Within it a loop of the virtual machine calls the compiled plan: a short run is not worth a compiler, its plans are."""
    token = _COMPILED.set(yes)
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


def is_driver(name: str) -> bool:
    """Whether a Function of this name has a driver as its body."""
    return name in _drivers


def parts_of(name: str) -> tuple[str, int, str]:
    """Return the name of the C function of a driver, the numbers that it needs in w, and its C file."""
    entry, (driver, source) = f"{name}_driver", _drivers[name]
    return entry, driver.room, f"#define ENTRY {entry}\n{source}"


def renamed(function: ca.Function, name: str) -> ca.Function:
    """Return a Function under another name; scalar code stays scalar code."""
    matrix = kind(not function.is_a("SXFunction"))
    inputs = [matrix.sym(f"i{k}", function.sparsity_in(k)) for k in range(function.n_in())]
    return ca.Function(name, inputs, function.call(inputs))


_KEPT = f"""
int ENTRY{SIGNATURE} {{
  casadi_real sums[8], total = 0, *kept = res[0];
  const casadi_real large = 134217728, *x = arg[0], *old = arg[1];
  int k = 0, j;
  for (j = 0; j < 8; ++j) sums[j] = 0;
  for (; k + 8 <= SIZE; k += 8)
    for (j = 0; j < 8; ++j) sums[j] += x[k + j] * large - x[k + j] * large;
  for (; k < SIZE; ++k) total += x[k] * large - x[k] * large;
  for (j = 0; j < 8; ++j) total += sums[j];
  if (res[1]) res[1][0] = total == 0;
  if (kept) memcpy(kept, total != 0 || arg[2][0] == 0 ? old : x, sizeof(casadi_real) * SIZE);
  return 0;
}}
"""


def finite(column: Expression, *, opaque: bool) -> Expression:
    """Return 1 where every entry of the column is finite, else 0; `opaque` is that of the block."""
    return kept_if_finite(column, column, expression(1.0), opaque=opaque)[1]


def every_finite(column: Expression) -> Expression:
    """Return the same in scalar code: a sum is not finite where a summand is not. A tree of sums is not a chain of waits."""
    parts = ca.vertsplit(column)
    while len(parts) > 1:
        pairs = [a + b for a, b in zip(parts[::2], parts[1::2], strict=False)]
        parts = [*pairs, parts[-1]] if len(parts) % 2 else pairs
    return ca.fabs(parts[0]) <= FINITE


def kept_if_finite(
    new: Expression, old: Expression, good: Expression, *, opaque: bool
) -> tuple[Expression, Expression]:
    """Return (new where it is good and finite, else old; whether new is finite); C passes over columns of a graph once."""
    if opaque:
        kept, fine = _kept(graph(new).numel())(new, old, good)
        return kept, fine
    fine = every_finite(new)
    return ca.if_else(ca.logic_and(good, fine), new, old), fine


@cache
def _kept(size: int) -> ca.Function:
    new, old, good = ca.MX.sym("new", size), ca.MX.sym("old", size), ca.MX.sym("good")
    driver = Driver(_KEPT, {}, {"SIZE": size})
    fine = ca.norm_1(new) <= FINITE  # a sum of sizes, because the virtual machine then passes over the column once
    # A short circuit copies; else every entry is selected by itself.
    kept = ca.if_else(ca.logic_and(good, fine), new, old, True)
    return with_driver("fpirhc_kept", driver, lambda name: ca.Function(name, [new, old, good], [kept, fine]))
