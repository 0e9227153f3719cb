"""Limits of inputs, states, rates and paths by name. A quantity that is not named is free."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.fields.checked import Checked
from fpirhc.fields.expected import takes
from fpirhc.fields.kinds import finite_number
from fpirhc.fields.user_code import called, scalar_expression
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.expression import Expression, Value
from fpirhc.symbolic.live import nominal

Interval = tuple[float, float]


@dataclass(frozen=True, eq=False)
class PathConstraint(Checked):
    """A limit on any expression of a stage.

    Args:
        expression: function of a View (view.state.q1, view.input.Q1, view.parameters.m1, ...) that returns one scalar.
        lower: lower end of the interval; infinite where free.
        upper: upper end of the interval; infinite where free.
        unit: of the expression.
    """

    expression: Callable[..., Value]
    lower: float = -math.inf
    upper: float = math.inf
    unit: str = ""

    def __post_init__(self) -> None:
        if not takes(self.expression, 1):
            raise InvalidValue("PathConstraint.expression: expected a function of 1 argument, the view of a stage")

    def value(self, name: str, view: object, symbols: Sequence[Expression] = ()) -> Expression:
        """Return the limited expression of a stage.

        Args:
            name: of the constraint.
            view: of the stage.
            symbols: those that the view is made of; without them any.

        Raises:
            InvalidProblem: the function fails, or does not give one scalar.
        """
        what = f"limits: paths['{name}']"
        return scalar_expression(what, called(what, self.expression, view), symbols=symbols, finite=False)


@dataclass(frozen=True, eq=False)
class Limits(Checked):
    """Limits of a problem.

    The plant's actuator clips the inputs to their limits. All other limits bind an optimiser's plan.

    Args:
        inputs: intervals (lower, upper) by name of the input.
        states: intervals (lower, upper) by name of the state (q1, q1', ...).
        rates: intervals of the change of inputs from stage to stage, per second, by name of the input.
        paths: named limits on expressions of state and input in stages 0 ... N-1.
        soft: weights, in cost per second and unit squared, of limits that may be violated at that price, by name of a state or
            path, or by name of an input for its rate. The cost then has the term 'soft NAME'.
        prices: prices, in cost per second and unit, of limits that are kept wherever that is worth its price (exact penalties, L1);
            by the same names. Such a limit is kept exactly while its multiplier is below the price. The price is not part of the
            cost's terms; `Plan.slacks` gives what was paid.
    """

    inputs: Mapping[str, Interval] = field(default_factory=dict)
    states: Mapping[str, Interval] = field(default_factory=dict)
    rates: Mapping[str, Interval] = field(default_factory=dict)
    paths: Mapping[str, PathConstraint] = field(default_factory=dict)
    soft: Mapping[str, float] = field(default_factory=dict)
    prices: Mapping[str, float] = field(default_factory=dict)

    def check(self, plant: Plant) -> None:
        """Raise if a name is unknown or an interval is empty.

        Raises:
            InvalidProblem: all mistakes together.
        """
        nominal(self)._check(plant)

    def _check(self, plant: Plant) -> None:
        mistakes = Mistakes("limits")
        mistakes.unknown("input", self.inputs, plant.inputs)
        mistakes.unknown("state", self.states, plant.state.elements)
        mistakes.unknown("rates: input", self.rates, plant.inputs)
        mistakes.unknown("soft: limit of", self.soft, [*self.states, *self.paths, *self.rates])
        for name, interval in [*self.inputs.items(), *self.states.items(), *self.rates.items()]:
            _check_interval(name, interval, mistakes)
        for name, path in self.paths.items():
            if name in plant.state.elements or name in plant.inputs:
                mistakes.add(f"paths: '{name}' is already the name of a state or input; choose another")
            _check_interval(name, (path.lower, path.upper), mistakes)
        mistakes.unknown("prices: limit of", self.prices, [*self.states, *self.paths, *self.rates])
        for name in sorted(self.prices.keys() & self.soft.keys()):
            mistakes.add(f"'{name}' is both soft and priced; choose one")
        for name, price in self.prices.items():
            if not finite_number(price) or not 0 < price < math.inf:
                mistakes.add(f"prices: the price of '{name}' must be a positive number, got {price!r}")
        for name, weight in self.soft.items():
            if not finite_number(weight) or not 0 < weight < math.inf:
                mistakes.add(f"soft: the weight of '{name}' must be a positive number, got {weight!r}")
        mistakes.raise_if_any()

    def input_ends(self, plant: Plant) -> tuple[list[float], list[float]]:
        """Lower and upper end of every input, which may be live numbers; infinite where free."""
        free = (-math.inf, math.inf)
        intervals = [self.inputs.get(name, free) for name in plant.input.elements]
        return [low for low, _ in intervals], [high for _, high in intervals]

    def input_bounds(self, plant: Plant) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bound of every input, shape (nu,) each; infinite where free."""
        return _bounds(self.inputs, plant.input.elements)

    def state_bounds(self, plant: Plant) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bound of every state, shape (nx,) each; infinite where free."""
        return _bounds(self.states, plant.state.elements)


def _check_interval(name: str, interval: object, mistakes: Mistakes) -> None:
    if not isinstance(interval, Sequence) or len(interval) != 2:
        mistakes.add(f"'{name}' needs two numbers (lower, upper), got {interval!r}")
    elif interval[0] > interval[1]:
        mistakes.add(f"'{name}' has lower {interval[0]} above upper {interval[1]}; swap them")
    elif interval[0] == math.inf or interval[1] == -math.inf:
        mistakes.add(
            f"'{name}' has limits {tuple(interval)!r} that no number meets; a free side is -inf below, inf above"
        )


def _bounds(intervals: Mapping[str, Interval], names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    free = (-math.inf, math.inf)
    pairs = np.array([intervals.get(n, free) for n in names], dtype=float).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]
