"""Named signals laid out in one flat vector.

A `Signal` is a short vector with a name, a unit, named elements and a start value. A `Layout`, an ordered set of them, turns names
into places of a flat vector and back, for numbers and CasADi expressions. `Named` gives a vector's elements by attribute: `q.q1`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar
from unicodedata import normalize

import casadi as ca
import numpy as np
import numpy.typing as npt

from fpirhc.errors import InvalidName, InvalidValue, derivative_of, nearest
from fpirhc.symbolic.expression import Expression, Matrix, column

__all__ = ["Expression", "Layout", "Named", "Signal", "like", "scalar", "vector"]


@dataclass(frozen=True, eq=False)
class Signal:
    """A named vector.

    Args:
        name: of the signal.
        elements: names of its entries; empty: a scalar.
        units: one per entry, or one for all; empty: '1'.
        start: first value; empty: zeros.
    """

    name: str
    elements: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    start: tuple[float, ...] = ()

    @cached_property
    def size(self) -> int:
        """Number of entries."""
        return max(1, len(self.elements))

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the entries in a table: 'desired.q1', or the signal's name for a scalar."""
        return tuple([f"{self.name}.{e}" for e in self.elements]) or (self.name,)

    @property
    def entry_units(self) -> tuple[str, ...]:
        """One unit per entry; '1' where the signal has none."""
        units = self.units or ("1",)
        return units if len(units) == self.size else units * self.size

    def start_vector(self) -> np.ndarray:
        """Start value, shape (size,); zeros where the signal has none."""
        return np.array(self.start if self.start else (0.0,) * self.size, dtype=float)


def like(signal: Signal, name: str) -> Signal:
    """Return a signal of the same shape and units under another name."""
    return Signal(name, signal.elements, signal.units)


def scalar(name: str, unit: str = "1", start: float = 0.0) -> Signal:
    """Return a scalar signal."""
    return Signal(name, (), (unit,), (start,))


def vector(name: str, elements: Sequence[str], units: Sequence[str] | str = "1", start: Sequence[float] = ()) -> Signal:
    """Return a vector signal with named elements; one unit serves all."""
    every = (units,) * len(elements) if isinstance(units, str) else tuple(units)
    return Signal(name, tuple(elements), every, tuple(map(float, start)))


class Named:
    """The elements of one vector by name: `q.q1`; `q.vector` is the whole column."""

    __slots__ = ("_elements", "_what", "vector")

    def __init__(self, elements: Sequence[str], column: Expression, what: str = "name") -> None:
        self._elements = tuple(elements)
        self._what = what
        self.vector = column

    def __getattr__(self, name: str) -> Expression:
        if name not in self._elements:  # Python reads identifiers in NFKC: of the micro sign it makes the letter mu
            name = next((e for e in self._elements if normalize("NFKC", e) == name), name)
        return self[name]

    def __getitem__(self, name: str) -> Expression:
        try:
            return self.vector[self._elements.index(name)]
        except ValueError:
            number = f" Entries have names, such as .{self._elements[0]}, no numbers." if isinstance(name, int) else ""
            if (of := derivative_of(str(name))) in self._elements:
                number = f" The derivative of {of} is v.{of}."
            raise InvalidName(f"{self._what} '{name}' is unknown.{number}{nearest(name, self._elements)}") from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._elements)

    def of(self, column: Expression) -> Named:
        """Return another vector with these names."""
        return Named(self._elements, column, self._what)


@dataclass(frozen=True, eq=False)
class Layout:
    """An ordered set of named signals in one flat vector, such as what a `Stepper` reads, remembers and writes.

    `names` are those of the signals, `columns` and `units` those of the entries, `slice(name)` is a signal's place, `size`
    the length of the vector, and `start()` its first value. `pack` makes a vector of numbers by name, and `unpack` undoes it.

        Stepper(problem, controller).reads.columns        ('time', 'state.q1', ...)

    Raises:
        InvalidName: two signals of one name; a name that is not there.
        InvalidValue: start values of another number, or not finite.
    """

    signals: tuple[Signal, ...] = ()
    names: tuple[str, ...] = field(init=False, repr=False)
    size: int = field(init=False, repr=False)
    _slices: dict[str, slice] = field(init=False, repr=False)
    _ends: list[int] = field(init=False, repr=False)  # of the signals, behind a zero
    sizes: ClassVar[dict[str, int]]  # of the signals, by name; every layout has its own, which is no field to be shown

    def __post_init__(self) -> None:
        slices, sizes, at, ends = dict[str, slice](), dict[str, int](), 0, [0]
        for s in self.signals:
            if s.name in slices:
                raise InvalidName(f"signal '{s.name}' appears twice in one layout")
            size = len(s.elements) or 1
            if s.start and len(s.start) != size:
                raise InvalidValue(f"signal '{s.name}' has {size} entries but {len(s.start)} start values")
            if not all(map(math.isfinite, s.start)):
                raise InvalidValue(f"start value of '{s.name}' is not finite: {s.start}")
            slices[s.name], sizes[s.name] = slice(at, at + size), size
            at += size
            ends.append(at)
        # They are asked many times while a loop is composed, so they are plain attributes.
        vars(self).update(names=tuple(slices), size=at, sizes=sizes, _slices=slices, _ends=ends)

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """Names of all entries of the flat vector."""
        return tuple([c for s in self.signals for c in s.columns])

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Units of all entries of the flat vector."""
        return tuple([u for s in self.signals for u in s.entry_units])

    def __getitem__(self, name: str) -> Signal:
        self.slice(name)
        return self.signals[self.names.index(name)]

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and name in self._slices

    def __add__(self, other: Layout) -> Layout:
        return Layout(self.signals + other.signals)

    def slice(self, name: str) -> slice:
        """Place of one signal in the flat vector."""
        try:
            return self._slices[name]
        except (KeyError, TypeError):  # TypeError: a list or a range of numbers
            raise InvalidName(f"signal '{name}' is unknown.{nearest(name, self.names)}") from None

    def start(self) -> np.ndarray:
        """Start values, shape (size,)."""
        return np.concatenate([s.start_vector() for s in self.signals]) if self.signals else np.zeros(0)

    def starting_at(self, values: np.ndarray) -> Layout:
        """The same signals with these start values, shape (size,)."""
        parts = {s.name: tuple(map(float, values[self.slice(s.name)])) for s in self.signals}
        return Layout(tuple(replace(s, start=parts[s.name]) for s in self.signals))

    def pack(self, values: Mapping[str, npt.ArrayLike]) -> np.ndarray:
        """Numbers by name -> flat vector; signals that are not named have their start values."""
        flat = self.start()
        for name, value in values.items():
            place = self.slice(name)
            try:
                entries = np.asarray(value, dtype=float).ravel()
            except (OverflowError, TypeError, ValueError):
                raise InvalidValue(f"signal '{name}' is made of numbers, got {value!r}") from None
            if entries.size != place.stop - place.start:
                raise InvalidValue(f"signal '{name}' has {place.stop - place.start} entries, got {entries.size}")
            flat[place] = entries
        return flat

    def unpack(self, flat: np.ndarray) -> dict[str, np.ndarray]:
        """Flat vector(s), entries along the last axis -> arrays by name."""
        if flat.shape[-1] != self.size:
            raise InvalidValue(f"expected {self.size} entries, got {flat.shape[-1]}")
        return {name: flat[..., place] for name, place in self._slices.items()}

    def split(self, flat: Matrix) -> dict[str, Matrix]:
        """CasADi column -> expressions by name."""
        return dict(zip(self.names, ca.vertsplit(flat, self._ends), strict=True)) if self.signals else {}

    def join(self, expressions: Mapping[str, Matrix]) -> Matrix:
        """CasADi expressions by name -> column, in the layout's order."""
        return column([expressions[name] for name in self.names])
