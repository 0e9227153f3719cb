"""The stage of a horizon expanded around a trajectory, for second-order sweeps, whole and in parts by the chain rule.

    s+ = F(s, u, theta),   A = dF/ds,  B = dF/du,   l_s, l_u,   and the second derivatives Q = l_ss, S = l_us, R = l_uu.

Loops in C call the parts, because they need Jacobians later, or not at all: `evaluate` and `pull` do the work of `linear_stage`,
`bend` and `curve` that of `hessian_stage`, with fewer operations and nothing twice. Theory: docs/theory-plants.md.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import NamedTuple, cast
from weakref import WeakKeyDictionary

import casadi as ca

from fpirhc.fields.checked import Checked
from fpirhc.horizon.problem import OptimalControl, expand_along, input_curvature
from fpirhc.symbolic.evaluate import Latest

_OPERANDS = 2  # most operands of an elementary operation
_Edges = list[dict[int, ca.SX]]  # for every result, its partial derivatives by the result that they are of
_WIDE = 4  # numbers of a wide register
# The lines are many. Apart from the loops around them they are compiled several times as fast, and less optimising is enough.
_TEXT = """
#ifdef PORTABLE
#define APART
#else /* PORTABLE */
#if defined(__GNUC__) && !defined(__clang__)
#define APART __attribute__((noinline, optimize("O2", "tree-vectorize")))
#elif defined(__GNUC__)
#define APART __attribute__((noinline))
#else
#define APART
#endif
#endif /* PORTABLE */

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

#ifdef PORTABLE
#define {name}_wide {name}_lines
#define {name}_plain {name}_lines
#else /* PORTABLE */
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
#endif /* PORTABLE */

INLINE int {name}(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem) {{
  (void)mem;
  return WIDE ? {name}_wide(arg, res, iw, w) : {name}_plain(arg, res, iw, w);
}}
"""


class Graph(NamedTuple):
    """What the chain rule runs over, after the eliminations that add no edge."""

    slopes: _Edges  # for every place, its partial derivatives (of the symbols of m) by the place that they are of
    between: list[int]  # the places that are left between variables and results, in the order of the computation
    variables: int  # number of variables, which have the first places
    results: range  # the places of the results, one after another at the end


@dataclass(frozen=True, eq=False)
class ChainRule:
    """The two parts of a derivative."""

    partials: ca.SX  # m, a column of expressions of the variables and parameters
    symbols: ca.SX  # a column of as many symbols for m
    data: ca.SX  # parameters that the second part is given too
    pulled: ca.SX  # J' w of the symbols, of the data and of the symbols `weights`
    weights: ca.SX  # w, as long as the results
    graph: Graph  # from which J is made

    @cached_property
    def jacobian(self) -> ca.SX:
        """J of the symbols, by elimination of everything between the variables and the results."""
        slopes, between, count, results = self.graph
        back = [dict(by) for by in slopes]
        ahead = _ahead(back)
        for n in between:
            _eliminate(n, back, ahead)
        jacobian = ca.SX(len(results), count)
        for row, n in enumerate(results):
            for place, slope in back[n].items():
                jacobian[row, place] = slope
        return jacobian


def chain_rule(results: ca.SX, variables: ca.SX, parameters: ca.SX, data: ca.SX | None = None) -> ChainRule:
    """Return both parts of the derivative of a column of results.

    `data`: symbols among the parameters that are there in the second part too. What takes a sum or two of them is not kept.
    """
    data = ca.SX(0, 1) if data is None else data
    function = ca.Function("fpirhc_values", [variables, parameters], [results], {"cse": True})
    weights = ca.SX.sym("w", results.numel())
    calls = any(function.instruction_id(k) == ca.OP_CALL for k in range(function.n_instructions()))
    edges, ends, values = _direct(results, variables) if calls else _graph(function, variables, parameters)
    partials, symbols = _named(edges, values, data)
    pulled = _pulled(edges, ends, weights, variables.numel())
    return ChainRule(partials, symbols, data, pulled, weights, _compressed(edges, ends, variables.numel()))


def _direct(results: ca.SX, variables: ca.SX) -> tuple[_Edges, list[int], list[ca.SX]]:
    """The graph of a Function that calls others, which are not looked into: from the variables straight to the results."""
    jacobian, count = ca.densify(ca.jacobian(results, variables)), variables.numel()
    rows = [{k: jacobian[r, k] for k in range(count) if not jacobian[r, k].is_zero()} for r in range(results.numel())]
    values = [*ca.vertsplit(variables), *ca.vertsplit(results)]
    return [*({} for _ in range(count)), *rows], list(range(count, len(values))), values


def _graph(function: ca.Function, variables: ca.SX, parameters: ca.SX) -> tuple[_Edges, list[int], list[ca.SX]]:
    """The edges between active results, the place of every output, and all values.

    The first places are the variables; a result that does not depend on them has no edges.
    """
    values = ca.vertsplit(variables) if variables.numel() else []
    edges: _Edges = [{} for _ in values]
    active, at, ends = [True] * len(values), dict[int, int](), [0] * function.numel_out(0)
    for k in range(function.n_instructions()):
        kind, operands, target = (
            function.instruction_id(k),
            function.instruction_input(k),
            function.instruction_output(k),
        )
        if kind == ca.OP_OUTPUT:
            ends[target[1]] = at[operands[0]]
            continue
        if kind == ca.OP_INPUT and operands[0] == 0:
            at[target[0]] = operands[1]
            continue
        by: dict[int, ca.SX] = {}
        if kind == ca.OP_INPUT:
            value = parameters[operands[1]]
        elif kind == ca.OP_CONST:
            value = ca.SX(function.instruction_constant(k))
        else:
            places = [at[j] for j in operands]
            value, *slopes = _elementary(kind, [values[j] for j in places])
            for place, slope in zip(places, slopes, strict=True):
                if active[place] and not slope.is_zero():
                    by[place] = _plus(by[place], slope) if place in by else slope
        at[target[0]] = len(values)
        values.append(value)
        edges.append(by)
        active.append(bool(by))
    return edges, ends, values


def _plus(a: ca.SX, b: ca.SX) -> ca.SX:
    """Return a + b; the operator asks first whether its operands are numbers, which takes ten times as long."""
    return ca.SX.binary(ca.OP_ADD, a, b)


def _times(a: ca.SX, b: ca.SX) -> ca.SX:
    return ca.SX.binary(ca.OP_MUL, a, b)


def _elementary(kind: int, operands: list[ca.SX]) -> Sequence[ca.SX]:
    """The value and the partial derivatives of an elementary operation; of the most frequent ones without a call."""
    if kind == ca.OP_MUL:
        return _times(*operands), operands[1], operands[0]
    if kind in (ca.OP_ADD, ca.OP_SUB):
        return ca.SX.binary(kind, *operands), ca.SX(1), ca.SX(1 if kind == ca.OP_ADD else -1)
    return cast(Sequence[ca.SX], _operation(kind, len(operands))(*operands))


@cache
def _operation(kind: int, operands: int) -> ca.Function:
    """Function operands -> (value, partial derivatives) of one elementary operation."""
    symbols = [ca.SX.sym(name) for name in "ab"[:operands]]
    value = ca.SX.unary(kind, *symbols) if operands < _OPERANDS else ca.SX.binary(kind, *symbols)
    return ca.Function("fpirhc_operation", symbols, [value, *(ca.densify(ca.jacobian(value, s)) for s in symbols)])


def _named(edges: _Edges, values: list[ca.SX], data: ca.SX) -> tuple[ca.SX, ca.SX]:
    """The partial derivatives that are not constant, each once, and symbols, which take their place at the edges."""
    known, places = {one.element_hash() for one in ca.vertsplit(data)}, list[tuple[int, int]]()
    for n, by in enumerate(edges):
        for place, slope in by.items():
            anew = _anew(slope, known)
            if anew is not None:
                by[place] = anew
            elif not slope.is_constant():
                places.append((n, place))
    slopes = ca.cse(ca.vertcat(*(edges[n][place] for n, place in places), *values))
    partials, symbols = list[ca.SX](), dict[int, ca.SX]()
    for (n, place), slope in zip(places, ca.vertsplit(slopes[: len(places)]) if places else [], strict=True):
        half = _half(slope)  # twice a number costs less than to keep both
        key = half.element_hash()
        if key not in symbols:
            symbols[key] = ca.SX.sym(f"m{len(partials)}")
            partials.append(half)
        edges[n][place] = symbols[key] if half is slope else 2 * symbols[key]
    if not partials:  # linear: a column must have an entry
        return ca.SX(0.0), ca.SX.sym("m")
    return ca.vertcat(*partials), ca.vertcat(*symbols.values())


def _anew(slope: ca.SX, known: set[int], most: int = 2) -> ca.SX | None:
    """A slope that so many products and sums of known symbols are; None: it is not."""
    if slope.is_constant() or slope.element_hash() in known:
        return slope
    if not slope.n_dep() or not most:
        return None
    operands = list[ca.SX]()
    for k in range(slope.n_dep()):
        one = _anew(slope.dep(k), known, most - 1)
        if one is None:
            return None
        operands.append(one)
    code = slope.op()
    if code == ca.OP_DIV and operands[1].is_constant() and abs(math.frexp(float(operands[1]))[0]) == 0.5:
        return _times(operands[0], ca.SX(1 / float(operands[1])))  # the same number
    return ca.SX.binary(code, *operands) if code in (ca.OP_ADD, ca.OP_SUB, ca.OP_MUL) else None


def _half(slope: ca.SX) -> ca.SX:
    """X of a slope 2 x, as that of a square is; else the slope itself."""
    twice = not slope.is_constant() and slope.is_op(ca.OP_TWICE)
    return slope.dep(0) if twice else slope


def _pulled(edges: _Edges, ends: list[int], weights: ca.SX, count: int) -> ca.SX:
    """J' w, from the last result back to the variables."""
    bars = [ca.SX(0) for _ in edges]
    for end, weight in zip(ends, ca.vertsplit(weights), strict=True):
        bars[end] = _plus(bars[end], weight)
    for n in reversed(range(count, len(edges))):
        for place, slope in edges[n].items():
            bars[place] = _plus(bars[place], _times(slope, bars[n]))
    return ca.vertcat(*bars[:count])


def _compressed(edges: _Edges, ends: list[int], count: int) -> Graph:
    """The graph with the results at its end, and without what can be eliminated for nothing."""
    first = len(edges)
    back = [dict(by) for by in edges] + [{end: ca.SX(1)} if edges[end] or end < count else {} for end in ends]
    ahead, between, left = _ahead(back), [n for n in range(count, first) if back[n]], 0
    while len(between) != left:
        left = len(between)
        between = [n for n in between if _adds_edges(back[n], ahead[n]) or _eliminate(n, back, ahead)]
    return Graph(back, between, count, range(first, first + len(ends)))


def _ahead(back: _Edges) -> list[set[int]]:
    """For every place, the places that depend on it."""
    ahead: list[set[int]] = [set() for _ in back]
    for n, by in enumerate(back):
        for place in by:
            ahead[place].add(n)
    return ahead


def _adds_edges(by: dict[int, ca.SX], after: set[int]) -> bool:
    return len(by) * len(after) > len(by) + len(after)


def _eliminate(n: int, back: _Edges, ahead: list[set[int]]) -> bool:
    """Connect what is before and after a result, and take it out; returns False, for filters."""
    for later in ahead[n]:
        slope, by = back[later].pop(n), back[later]
        for place, before in back[n].items():
            product = _times(slope, before)
            by[place] = _plus(by[place], product) if place in by else product
            ahead[place].add(later)
    for place in back[n]:
        ahead[place].discard(n)
    return False


def slopes_function(rule: ChainRule, name: str) -> ca.Function:
    """Function (m, data) -> the slopes of the graph that are not 1, in the order in which `tangent_code` reads them."""
    slopes = [slope for slope in _slopes(rule.graph) if not slope.is_one()]
    return ca.Function(name, [rule.symbols, rule.data], [ca.cse(ca.densify(ca.vertcat(*slopes, 0)))])


def tangent_code(rule: ChainRule, name: str, slopes: str, blocks: tuple[int, int]) -> str:
    """Return C code of `name`, CasADi's signature, (m, data) -> (A, B, l_s, l_u), for the results (s+, l) of the variables (s, u).

    All directions of a tangent stand side by side: a line that does all of them at once is a loop of known length, which compilers
    turn into wide instructions,  t_n[:] = sum over the operands k of n of (dn/dk) t_k[:],  for every result n that is left after
    the eliminations that add no edge.

    Args:
        name: of the C function.
        slopes: name of the compiled `slopes_function`.
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
        lines.append(f"for (j = 0; j < {width}; ++j) t[{row[n]}][j] = {' + '.join(terms) or 'ALL(0)'};")
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


_MANY = 16  # directions from which on loops over all of them beat scalar code: 24 directions took .76 of the time, 12 took 1.03


class HessianModel(Checked, ABC):
    """Contract: a model of a stage's second derivatives."""

    @property
    def needs_convex_cost(self) -> bool:
        """Whether the model says nothing useful of a cost that does not bend upwards."""
        return True

    def of(self, ocp: OptimalControl) -> OptimalControl:
        """Return the problem whose second derivatives are the model's: itself, or one with another cost in their place."""
        return ocp

    @abstractmethod
    def curved(self, cost: ca.SX, next_state: ca.SX, costate: ca.SX) -> ca.SX:
        """Return the scalar whose Hessian with respect to (s, u) the sweep uses."""


@dataclass(frozen=True)
class GaussNewton(HessianModel):
    """The Hessian of the stage cost alone.

    Args:
        linear_outputs: whether outputs of the plant count as linear in the state: the Hessian of a squared error of y = h(x) is
            then 2 h' h'^T, which bends upwards, also where the curve h saturates. Without it a squared error of a curve may bend
            downwards far from the reference, and is refused.
    """

    linear_outputs: bool = field(default=False, metadata={"setting": "where given"})

    def of(self, ocp: OptimalControl) -> OptimalControl:
        return _with_linear_outputs(ocp) if self.linear_outputs else ocp

    def curved(self, cost: ca.SX, next_state: ca.SX, costate: ca.SX) -> ca.SX:  # noqa: ARG002
        return cost


@dataclass(frozen=True)
class ExactHessian(HessianModel):
    """The Hessian of the stage's Hamiltonian: quadratic convergence near a strict minimum, indefinite far from it.

    It sees the curvature that the dynamics give to a cost that has none of its own, such as a production rate.
    """

    needs_convex_cost = False

    def curved(self, cost: ca.SX, next_state: ca.SX, costate: ca.SX) -> ca.SX:
        """Return l + lambda' F."""
        return cost + ca.dot(costate, next_state)


def linear_stage(ocp: OptimalControl) -> ca.Function:
    """Function (s, u, theta) -> (s+, l, A (ns, ns), B (ns, nu), l_s, l_u)."""
    s, u, theta = stage_symbols(ocp)
    next_state, (cost, _) = ocp.dynamics(s, u, theta), ocp.stage_cost(s, u, theta)
    jacobians = [ca.jacobian(next_state, s), ca.jacobian(next_state, u)]
    gradients = [ca.gradient(cost, s), ca.gradient(cost, u)]
    return _dense("fpirhc_linear_stage", [s, u, theta], [next_state, cost, *jacobians, *gradients])


def hessian_stage(ocp: OptimalControl, hessian: HessianModel) -> ca.Function:
    """Function (s, u, theta, lambda of s+) -> (Q (ns, ns), S (nu, ns), R (nu, nu))."""
    s, u, theta = stage_symbols(ocp)
    costate = ca.SX.sym("lambda", ocp.state.size)
    cost, at = _bending_cost(ocp, s, u, theta)
    curved = hessian.curved(cost, ocp.dynamics(s, u, theta), costate)
    slope = ca.gradient(curved, u)
    results = [ca.hessian(curved, s)[0], ca.jacobian(slope, s), ca.jacobian(slope, u)]
    results = [ca.substitute(r, at, ca.vertcat(s, u)) for r in results] if ocp.frozen else results
    return _dense("fpirhc_hessian_stage", [s, u, theta, costate], results)


def hessian_end(ocp: OptimalControl) -> ca.Function:
    """Function (s_N, theta_N) -> (T, T_s, T_ss)."""
    s, _, theta = stage_symbols(ocp)
    final = ocp.terminal_cost(s, theta)
    hessian, slope = ca.hessian(final, s)
    if ocp.frozen:
        at = ca.SX.sym("at", s.numel())
        hessian = ca.substitute(ca.hessian(ocp.frozen[1](s, theta, at), s)[0], at, s)
    return _dense("fpirhc_hessian_end", [s, theta], [final, slope, hessian])


def stage_symbols(ocp: OptimalControl) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Symbols (s, u, theta) of one stage."""
    return ca.SX.sym("s", ocp.state.size), ca.SX.sym("u", ocp.input.size), ca.SX.sym("theta", ocp.data.size)


def _bending_cost(ocp: OptimalControl, s: ca.SX, u: ca.SX, theta: ca.SX) -> tuple[ca.SX, ca.SX]:
    """The stage cost whose second derivatives are used, and the symbols at which its outputs are linearised, if they are."""
    if ocp.frozen is None:
        return ocp.stage_cost(s, u, theta)[0], ca.SX(0, 1)
    at = ca.SX.sym("at", s.numel() + u.numel())
    return ocp.frozen[0](s, u, theta, at), at


_linear: WeakKeyDictionary[OptimalControl, OptimalControl] = WeakKeyDictionary()


def _with_linear_outputs(ocp: OptimalControl) -> OptimalControl:
    """The problem with second derivatives of the cost on linearised outputs; scale and expansion are theirs too."""
    if ocp.frozen is not None or ocp.linear_outputs is None:
        return ocp
    if ocp not in _linear:
        changed = replace(ocp, frozen=ocp.linear_outputs())
        s, u, theta = stage_symbols(ocp)
        next_state = ocp.dynamics(s, u, theta)
        second = hessian_stage(changed, GaussNewton())(s, u, theta, ca.SX.zeros(s.numel()))
        slopes = [ca.densify(ca.jacobian(next_state, v)) for v in (s, u)]
        functions: dict[object, ca.Function] = {
            "linearised": ca.Function("fpirhc_linearised", [s, u, theta], [*slopes, *second]),
            "final": ca.Function("fpirhc_final", [s, theta], [hessian_end(changed)(s, theta)[2]]),
        }
        along = expand_along(ocp.dynamics, ocp.stage_cost, ocp.terminal_cost, ocp.nodes, functions)
        curvature = input_curvature(along, ocp.step)
        _linear[ocp] = replace(changed, along=along, curvature=curvature, functions=functions)
    return _linear[ocp]


def _dense(name: str, arguments: list[ca.SX], results: list[ca.SX]) -> ca.Function:
    return ca.Function(name, arguments, ca.cse([ca.densify(r) for r in results]))


_Parts = dict[str, ca.Function]
_STAGES: Latest[tuple[ChainRule, _Parts]] = Latest(8)  # horizons that differ in their data only have one stage
_HESSIANS: Latest[_Parts] = Latest(8)


def _stage(ocp: OptimalControl) -> tuple[ChainRule, _Parts]:
    return _STAGES.of((ocp.dynamics, ocp.stage_cost), (), lambda: _split(ocp))


def split_stage(ocp: OptimalControl) -> dict[str, ca.Function]:
    """Return the Functions evaluate and pull, built once for a stage."""
    return _stage(ocp)[1]


def linearise_stage(ocp: OptimalControl) -> ca.Function:
    """Return the Function linearise as scalar code."""
    rule, parts = _stage(ocp)
    if "linearise" not in parts:
        ns = ocp.state.size
        rates, slopes = rule.jacobian[:ns, :], rule.jacobian[ns, :].T
        results = [rates[:, :ns], rates[:, ns:], slopes[:ns], slopes[ns:]]
        parts["linearise"] = _dense("fpirhc_linearise_stage", [rule.symbols, rule.data], results)
    return parts["linearise"]


def stage_leaves(ocp: OptimalControl, names: tuple[str, ...]) -> tuple[_Parts, str]:
    """Return what a driver in C calls and C code to stand before it, which together provide `linearise` and the parts named."""
    parts = split_stage(ocp)
    leaves = {name: parts[name] for name in names}
    sizes = ocp.state.size, ocp.input.size
    if sum(sizes) <= _MANY:
        return {**leaves, "linearise": linearise_stage(ocp)}, ""
    rule = _stage(ocp)[0]
    leaves["slopes"] = slopes_function(rule, "fpirhc_slopes")
    return leaves, tangent_code(rule, "linearise", "slopes", sizes)


def partial_count(ocp: OptimalControl) -> int:
    """Return the number of partial derivatives m of a stage that are kept."""
    return int(split_stage(ocp)["pull"].numel_in(0))


def split_hessian(ocp: OptimalControl, hessian: HessianModel) -> dict[str, ca.Function]:
    """Return the Functions bend and curve of a model of the second derivatives, built once for a stage."""
    same = ocp.dynamics, ocp.stage_cost, ocp.frozen
    return _HESSIANS.of(same, (hessian,), lambda: _bent(ocp, hessian))


def _bent(ocp: OptimalControl, hessian: HessianModel) -> _Parts:
    ns = ocp.state.size
    s, u, theta = stage_symbols(ocp)
    after, variables = ca.SX.sym("lambda", ns), ca.vertcat(s, u)
    cost, at = _bending_cost(ocp, s, u, theta)
    slope = ca.gradient(hessian.curved(cost, ocp.dynamics(s, u, theta), after), variables)
    parts = chain_rule(ca.cse(ca.densify(slope)), variables, ca.vertcat(theta, after, at))
    partials = ca.substitute(parts.partials, at, variables) if ocp.frozen else parts.partials
    # Only the lower triangle is computed.
    whole = ca.tril2symm(ca.tril(parts.jacobian))
    return {
        "bend": _dense("fpirhc_bend_stage", [s, u, theta, after], [partials]),
        "curve": _dense("fpirhc_curve_stage", [parts.symbols], [whole[:ns, :ns], whole[ns:, :ns], whole[ns:, ns:]]),
    }


def _split(ocp: OptimalControl) -> tuple[ChainRule, _Parts]:
    ns, nu = ocp.state.size, ocp.input.size
    s, u, theta = stage_symbols(ocp)
    next_state, (cost, _) = ocp.dynamics(s, u, theta), ocp.stage_cost(s, u, theta)
    parts = chain_rule(ca.densify(ca.vertcat(next_state, cost)), ca.vertcat(s, u), theta, theta)
    after = ca.SX.sym("lambda", ns)
    pulled = ca.substitute(parts.pulled, parts.weights, ca.vertcat(after, 1))
    return parts, {
        "evaluate": _dense("fpirhc_evaluate_stage", [s, u, theta], [next_state, cost, parts.partials]),
        "pull": _dense("fpirhc_pull_stage", [parts.symbols, after, theta], [pulled[:ns], pulled[ns : ns + nu]]),
    }
