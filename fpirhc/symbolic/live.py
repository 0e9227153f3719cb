"""Numbers that stay open while a loop is built, so that a compiled loop takes other values.

Beside them stand what Python computes from them, and functions that round alike for numbers and expressions: a power is a product,
because the pow of Python and that of CasADi differ in the last digit. Theory: docs/theory.md.
"""

from __future__ import annotations

import math
import operator
from abc import ABC
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from types import FunctionType
from typing import NoReturn, TypeVar, cast
from weakref import WeakValueDictionary

import casadi as ca
import numpy as np

from fpirhc.errors import NotSupported
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar


class SymbolicNumber(ABC):  # noqa: B024 -- a marker without methods
    """A number that is a symbol while blocks are built. Checks of fields accept it wherever they accept a number.

    A bare CasADi symbol is no such number and is refused: nobody would give it a value.
    """


ANEW = "state it in the problem or the controller, and build a loop for each number"  # what to do instead
PREFIX = "setting."  # of the names of signals that are settings
DERIVED = "derived."  # of the paths of numbers that Python computes from settings
T = TypeVar("T")
Kind = TypeVar("Kind", float, ca.SX, ca.MX)
Value = TypeVar("Value", ca.SX, ca.MX)
_Of = Callable[[type], object]  # kind (float, ca.SX or ca.MX) -> number or expression of that kind
_Operation = Callable[[object, object], object]
_LEAVES = {float, int, bool, str, type(None), np.ndarray, FunctionType}
_PLAIN: WeakValueDictionary[int, object] = WeakValueDictionary()  # frozen values without live numbers, by address


class LiveNumber(SymbolicNumber):
    """A number of a setting, or a formula of such numbers.

    Args:
        paths: dotted paths of the settings in it.
        of: function of a kind (float, ca.SX, ca.MX) that returns the number of the build, or the expression of that kind.
    """

    __array_ufunc__ = None  # numpy leaves arithmetic with its arrays to this class, which refuses it
    __slots__ = ("_of", "paths")

    def __init__(self, paths: tuple[str, ...], of: _Of) -> None:
        self.paths = paths
        self._of = of

    @property
    def value(self) -> float:
        """The number with which the loop is built."""
        return self.of(float)

    def of(self, kind: type[Kind]) -> Kind:
        """Return the number of the build (float), or the expression (ca.SX, ca.MX)."""
        return cast(Kind, self._of(kind))

    def __repr__(self) -> str:
        return f"LiveNumber({', '.join(self.paths)})"

    def __SX__(self) -> ca.SX:
        return self.of(ca.SX)

    def __MX__(self) -> ca.MX:
        return self.of(ca.MX)

    def __add__(self, other: object) -> LiveNumber:
        return _combined(operator.add, self, other)

    def __radd__(self, other: object) -> LiveNumber:
        return _combined(operator.add, other, self)

    def __sub__(self, other: object) -> LiveNumber:
        return _combined(operator.sub, self, other)

    def __rsub__(self, other: object) -> LiveNumber:
        return _combined(operator.sub, other, self)

    def __mul__(self, other: object) -> LiveNumber:
        return _combined(operator.mul, self, other)

    def __rmul__(self, other: object) -> LiveNumber:
        return _combined(operator.mul, other, self)

    def __truediv__(self, other: object) -> LiveNumber:
        return _combined(operator.truediv, self, other)

    def __rtruediv__(self, other: object) -> LiveNumber:
        return _combined(operator.truediv, other, self)

    def __pow__(self, exponent: object) -> LiveNumber:
        # A power is a product, which rounds alike everywhere; the pow of Python and that of CasADi differ in the last digit.
        if not isinstance(exponent, int) or exponent < 1:
            self._refuse(f"a power with the exponent {exponent!r}")
        return math.prod([self] * (exponent - 1), start=self)

    def __neg__(self) -> LiveNumber:
        return self.called(operator.neg, operator.neg)

    def __pos__(self) -> LiveNumber:
        return self

    def __abs__(self) -> LiveNumber:
        return self.called(abs, ca.fabs)

    def called(self, number: Callable[[float], float], expression: Callable[[ca.SX], object]) -> LiveNumber:
        """Return a function of it: `number` for the number of the build, `expression` for CasADi."""
        return LiveNumber(
            self.paths, lambda kind: number(self.value) if kind is float else expression(cast(ca.SX, self._of(kind)))
        )

    def __float__(self) -> NoReturn:
        self._refuse("its number")

    def __int__(self) -> NoReturn:
        self._refuse("its number")

    __index__ = __trunc__ = __floor__ = __ceil__ = __int__

    def __bool__(self) -> NoReturn:
        self._refuse("a branch on its number")

    def __eq__(self, other: object) -> bool:
        if isinstance(other, LiveNumber):
            return self is other
        if isinstance(other, int | float):
            self._refuse("a branch on its number")
        return NotImplemented

    __hash__ = object.__hash__

    def __lt__(self, other: object) -> NoReturn:
        self._refuse("a branch on its number")

    __le__ = __gt__ = __ge__ = __lt__

    def __mod__(self, other: object) -> NoReturn:
        self._refuse("its number")

    __rmod__ = __floordiv__ = __rfloordiv__ = __rpow__ = __mod__

    def __round__(self, digits: int | None = None) -> NoReturn:
        self._refuse("its number")

    def __format__(self, style: str) -> NoReturn:
        self._refuse("its number in a text")

    def _refuse(self, what: str) -> NoReturn:
        raise not_live(self.paths, f"{what} is needed while the loop is built; {ANEW}", " here")


Number = float | LiveNumber  # a field that may be live


def not_live(paths: Iterable[str], why: str, where: str = "") -> NotSupported:
    """Return the error of settings that cannot be live, with the reason; `where` says in which case they cannot, after a space."""
    names = [f"'{path}'" for path in paths]
    return NotSupported(f"setting{'s' if len(names) > 1 else ''} {', '.join(names)} cannot be live{where}: {why}")


def live_number(path: str, value: float) -> LiveNumber:
    """Return the live number of one setting, with its number of the build."""
    symbols: dict[type, object] = {ca.SX: ca.SX.sym(PREFIX + path), ca.MX: ca.MX.sym(PREFIX + path)}
    return LiveNumber((path,), lambda kind: float(value) if kind is float else symbols[kind])


def _expressed(value: object, kind: type) -> object:
    """A number of a step as an expression of that kind; what is no live number stays as it is."""
    return value._of(kind) if isinstance(value, LiveNumber) else value


def expressed(value: float | LiveNumber, beside: Value) -> Value:
    """Return a number as an expression of the kind of another one; a number that is not live stays as it is."""
    return cast(Value, _expressed(value, type(beside)))


def nominal(value: T) -> T:
    """Return a value with the numbers of the build in place of all live numbers in it; the value itself where it has none.

    Dataclasses, mappings and tuples are searched. Copies are made without validation, because their numbers were valid before.
    """
    return cast(T, _mapped(value, lambda number: number.value))


def live_numbers(*values: object) -> dict[str, LiveNumber]:
    """Return the live numbers in some values, by path."""
    numbers: dict[str, LiveNumber] = {}

    def note(number: LiveNumber) -> LiveNumber:
        numbers.setdefault(number.paths[0], number)
        return number

    for value in values:
        _mapped(value, note)
    return numbers


def is_live(*values: object) -> bool:
    """Return whether a live number stands in one of the values."""
    return bool(live_numbers(*values))


def settled(value: T, numbers: Mapping[str, float]) -> T:
    """Return a value with other numbers, by path, in place of live numbers; the others have the number of the build."""
    return cast(T, _mapped(value, lambda number: numbers.get(number.paths[0], number.value)))


def copied(value: T, changes: Mapping[str, object]) -> T:
    """Return a frozen dataclass with other contents of some fields, without validation and without cached facts."""
    copy = object.__new__(type(value))
    for one in fields(value):  # type: ignore[arg-type]  # mypy does not narrow type variables
        object.__setattr__(copy, one.name, changes.get(one.name, getattr(value, one.name)))
    return copy


def _mapped(value: object, change: Callable[[LiveNumber], object]) -> object:
    """The value with `change` applied to its live numbers; the same object where it has none."""
    return _changed(value, change) if type(value) not in _LEAVES and _has_live(value) else value


def _changed(value: object, change: Callable[[LiveNumber], object]) -> object:
    if isinstance(value, LiveNumber):
        return change(value)
    if isinstance(value, Mapping):
        return {key: _mapped(entry, change) for key, entry in value.items()}
    if isinstance(value, tuple | list):
        return type(value)([_mapped(entry, change) for entry in value])
    contents = {f.name: getattr(value, f.name) for f in fields(value)}  # type: ignore[arg-type]  # a dataclass
    changed = {name: _mapped(content, change) for name, content in contents.items()}
    same = all(changed[name] is content for name, content in contents.items())
    return value if same else copied(value, changed)


def _has_live(value: object) -> bool:
    """Whether a live number stands in a value. Frozen ones that have none are remembered: most are searched many times."""
    if isinstance(value, LiveNumber):
        return True
    parts: Iterable[object]
    if isinstance(value, Mapping):
        parts = value.values()
    elif isinstance(value, tuple | list):
        parts = value
    elif is_dataclass(value) and not isinstance(value, type):
        if _PLAIN.get(id(value)) is value:
            return False
        parts = [getattr(value, f.name) for f in fields(value)]
    else:
        return False
    for part in parts:
        if type(part) not in _LEAVES and _PLAIN.get(id(part)) is not part and _has_live(part):
            return True
    if is_dataclass(value):
        _PLAIN[id(value)] = value
    return False


def _combined(operation: _Operation, left: object, right: object) -> LiveNumber:
    """A formula of live numbers and numbers; where one side is an expression, an expression under the same type."""
    live = [side for side in (left, right) if isinstance(side, LiveNumber)]
    for side in (left, right):
        if isinstance(side, ca.SX | ca.MX):
            kind = type(side)
            return cast(LiveNumber, operation(_expressed(left, kind), _expressed(right, kind)))
        if isinstance(side, ca.DM):
            return cast(LiveNumber, operation(_expressed(left, ca.SX), _expressed(right, ca.SX)))
        if isinstance(side, np.ndarray):
            live[0]._refuse("an array of numbers")
        if not isinstance(side, LiveNumber | int | float | np.number):
            return NotImplemented
    paths = tuple(dict.fromkeys(path for side in live for path in side.paths))
    return LiveNumber(paths, lambda kind: operation(_expressed(left, kind), _expressed(right, kind)))


Values = Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Derived:
    """Numbers that follow from the settings outside the loop."""

    # values of signals 'setting.derived.NAME', by their names
    signals: Mapping[str, np.ndarray] = field(default_factory=dict)
    # function that returns values of remembered signals at the start of a run, by their names; a change during a run does
    # not need them
    memory: Callable[[], Mapping[str, np.ndarray]] = dict
    # the effect of running a deployed build with the outdated value of a signal, by name, for a device without Python; ''
    # where it must not
    stale: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Following:
    """A column of numbers that follows from live settings."""

    signal: Signal  # that the block reads, with the numbers of the build as its start
    settings: Mapping[str, LiveNumber]  # from which it follows, by path
    of: Callable[[Values], np.ndarray]  # function of the numbers of all settings, by path, that returns the column
    stale: str  # what becomes of a loop that goes on with the old column; '' where it must not, see `Derived`

    @property
    def reads(self) -> Layout:
        """The signal, and the settings themselves, for a block that does not use these by itself."""
        own = tuple(scalar(PREFIX + path, start=number.value) for path, number in self.settings.items())
        return Layout((self.signal, *own))

    def derived(self, values: Values) -> Derived:
        """Return the column for these numbers of the settings."""
        return Derived({self.signal.name: self.of(values)}, stale={self.signal.name: self.stale})


def remembered(name: str, elements: Sequence[str], values: Sequence[float]) -> Layout:
    """Return the signal in which a block remembers numbers, to notice a change; none where no run changes them."""
    return Layout((Signal(name, tuple(elements), start=(1.0,) * len(values)),)) if is_live(values) else Layout()


def following(
    name: str, settings: Mapping[str, LiveNumber], of: Callable[[Values], np.ndarray], stale: str = ""
) -> Following | None:
    """Return the column that `of` computes from live settings; None where there are none."""
    if not settings:
        return None
    start = of({path: number.value for path, number in settings.items()})
    elements = tuple(str(k) for k in range(start.size))
    signal = Signal(f"{PREFIX}{DERIVED}{next(iter(settings))}.{name}", elements, start=tuple(map(float, start)))
    return Following(signal, settings, of, stale)


SMOOTHING = 1e-6  # half width, in the unit of the argument, within which the power is rounded off around zero
_Two = Callable[..., object]


def signed_power(d: Expression, exponent: Expression | float) -> Expression:
    """Return sign(d) |d|^exponent, rounded off within 1e-6 of zero so that its derivatives stay finite.

    Computed as d (d^2 + 1e-12)^((exponent - 1)/2).
    """
    return d * ca.exp((exponent - 1) / 2 * ca.log(d * d + SMOOTHING**2))


def power(base: T, exponent: int) -> T | float:
    """Return base^exponent as a product; 1.0 for the exponent 0."""
    return math.prod([base] * (exponent - 1), start=base) if exponent else 1.0  # type: ignore[call-overload]


def _nearest_even(x: Expression) -> Expression:
    upper = ca.floor(x + 0.5)
    return upper - ca.logic_and(upper - x == 0.5, ca.fmod(upper, 2) != 0)


def _of_any(number: Callable[[float], float], expression: Callable[..., object]) -> Callable[[float], float]:
    """A function of a number, live or not."""
    return lambda x: x.called(number, expression) if isinstance(x, LiveNumber) else number(x)


tanh, atanh, asin = _of_any(math.tanh, ca.tanh), _of_any(math.atanh, ca.atanh), _of_any(math.asin, ca.asin)
exp, cos, sqrt = _of_any(math.exp, ca.exp), _of_any(math.cos, ca.cos), _of_any(math.sqrt, ca.sqrt)
rounded = _of_any(round, _nearest_even)


def signed(size: float, sign: float) -> float:
    """Return the size of a number, live or not, with the sign of another one."""
    if isinstance(sign, LiveNumber):
        sign = sign.called(lambda x: math.copysign(1.0, x), lambda x: ca.if_else(x < 0, -1, 1))
        return abs(size) * sign
    return math.copysign(1.0, sign) * abs(size)


def numbers(values: Sequence[float | LiveNumber], beside: Expression | None = None) -> Expression:
    """Return a column of numbers: constants, or an expression where some are live, of the kind of another one where it is given."""
    if not is_live(values):
        return cast(Expression, ca.DM(cast(list[float], list(values))))
    return cast(Expression, ca.vertcat(*(values if beside is None else (expressed(value, beside) for value in values))))


def overlaid(column: Expression, values: Sequence[float | LiveNumber]) -> list[Expression]:
    """Return the entries of a column that holds some numbers, with the live ones themselves in their places."""
    return [expressed(v, column) if isinstance(v, LiveNumber) else column[k] for k, v in enumerate(values)]


def quotient(over: Expression, number: float | LiveNumber) -> Expression:
    """Return an expression divided by a number, live or not; zero where the number is zero."""
    if not isinstance(number, LiveNumber):
        return over / number if number else 0 * over
    under = expressed(number, over)
    return ca.if_else(under == 0, 0 * over, over / ca.if_else(under == 0, 1, under))


def between(x: float, low: float, high: float) -> float:
    """Return a number, live or not, moved to the nearer end of an interval where it is outside."""
    if isinstance(x, LiveNumber):
        return x.called(lambda v: min(max(low, v), high), lambda v: ca.fmin(ca.fmax(low, v), high))
    return min(max(low, x), high)


def smaller(x: float, y: float) -> float:
    """Return the smaller of two numbers, live or not."""
    return _of_both(x, y, min, ca.fmin)


def larger(x: float, y: float) -> float:
    """Return the larger of two numbers, live or not."""
    return _of_both(x, y, max, ca.fmax)


def stays(x: float, value: float) -> bool:
    """Return whether a number is a certain one in every run of the loop; a live one may become another."""
    return not isinstance(x, LiveNumber) and x == value


def left_after(period: float, time: float) -> float:
    """Return e^(-T / tau), the share of a distance that is left after a period; 0 for the time constant 0, which may be live."""
    if isinstance(time, LiveNumber):
        return time.called(
            lambda t: left_after(period, t), lambda t: ca.if_else(t == 0, 0, ca.exp(-period / ca.if_else(t == 0, 1, t)))
        )
    return math.exp(-period / time) if time else 0.0


def left_in_mean(period: float, time: float) -> float:
    """Return the mean of what is left over a period, (tau / T) (1 - e^(-T / tau)); 0 for tau = 0, which may be live."""
    if isinstance(time, LiveNumber):
        return time.called(
            lambda t: left_in_mean(period, t),
            lambda t: ca.if_else(t == 0, 0, t / period * -ca.expm1(-period / ca.if_else(t == 0, 1, t))),
        )
    return time / period * -math.expm1(-period / time) if time else 0.0


def _of_both(x: float, y: float, number: _Two, expression: _Two) -> float:
    if not isinstance(x, LiveNumber) and not isinstance(y, LiveNumber):
        return cast(float, number(x, y))
    paths = tuple(dict.fromkeys(path for one in (x, y) if isinstance(one, LiveNumber) for path in one.paths))
    both = lambda kind: tuple(one.of(kind) if isinstance(one, LiveNumber) else one for one in (x, y))  # noqa: E731
    return LiveNumber(paths, lambda kind: (number if kind is float else expression)(*both(kind)))


def nan_where(failed: Expression) -> Expression:
    """Return NaN where a condition (1 or 0) holds, and zero elsewhere.

    It is computed, because the constant NaN in a loop is the mark of a live setting that was lost. Its derivative is zero where
    the condition does not hold, so it spoils no gradient there.
    """
    return ca.asin(2 * failed)


def entry_at(values: Expression, place: Expression) -> Expression:
    """Return the entry of a column at a place that is known at run time; zero beyond its ends.

    Every entry is looked at. CasADi's scalar code has no table, and an entry that is not taken does not spoil the sum.
    """
    entries = ca.vertsplit(values)
    return cast(Expression, sum(ca.if_else(place == k, one, 0) for k, one in enumerate(entries)))
