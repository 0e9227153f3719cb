"""The chain rule of a large stage as C code: all directions of a tangent side by side, for wide registers.

A Jacobian as scalar code has one line per multiplication. Where there are many directions, a line that does all of them at once is
a loop of known length, which compilers turn into wide instructions:

    t_n[:] = sum over the operands k of n of  (dn/dk) t_k[:],

for every result n that is left after the eliminations that add no edge (`fpirhc.symbolic.chain_rule`).
"""

from __future__ import annotations

import casadi as ca

from fpirhc.symbolic.chain_rule import ChainRule, Graph

_WIDE = 4  # numbers of a wide register


def slopes_function(rule: ChainRule, name: str) -> ca.Function:
    """Function m -> the slopes of the graph that are not 1, in the order in which `tangent_code` reads them."""
    slopes = [slope for slope in _slopes(rule.graph) if not slope.is_one()]
    return ca.Function(name, [rule.symbols], [ca.cse(ca.densify(ca.vertcat(*slopes, 0)))])


def tangent_code(rule: ChainRule, name: str, slopes: str, blocks: tuple[int, int]) -> str:
    """Return C code of `name`, CasADi's signature, m -> (A, B, l_s, l_u), for the results (s+, l) of the variables (s, u).

    Args:
        rule: both parts of the derivative.
        name: of the C function.
        slopes: name of the compiled `slopes_function`.
        blocks: sizes of s and u.
    """
    graph, (ns, nu) = rule.graph, blocks
    width = -(-(ns + nu) // _WIDE) * _WIDE
    row = {n: k for k, n in enumerate([*graph.between, *graph.results])}
    count, lines = 0, list[str]()
    for n in row:
        terms, units = list[str](), list[str]()
        for place, slope in graph.slopes[n].items():
            factor = "1" if slope.is_one() else f"e[{count}]"
            count += not slope.is_one()
            if place < graph.variables:
                units.append(f"t[{row[n]}][{place}] += {factor};")
            else:
                terms.append(f"{factor} * t[{row[place]}][j]" if factor != "1" else f"t[{row[place]}][j]")
        lines.append(f"for (j = 0; j < {width}; ++j) t[{row[n]}][j] = {' + '.join(terms) or '0'};")
        lines += units
    first = len(graph.between)
    return _TEXT.format(
        name=name,
        slopes=slopes,
        count=count + 1,
        rows=len(row),
        width=width,
        first=first,
        ns=ns,
        nu=nu,
        lines="\n  ".join(lines),
    )


def _slopes(graph: Graph) -> list[ca.SX]:
    return [slope for n in (*graph.between, *graph.results) for slope in graph.slopes[n].values()]


# The lines are many. Apart from the loops around them they are compiled several times as fast, and less optimising is enough.
_TEXT = """
#if defined(__GNUC__) && !defined(__clang__)
#define APART __attribute__((noinline, optimize("O2", "tree-vectorize")))
#elif defined(__GNUC__)
#define APART __attribute__((noinline))
#else
#define APART
#endif

INLINE int {name}_lines(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w) {{
  casadi_real e[{count}], t[{rows}][{width}];
  Out made[8];
  int i, j;
  made[0] = e;
  if ({slopes}(arg, made, iw, w, 0)) return 1;
  {lines}
  for (j = 0; j < {ns}; ++j)
    for (i = 0; i < {ns}; ++i) res[0][j * {ns} + i] = t[{first} + i][j];
  for (j = 0; j < {nu}; ++j)
    for (i = 0; i < {ns}; ++i) res[1][j * {ns} + i] = t[{first} + i][{ns} + j];
  for (j = 0; j < {ns}; ++j) res[2][j] = t[{first} + {ns}][j];
  for (j = 0; j < {nu}; ++j) res[3][j] = t[{first} + {ns}][{ns} + j];
  return 0;
}}

#ifdef ALWAYS_WIDE
#define {name}_plain {name}_wide
#else
APART static int {name}_plain(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w) {{
  return {name}_lines(arg, res, iw, w);
}}
#endif

#if defined(__GNUC__) && defined(__x86_64__)
APART __attribute__((target("avx2")))
static int {name}_wide(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w) {{
  return {name}_lines(arg, res, iw, w);
}}
#else
#define {name}_wide {name}_plain
#endif

INLINE int {name}(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem) {{
  (void)mem;
  return WIDE ? {name}_wide(arg, res, iw, w) : {name}_plain(arg, res, iw, w);
}}
"""
