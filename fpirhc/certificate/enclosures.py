"""Guaranteed bounds of a CasADi Function over a box of its arguments, by affine arithmetic.

    y = c + sum_i a_i s_i + e s_0,        |s_i| <= 1,        s_i of the i-th argument, s_0 of the form itself

Every operation of the expanded Function maps forms to a form that contains all its values. Theory: docs/certificate.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca
import numpy as np

from fpirhc.errors import require

# Of an operation with its coefficients, or of a function of the standard library.
_ROUNDING = 16 * float(np.finfo(float).eps)
_TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True, eq=False)
class Box:
    """Intervals, entry by entry."""

    lower: np.ndarray  # least values
    upper: np.ndarray  # largest values, of the same shape

    def within(self, other: Box) -> bool:
        """Return whether every entry is inside the other's; False where an end is not a number."""
        return bool((self.lower >= other.lower).all() and (self.upper <= other.upper).all())

    def distance(self, point: np.ndarray | float) -> np.ndarray:
        """Return the largest |y - point| of every entry."""
        return np.maximum(self.upper - point, point - self.lower)

    def scaled(self, factor: float) -> Box:
        """Return the intervals times a number of at least 0."""
        return Box(factor * self.lower, factor * self.upper)


@dataclass(frozen=True, eq=False)
class Form:
    """Affine forms, one per lane."""

    centre: np.ndarray  # c, shape (lanes,)
    slopes: np.ndarray  # a, shape (arguments, lanes)
    spread: np.ndarray  # e of at least 0, shape (lanes,)

    @property
    def radius(self) -> np.ndarray:
        """Largest |y - c|."""
        return np.abs(self.slopes).sum(axis=0) + self.spread

    @property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest value."""
        radius = self.radius
        radius = radius + _ROUNDING * (np.abs(self.centre) + radius) + _TINY
        return self.centre - radius, self.centre + radius


def _form(centre: np.ndarray, slopes: np.ndarray, spread: np.ndarray) -> Form:
    """The form with the rounding of the operation that made it."""
    rounding = _ROUNDING * (np.abs(centre) + np.abs(slopes).sum(axis=0) + spread) + _TINY
    return Form(centre, slopes, spread + rounding)


def _add(a: Form, b: Form) -> Form:
    return _form(a.centre + b.centre, a.slopes + b.slopes, a.spread + b.spread)


def _negative(a: Form) -> Form:
    return Form(-a.centre, -a.slopes, a.spread)


def _product(a: Form, b: Form) -> Form:
    slopes = a.centre * b.slopes + b.centre * a.slopes
    spread = np.abs(a.centre) * b.spread + np.abs(b.centre) * a.spread + a.radius * b.radius
    return _form(a.centre * b.centre, slopes, spread)


def _square(a: Form) -> Form:
    """A square lies between its tangent and the tangent plus the radius squared."""
    half = 0.5 * a.radius**2
    return _form(a.centre**2 + half, 2 * a.centre * a.slopes, 2 * np.abs(a.centre) * a.spread + half)


Scalar: TypeAlias = Callable[[np.ndarray], np.ndarray]


def _curved(
    value: Scalar,
    slope: Scalar,
    second: Scalar | float,
    defined: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> Callable[[Form], Form]:
    """The rule of a function: its tangent plus the bound of its second derivative.

    `second`: the second derivative where it is monotone, else its largest size; `defined`: where it exists, of the ends.
    """

    def rule(a: Form) -> Form:
        ends = a.ends
        bends = (
            [-second * np.ones_like(a.centre), second * np.ones_like(a.centre)]
            if isinstance(second, float)
            else [second(end) for end in ends]
        )
        if defined is not None:
            bends = [np.where(defined(*ends), bend, np.nan) for bend in bends]
        least, largest = (
            0.5 * a.radius**2 * end for end in (np.minimum(np.minimum(*bends), 0), np.maximum(np.maximum(*bends), 0))
        )
        steep, centre = slope(a.centre), value(a.centre) + 0.5 * (least + largest)
        return _form(centre, steep * a.slopes, np.abs(steep) * a.spread + 0.5 * (largest - least))

    return rule


def _positive(low: np.ndarray, _: np.ndarray) -> np.ndarray:
    return np.asarray(low > 0)


_reciprocal = _curved(lambda c: 1 / c, lambda c: -1 / c**2, lambda c: 2 / c**3, lambda low, high: low * high > 0)
_sine = _curved(np.sin, np.cos, 1.0)
_cosine = _curved(np.cos, lambda c: -np.sin(c), 1.0)
_exponential = _curved(np.exp, np.exp, np.exp)
_logarithm = _curved(np.log, lambda c: 1 / c, lambda c: -1 / c**2, _positive)


def _larger(a: Form, b: Form) -> Form:
    """The larger one where the ranges are apart, else what contains both."""
    (low_a, high_a), (low_b, high_b) = a.ends, b.ends
    low, high = np.maximum(low_a, low_b), np.maximum(high_a, high_b)
    either = _form(0.5 * (low + high), np.zeros_like(a.slopes), 0.5 * (high - low))
    columns = zip(*((f.centre, f.slopes, f.spread) for f in (either, a, b)), strict=True)
    return Form(*(np.where(low_a >= high_b, y, np.where(low_b >= high_a, z, x)) for x, y, z in columns))


def _decided(yes: np.ndarray, no: np.ndarray, like: Form) -> Form:
    """One where it is sure, zero where it is sure not; else not a number: a function may jump there, which no derivative shows."""
    number = np.where(yes, 1.0, np.where(no, 0.0, np.nan))
    return Form(number, np.zeros_like(like.slopes), np.zeros_like(number))


def _sign(a: Form) -> Form:
    low, high = a.ends
    positive = _decided(low > 0, high < 0, a)
    return Form(2 * positive.centre - 1, positive.slopes, positive.spread)


def _less(a: Form, b: Form) -> Form:
    (low_a, high_a), (low_b, high_b) = a.ends, b.ends
    return _decided(high_a < low_b, low_a > high_b, a)


def _chosen(condition: Form, value: Form) -> Form:
    """The value where the condition holds, else zero."""
    yes = condition.centre != 0.0
    known = np.where(np.isnan(condition.centre), np.nan, 0.0)
    return Form(*(np.where(yes, entry, 0.0) + known for entry in (value.centre, value.slopes, value.spread)))


def _power(a: Form, b: Form) -> Form:
    exponent = float(b.centre.flat[0])
    if b.radius.any() or (b.centre != exponent).any():
        return _exponential(_product(b, _logarithm(a)))
    if exponent == int(exponent) and 1 <= abs(exponent) <= 16:
        power = a
        for _ in range(int(abs(exponent)) - 1):
            power = _square(a) if power is a else _product(power, a)
        return power if exponent > 0 else _reciprocal(power)
    second = exponent * (exponent - 1)
    slopes = (lambda c: exponent * c ** (exponent - 1), lambda c: second * c ** (exponent - 2))
    return _curved(lambda c: c**exponent, *slopes, _positive)(a)


_RULES: dict[int, Callable[..., Form]] = {
    ca.OP_ASSIGN: lambda a: a,
    ca.OP_ADD: _add,
    ca.OP_SUB: lambda a, b: _add(a, _negative(b)),
    ca.OP_MUL: _product,
    ca.OP_DIV: lambda a, b: _product(a, _reciprocal(b)),
    ca.OP_NEG: _negative,
    ca.OP_INV: _reciprocal,
    ca.OP_TWICE: lambda a: _add(a, a),
    ca.OP_SQ: _square,
    ca.OP_SQRT: _curved(np.sqrt, lambda c: 0.5 / np.sqrt(c), lambda c: -0.25 * c**-1.5, _positive),
    ca.OP_EXP: _exponential,
    ca.OP_LOG: _logarithm,
    ca.OP_SIN: _sine,
    ca.OP_COS: _cosine,
    ca.OP_TAN: lambda a: _product(_sine(a), _reciprocal(_cosine(a))),
    ca.OP_TANH: _curved(np.tanh, lambda c: 1 - np.tanh(c) ** 2, 0.77),
    ca.OP_ATAN: _curved(np.arctan, lambda c: 1 / (1 + c * c), 0.65),
    ca.OP_FABS: lambda a: _larger(a, _negative(a)),
    ca.OP_SIGN: _sign,
    ca.OP_LT: _less,
    ca.OP_LE: _less,
    ca.OP_NOT: lambda a: Form(1 - a.centre, a.slopes, a.spread),
    ca.OP_AND: _product,
    ca.OP_OR: lambda a, b: Form(np.maximum(a.centre, b.centre), a.slopes, a.spread),
    ca.OP_IF_ELSE_ZERO: _chosen,
    ca.OP_FMIN: lambda a, b: _negative(_larger(_negative(a), _negative(b))),
    ca.OP_FMAX: _larger,
    ca.OP_POW: _power,
    ca.OP_CONSTPOW: _power,
}


class Enclosure:
    """Bounds of the entries of an expression, column by column, over boxes of a column of symbols."""

    def __init__(self, value: ca.SX, argument: ca.SX) -> None:
        """Expand the expression. `value`: any shape."""
        self.function = ca.Function("fpirhc_enclosed", [argument], [ca.densify(ca.vec(value))])
        own = {ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST, *_RULES}
        for k in range(self.function.n_instructions()):
            require(
                self.function.instruction_id(k) in own,
                f"no bounds: the model has an operation without a rule (CasADi operation {self.function.instruction_id(k)}); "
                "write it with +, -, *, /, powers, sqrt, exp, log, sin, cos, tan, tanh, atan, fabs, fmin and fmax",
            )

    def at(self, points: np.ndarray) -> np.ndarray:
        """Return the values at points (entries, lanes), shape (results, lanes)."""
        return np.asarray(self.function.map(points.shape[1])(points).full())

    def over(self, box: Box) -> Box:
        """Return bounds of the values over boxes (entries, lanes), shape (results, lanes); infinite where there are none."""
        (entries, lanes), function = box.lower.shape, self.function
        forms: dict[int, Form] = {}
        results: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        still, centres = np.zeros((entries, lanes)), 0.5 * (box.lower + box.upper)
        radii = box.distance(centres)
        with np.errstate(all="ignore"):
            for k in range(function.n_instructions()):
                operation = function.instruction_id(k)
                reads, writes = function.instruction_input(k), function.instruction_output(k)
                if operation == ca.OP_OUTPUT:
                    results[writes[1]] = forms[reads[0]].ends
                elif operation == ca.OP_INPUT:
                    slopes = still.copy()
                    slopes[reads[1]] = radii[reads[1]]
                    forms[writes[0]] = _form(centres[reads[1]], slopes, np.zeros(lanes))
                elif operation == ca.OP_CONST:
                    number = np.full(lanes, function.instruction_constant(k))
                    forms[writes[0]] = Form(number, still, np.zeros(lanes))
                else:
                    forms[writes[0]] = _RULES[operation](*(forms[r] for r in reads))
        lower, upper = (np.array([results[k][side] for k in range(len(results))]) for side in (0, 1))
        known = np.isfinite(lower) & np.isfinite(upper)
        return Box(np.where(known, lower, -np.inf), np.where(known, upper, np.inf))
