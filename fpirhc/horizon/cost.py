"""Costs along a horizon.

The cost of a plan is V = sum_{i<N} step l(s_i, u_i, t_i) + T(s_N, t_N): a stage cost, given as a rate and made of named terms,
and a terminal cost.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from numbers import Real

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidProblem, Mistakes
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.expression import total
from fpirhc.symbolic.layout import Expression, Named


@dataclass(frozen=True, eq=False)
class View:
    """What a stage shows its cost, each by name: view.state.q1, view.reference["q1'"], view.input.Q1, ..."""

    state: Named
    reference: Named
    input: Named
    input_before: Named
    feedforward: Named
    parameters: Named
    time: Expression


@dataclass(frozen=True, eq=False)
class Linearisation:
    """The model over one stage around the first reference point: s+ = A s + B u, with the step in s."""

    a: np.ndarray
    b: np.ndarray
    step: float


class Terminal(ABC):
    """Contract: a terminal cost that is computed from the problem."""

    @abstractmethod
    def weight(self, cost: Quadratic, plant: Plant, linearisation: Linearisation) -> np.ndarray:
        """Return the symmetric weight P of (x - x^N)' P (x - x^N), shape (nx, nx)."""


class Cost(ABC):
    """Contract: named stage terms and a terminal cost, as CasADi expressions."""

    @property
    def weighs_effort(self) -> bool:
        """Whether a term is known to weigh the inputs themselves, and not what they differ by from a feedforward."""
        return False

    @property
    @abstractmethod
    def uses_rate(self) -> bool:
        """Whether a term needs the previous input (which then becomes part of the stage's state)."""

    @property
    @abstractmethod
    def uses_feedforward(self) -> bool:
        """Whether a term needs the model's input along the reference."""

    @abstractmethod
    def check(self, plant: Plant) -> None:
        """Raise InvalidProblem with all mistakes of the cost for this plant."""

    @abstractmethod
    def stage(self, view: View) -> Mapping[str, Expression]:
        """Return the stage cost's terms, each as cost per second."""

    @abstractmethod
    def terminal_cost(
        self, view: View, plant: Plant, linearise: Callable[[], Linearisation], step: float
    ) -> Expression:
        """Return the terminal cost."""


@dataclass(frozen=True, eq=False)
class Quadratic(Cost):
    """Weighted squares, by name.

        l = sum w (x - x^N)^2 + sum w u^2 + sum w (u - u^ff)^2 + sum w (u_i - u_{i-1})^2

    Parameters:
        states: weights of the state errors (q1, q1', ...).
        effort: weights of the absolute inputs.
        deviation: weights of the inputs relative to the model's feedforward along the reference. With a wrong model
            prefer it to `effort`: absolute effort biases the plan towards the wrong model's effort.
        rate: weights of the change of the inputs from stage to stage.
        terminal: None (the state weights at the last state, times the step), weights by state name, or LQRTerminal().
    """

    states: Mapping[str, float]
    effort: Mapping[str, float] = field(default_factory=dict)
    deviation: Mapping[str, float] = field(default_factory=dict)
    rate: Mapping[str, float] = field(default_factory=dict)
    terminal: Mapping[str, float] | Terminal | None = None

    @property
    def weighs_effort(self) -> bool:
        """Whether `effort` has weights."""
        return bool(self.effort)

    @property
    def uses_rate(self) -> bool:
        """Whether the change of some input is weighed."""
        return bool(self.rate)

    @property
    def uses_feedforward(self) -> bool:
        """Whether some input is weighed relative to the feedforward."""
        return bool(self.deviation)

    def check(self, plant: Plant) -> None:
        """Raise if a name is unknown or a weight is negative or not finite.

        Raises:
            InvalidProblem: all mistakes together.
        """
        mistakes = Mistakes("cost")
        given = self.terminal if isinstance(self.terminal, Mapping) else {}
        groups = {
            "states": (self.states, plant.state.elements),
            "effort": (self.effort, plant.input.elements),
            "deviation": (self.deviation, plant.input.elements),
            "rate": (self.rate, plant.input.elements),
            "terminal": (given, plant.state.elements),
        }
        for what, (weights, valid) in groups.items():
            mistakes.unknown(f"{what}:", weights, valid)
            for name, weight in weights.items():
                if not isinstance(weight, Real) or not math.isfinite(weight) or weight < 0:
                    mistakes.add(
                        f"{what}: the weight of '{name}' must be a finite number of at least 0, got {weight!r}"
                    )
        if not any(w for weights, _ in groups.values() for w in weights.values()):
            mistakes.add("every weight is zero, so every plan is optimal; weigh at least one state")
        mistakes.raise_if_any()

    def stage(self, view: View) -> dict[str, Expression]:
        """Return the terms 'states', and 'effort', 'deviation', 'rate' where weighed."""
        terms = {"states": _squares(self.states, view.state, view.reference)}
        if self.effort:
            terms["effort"] = total(w * view.input[n] ** 2 for n, w in self.effort.items())
        if self.deviation:
            terms["deviation"] = _squares(self.deviation, view.input, view.feedforward)
        if self.rate:
            terms["rate"] = _squares(self.rate, view.input, view.input_before)
        return terms

    def terminal_cost(
        self, view: View, plant: Plant, linearise: Callable[[], Linearisation], step: float
    ) -> Expression:
        """Return the terminal cost (x - x^N)' P (x - x^N)."""
        if self.terminal is None:
            return step * _squares(self.states, view.state, view.reference)
        if isinstance(self.terminal, Mapping):
            return _squares(self.terminal, view.state, view.reference)
        weight = self.terminal.weight(self, plant, linearise())
        error = view.state.vector[: plant.state.size] - view.reference.vector
        return ca.bilin(ca.DM(weight), error, error)


@dataclass(frozen=True)
class LQRTerminal(Terminal):
    """The infinite-horizon weight: P of the discrete algebraic Riccati equation, from the linearised model.

    It makes a short horizon act like an endless one near the reference. `control` is used to solve the equation.
    """

    def weight(self, cost: Quadratic, plant: Plant, linearisation: Linearisation) -> np.ndarray:
        """Return P.

        Raises:
            InvalidProblem: no input is weighed, or the linearised model cannot be stabilised.
        """
        import control

        h = linearisation.step
        q = np.diag([h * cost.states.get(e, 0.0) for e in plant.state.elements])
        r = np.diag([h * (cost.effort.get(i, 0.0) + cost.deviation.get(i, 0.0)) for i in plant.input.elements])
        if np.any(np.diag(r) <= 0):
            raise InvalidProblem("LQRTerminal needs a positive effort or deviation weight for every input")
        try:
            weight, _, _ = control.dare(linearisation.a, linearisation.b, q, r)
        except (np.linalg.LinAlgError, control.ControlArgument, ValueError) as error:
            raise InvalidProblem(f"LQRTerminal: the linearised model has no stabilising solution ({error})") from None
        return np.asarray(weight)


@dataclass(frozen=True, eq=False)
class CustomCost(Cost):
    """Any CasADi cost.

    Parameters:
        terms: function of a View that returns {term: cost per second}.
        terminal: function of a View that returns the terminal cost, or None for none.
        rate: whether `terms` uses view.input_before. feedforward: whether it uses view.feedforward.
    """

    terms: Callable[[View], Mapping[str, Expression]]
    terminal: Callable[[View], Expression] | None = None
    rate: bool = False
    feedforward: bool = False

    @property
    def uses_rate(self) -> bool:
        """As given."""
        return self.rate

    @property
    def uses_feedforward(self) -> bool:
        """As given."""
        return self.feedforward

    def check(self, plant: Plant) -> None:
        """Nothing can be said before the terms are built."""

    def stage(self, view: View) -> Mapping[str, Expression]:
        """Return the user's terms."""
        return self.terms(view)

    def terminal_cost(
        self,
        view: View,
        plant: Plant,  # noqa: ARG002
        linearise: Callable[[], Linearisation],  # noqa: ARG002
        step: float,  # noqa: ARG002
    ) -> Expression:
        """Return the user's terminal cost, or zero."""
        return ca.SX(0) if self.terminal is None else self.terminal(view)


def _squares(weights: Mapping[str, float], value: Named, target: Named) -> Expression:
    return sum((w * (value[n] - target[n]) ** 2 for n, w in weights.items()), start=ca.SX(0))
