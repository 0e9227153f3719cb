"""Limits of inputs, states, rates and paths by name. A quantity that is not named is free."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, Self

import numpy as np

from fpirhc.errors import Mistakes
from fpirhc.fields.checked import Checked, fact
from fpirhc.fields.kinds import Positive
from fpirhc.fields.user_code import called, scalar_expression
from fpirhc.plant.motion import derivative_unit
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.expression import Expression, Value
from fpirhc.symbolic.layout import Named

Interval = tuple[float, float]
_FREE = (-math.inf, math.inf)


class OfStage(Protocol):
    """What a limit is given of a stage: the `View` of costs, whose entries have names."""

    state: Named
    input: Named
    input_before: Named
    output: Named
    parameters: Named


@dataclass(frozen=True, eq=False)
class PathConstraint(Checked):
    """A limit on any expression of a stage: lower <= c(x_i, u_i) <= upper in stages i = 0 ... N-1 of a plan, with one scalar c.

    Args:
        expression: function of a View (view.state.q1, view.input.Q1, view.parameters.m1, ...) that returns one scalar.
        lower: lower end of the interval; infinite where free.
        upper: upper end of the interval; infinite where free.
        unit: of the expression.
    """

    expression: Callable[[OfStage], Value]
    lower: float = -math.inf
    upper: float = math.inf
    unit: str = ""

    def named_value(self, name: str, view: object, symbols: Sequence[Expression] = ()) -> Expression:
        """Return the limited scalar of a stage, checked."""
        what = f"limits: paths['{name}']"
        return scalar_expression(what, called(what, self.expression, view), symbols=symbols, finite=False)


@dataclass(frozen=True, eq=False)
class Limits(Checked):
    """Limits of a problem.

    Every controller's command keeps the limits of inputs, and moves in a cycle by no more than hard limits of rates allow. All
    other limits bind an optimiser's plan, at the nodes between its stages; where a stage is many steps of a map, hard limits of
    states and paths hold after each of them.

    Args:
        inputs: intervals (lower, upper) by name of the input.
        states: intervals (lower, upper) by name of the state (q1, q1', ...).
        rates: intervals of the change of inputs per second, from stage to stage of a plan and from cycle to cycle of the command,
            by name of the input.
        paths: limits on expressions of state and input in stages 0 ... N-1; price one of states alone, since stage 0 is measured.
        prices: prices, in cost per second and unit, of limits that are kept wherever that is worth its price (exact penalties, L1),
            by name of a state or path, or by name of an input for its rate. Such a limit is kept exactly while its multiplier is
            below the price. The price is not part of the cost's terms; `Plan.slacks` gives what was paid.
    """

    inputs: Mapping[str, Interval] = field(default_factory=dict)
    states: Mapping[str, Interval] = field(default_factory=dict)
    rates: Mapping[str, Interval] = field(default_factory=dict)
    paths: Mapping[str, PathConstraint] = field(default_factory=dict)
    prices: Mapping[str, Positive] = field(default_factory=dict)

    def check(self, plant: Plant) -> None:
        """Raise if a name is unknown or an interval is empty."""
        mistakes = Mistakes("limits")
        mistakes.unknown("input", self.inputs, plant.inputs)
        mistakes.unknown("state", self.states, plant.state.elements)
        mistakes.unknown("rates: input", self.rates, plant.inputs)
        for name in sorted(self.paths.keys() & {f"{name} rate" for name in self.rates}):
            mistakes.add(f"paths: '{name}' is already the name of the limit in rates; choose another")
        for name, interval in [*self.inputs.items(), *self.states.items(), *self.rates.items()]:
            _check_interval(name, interval, mistakes)
        for name, path in self.paths.items():
            if name in plant.state.elements or name in plant.inputs:
                mistakes.add(f"paths: '{name}' is already the name of a state or input; choose another")
            _check_interval(name, (path.lower, path.upper), mistakes)
        mistakes.unknown("prices: limit of", self.prices, [*self.states, *self.paths, *self.rates])
        mistakes.raise_if_any()

    def boxes(self, plant: Plant) -> dict[str, PathConstraint]:
        """Return the limits of states, which every optimiser keeps as bounds."""
        units = dict(zip(plant.state.elements, plant.state.entry_units, strict=True))
        return {name: PathConstraint(_state(name), *ends, unit=units[name]) for name, ends in self.states.items()}

    def written(self, plant: Plant, step: float) -> dict[str, PathConstraint]:
        """Return rates of inputs, with stages of length `step`, and paths, which a plan writes as further entries of its state."""
        units = {name: derivative_unit(plant.inputs[name], 1, plant.time_unit) for name in self.rates}
        rates = {f"{n} rate": PathConstraint(_rate(n, step), *ends, unit=units[n]) for n, ends in self.rates.items()}
        return {**rates, **self.paths}

    def input_ends(self, plant: Plant) -> tuple[list[float], list[float]]:
        """Lower and upper end of every input, for a step; infinite where free."""
        intervals = [self.inputs.get(name, _FREE) for name in plant.input.elements]
        return [low for low, _ in intervals], [high for _, high in intervals]

    @fact
    def _checked(self) -> Self:
        """These limits with the numbers that were checked."""
        return self

    def input_bounds(self, plant: Plant) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bound of every input, as they were checked, shape (nu,) each; infinite where free."""
        return _bounds(self._checked.inputs, plant.input.elements)

    def rate_bounds(self, plant: Plant) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bound of the change of every input, shape (nu,) each; infinite where free or priced."""
        rates = {name: ends for name, ends in self._checked.rates.items() if name not in self.prices}
        return _bounds(rates, plant.input.elements)

    def state_bounds(self, plant: Plant) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bound of every state, shape (nx,) each; infinite where free."""
        return _bounds(self._checked.states, plant.state.elements)


def _state(name: str) -> Callable[[OfStage], Value]:
    return lambda view: view.state[name]


def _rate(name: str, step: float) -> Callable[[OfStage], Value]:
    return lambda view: (view.input[name] - view.input_before[name]) / step


def _check_interval(name: str, interval: Interval, mistakes: Mistakes) -> None:
    if interval[0] > interval[1]:
        mistakes.add(f"'{name}' has lower {interval[0]} above upper {interval[1]}; swap them")
    elif interval[0] == math.inf or interval[1] == -math.inf:
        mistakes.add(f"'{name}' has limits {tuple(interval)!r} that no number meets; a free side is -inf or inf")


def _bounds(intervals: Mapping[str, Interval], names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    pairs = np.array([intervals.get(n, _FREE) for n in names], dtype=float).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]
