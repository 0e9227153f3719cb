"""A horizon and its stages, and costs along it.

The cost of a plan is V = sum_{i<N} step l(s_i, u_i, t_i) + T(s_N, t_N): a stage cost, which is a rate with named terms, and a
terminal cost.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidProblem, InvalidValue, Mistakes
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import AtLeastOne, Count, Duration, NotNegative, described
from fpirhc.fields.user_code import called
from fpirhc.plant.integrators import USUAL, Integrator
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import total
from fpirhc.symbolic.layout import Expression, Named, Signal


@dataclass(frozen=True)
class Horizon(Checked):
    """Length and stages of a controller's prediction.

    Args:
        stages: number of stages N.
        step: length of one stage, s, over which the input is constant.
        discretisation: RungeKutta4() or Collocation() over one stage; a map has none: a stage is a whole number of its steps.
        lengths: of the stages, as multiples of `step`, which is that of the first one: fine stages first. One number of at least
            1 for every stage, a whole one on a map; empty: all stages are equal. Every stage counts with its length in the cost,
            limits and costs of input changes with the time since the change before. Prices of limits count every node alike.
        blocks: lengths of blocks of stages over which the inputs are held (move blocking); they add up to the stages. Empty: every
            stage has inputs of its own.
        margins: by name of a state, the distance by which a plan stays inside the state's limits, in the state's unit: room for
            what the model does not predict. The problem's limits stay as they are for the run and its metrics.
        replan: when the next plan is made: after one "stage", after one control "cycle", or after so many cycles, at most those of
            a stage. Where a plan follows sooner than a stage, the horizon begins at the cycle's own time, the last plan is
            interpolated to the new stages, and the change of the first input counts with the time that it takes: the limit of
            its rate holds from plan to plan, and its cost is stages per plan times that of a later change. More plans on long
            stages do not lower the error of a wrong model; a first stage of one cycle and `lengths` that grow do.
        share: of a stage, the time from plan to plan. Controllers fill it in from `replan`.
        measured: names of states whose limits hold for the measured state: for the plan's plus the distance of the measured one
            from the plan's start. Controllers fill it in where a plan starts elsewhere, see `fpirhc.horizon.nominal`.

    Raises:
        InvalidValue: fewer than one stage, a step that is not positive, blocks that do not add up, a margin that is not
            a finite number of at least 0, or plans that follow in no whole number of cycles.
    """

    stages: Count
    step: Duration
    discretisation: Integrator = USUAL
    blocks: tuple[Count, ...] = ()
    margins: Mapping[str, NotNegative] = field(default_factory=dict, hash=False)
    lengths: tuple[AtLeastOne, ...] = field(default=(), kw_only=True)
    measured: tuple[str, ...] = field(default=(), kw_only=True)
    replan: Literal["stage", "cycle"] | Count = field(default="stage", kw_only=True)
    share: float = field(default=1.0, kw_only=True)

    def __post_init__(self) -> None:
        for name in ("blocks", "lengths", "measured"):  # an array is neither true nor equal to another
            object.__setattr__(self, name, tuple(np.asarray(getattr(self, name), dtype=object).tolist()))
        if self.lengths and (len(self.lengths) != self.stages or self.lengths[0] != 1):
            raise InvalidValue(
                f"horizon: lengths must be {self.stages} finite numbers of at least 1, one for every stage in steps of the first, "
                f"which is 1; got {described(self.lengths)}"
            )
        if self.blocks and sum(self.blocks) != self.stages:
            raise InvalidValue(f"horizon: blocks {self.blocks} add up to {sum(self.blocks)}, expected {self.stages}")

    @property
    def relative_lengths(self) -> np.ndarray:
        """Lengths of the stages in steps of the first one, shape (N,)."""
        return np.array(self.lengths) if self.lengths else np.ones(self.stages)

    @property
    def nodes(self) -> np.ndarray:
        """Times of s_0 ... s_N from the start, shape (N + 1,), in the plant's unit of time."""
        if not self.lengths:
            return np.arange(self.stages + 1) * self.step
        return np.concatenate([[0.0], np.cumsum(self.lengths)]) * self.step

    @property
    def longest(self) -> float:
        """Length of the longest stage."""
        return self.step * max(self.lengths, default=1.0)

    @property
    def last(self) -> float:
        """Length of the last stage."""
        return self.step * (self.lengths[-1] if self.lengths else 1.0)


@dataclass(frozen=True, eq=False)
class View:
    """Arguments of a stage's cost, with entries by name: view.state.q1, view.reference["q1'"], view.input.Q1."""

    state: Named  # the plant's state
    reference: Named  # nominal state; of a plant with outputs, the nominal outputs and their derivatives
    input: Named  # input of the stage
    # input of the stage before; where the stage has another length than `step`, an input from which the change is as large as in
    # that time, so that rates are the same
    input_before: Named
    feedforward: Named  # the model's input along the reference
    parameters: Named  # of the model
    time: Expression  # in the problem's unit of time
    output: Named  # the model's outputs and their derivatives, view.output.bis; the state of a plant without outputs
    outside: Named  # signals from outside at this stage, as the controllers know them, view.outside.price


def view_of(
    plant: Plant,
    x: Expression,
    u: Expression,
    p: Expression,
    t: Expression,
    *,
    before: Expression | None = None,
    reference: Expression | None = None,
    feedforward: Expression | None = None,
    output: Expression | None = None,
) -> View:
    """Return the view of a stage; the output is the model's where it is not given, and what else is not given is NaN."""

    def named(signal: Signal, vector: Expression | None, what: str = "") -> Named:
        return Named(signal.elements, ca.SX.nan(signal.size) if vector is None else vector, what or signal.name)

    now, past, known = (named(plant.input, v, "input") for v in (u, before, feedforward))
    state, wanted, given = (
        named(plant.state, x, "state"),
        named(plant.output, reference),
        named(plant.parameter, p, "parameter"),
    )
    shown = named(plant.output, outputs_of(plant, x, u, p) if output is None else output)
    outside = Named(names := plant.outside, ca.vertcat(*(given[n] for n in names)), "signal from outside")
    return View(state, wanted, now, past, known, given, t, shown, outside)


def outputs_of(plant: Plant, x: Expression, u: Expression, p: Expression) -> Expression:
    """The model's outputs and their derivatives at a stage; the state without outputs."""
    return plant.equations.output(x, u, p, ca.SX.zeros(len(plant.names)))


def view_of_symbols(plant: Plant) -> View:
    """Return a view whose entries are symbols."""
    (x, u, p), output = plant.symbols(), plant.output.size
    others = {name: ca.SX.sym(name, u.numel()) for name in ("before", "feedforward")}
    others |= {name: ca.SX.sym(name, output) for name in ("reference", "output")}
    return view_of(plant, x, u, p, ca.SX.sym("t"), **others)


def reads_feedforward(plant: Plant, cost: Cost) -> bool:
    """Return whether a term of a cost reads the feedforward."""

    def read() -> bool:
        view = view_of_symbols(plant)
        column = ca.vertcat(*(ca.vec(ca.SX(value)) for value in cost.stage(view).values()))
        return bool(ca.depends_on(column, view.feedforward.vector))

    return _READ.of((plant.equations, cost), (), read)


_READ: Latest[bool] = Latest(16)


@dataclass(frozen=True, eq=False)
class Linearisation:
    """The model over one stage around the first reference point, s+ = A s + B u."""

    a: np.ndarray  # shape (nx, nx)
    b: np.ndarray  # shape (nx, nu)
    step: float  # length of the stage, in the problem's unit of time


@dataclass(frozen=True)
class LQRTerminal(Checked):
    """The infinite-horizon weight: P of the discrete algebraic Riccati equation, from the linearised model.

    Near the reference a short horizon then acts like an infinite one.
    """

    def weight(self, cost: Quadratic, plant: Plant, linearisation: Linearisation) -> np.ndarray:
        """Return P.

        Raises:
            InvalidProblem: no input is weighed, or its rate is, or the linearised model cannot be stabilised.
        """
        from scipy.linalg import solve_discrete_are  # only here: the import takes long

        h = linearisation.step
        q = np.diag([h * cost.states.get(e, 0.0) for e in plant.state.elements])
        r = np.diag([h * (cost.effort.get(i, 0.0) + cost.deviation.get(i, 0.0)) for i in plant.input.elements])
        if np.any(np.diag(r) <= 0) or cost.rate:
            raise InvalidProblem(
                "LQRTerminal needs a positive effort or deviation weight for every input, and none of a rate"
            )
        try:
            return np.asarray(solve_discrete_are(linearisation.a, linearisation.b, q, r))
        except ValueError as error:  # LinAlgError is one
            raise InvalidProblem(f"LQRTerminal: the linearised model has no stabilising solution ({error})") from None


class Cost(Checked, ABC):
    """Contract: named stage terms and a terminal cost, as CasADi expressions."""

    @property
    def tracked(self) -> Mapping[str, float] | None:
        """Weights of the squared errors of states along the horizon or at its end, by name; None where unknown."""
        return None

    @abstractmethod
    def check(self, plant: Plant) -> None:
        """Raise if the cost does not fit the plant.

        Raises:
            InvalidProblem: all mistakes together.
        """

    @abstractmethod
    def stage(self, view: View) -> Mapping[str, Expression]:
        """Return the stage cost's terms, each as cost per unit of time."""

    @abstractmethod
    def terminal_cost(
        self, view: View, plant: Plant, linearise: Callable[[], Linearisation], step: float
    ) -> Expression:
        """Return the terminal cost."""


Weights: TypeAlias = Mapping[str, NotNegative]


@dataclass(frozen=True, eq=False)
class Quadratic(Cost):
    """Weighted squares, by name.

        l = sum w (x - x^N)^2 + sum w u^2 + sum w (u - u^ff)^2 + sum w (u_i - u_{i-1})^2

    Args:
        states: weights of the state errors (q1, q1', ...).
        effort: weights of the absolute inputs.
        deviation: weights of the inputs relative to the model's feedforward along the reference. It suits a wrong model better
            than `effort`, which biases the plan.
        rate: weights of the change of the inputs from stage to stage.
        terminal: weights by the name of a state or output, or LQRTerminal(); None: the weights of errors times the step.
        outputs: weights of the errors of the outputs of a plant that has some, and of their derivatives (bis, bis', ...). Its
            states have no reference, so `states` has no weights then.
    """

    states: Weights = field(default_factory=dict)
    effort: Weights = field(default_factory=dict)
    deviation: Weights = field(default_factory=dict)
    rate: Weights = field(default_factory=dict)
    terminal: Weights | LQRTerminal | None = None
    outputs: Weights = field(default_factory=dict, kw_only=True)

    @property
    def tracked(self) -> Mapping[str, float]:
        """The weights of `states` or `outputs`; those of `terminal` for what only the end of the horizon weighs."""
        at_end = self.terminal if isinstance(self.terminal, Mapping) else {}
        own = {n: w for n, w in self._errors.items() if w}
        return {n: w for n, w in {**at_end, **own}.items() if w}

    def check(self, plant: Plant) -> None:
        """Raise if a name is unknown or a weight is negative or not finite.

        Raises:
            InvalidProblem: all mistakes together.
        """
        mistakes = Mistakes("cost")
        terminal = self.terminal if isinstance(self.terminal, Mapping) else {}
        groups = {
            "states": (self.states, plant.state.elements),
            "outputs": (self.outputs, plant.output.elements),
            "effort": (self.effort, plant.input.elements),
            "deviation": (self.deviation, plant.input.elements),
            "rate": (self.rate, plant.input.elements),
            "terminal": (terminal, plant.output.elements),
        }
        if self.outputs and self.states:
            mistakes.add("states and outputs: both weigh errors of what has a reference; give all weights in one")
        if any(n in plant.state.elements and n not in plant.output.elements for n in self.states):
            mistakes.add(
                f"states: the states of a plant with outputs have no reference; weigh {', '.join(plant.output.elements)}, "
                "Quadratic(outputs=...), or write a CustomCost"
            )
        if isinstance(self.terminal, LQRTerminal) and not plant.equations.follows_state:
            mistakes.add(
                "terminal: LQRTerminal weighs the whole state, which has no reference on a plant with outputs; "
                "give weights by the name of an output"
            )
        for what, (weights, valid) in groups.items():
            mistakes.unknown(f"{what}:", weights, valid)
        if not any(w for weights, _ in groups.values() for w in weights.values()):
            mistakes.add("every weight is zero, so every plan is optimal; weigh at least one state")
        for name in terminal:
            if plant.equations.output_orders.get(name) == 0:
                mistakes.add(
                    f"terminal: the command moves '{name}' at once (order 0), and the end of a horizon has none; leave it out"
                )
        mistakes.raise_if_any()

    @property
    def _errors(self) -> Mapping[str, float]:
        """Weights of what has a reference."""
        return self.outputs or self.states

    def stage(self, view: View) -> dict[str, Expression]:
        terms = {"outputs" if self.outputs else "states": _squares(self._errors, view.output, view.reference)}
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
        """Return the terminal cost (x - x^N)' P (x - x^N); without outputs of order 0, for which the end has no command."""
        if self.terminal is None:
            orders = plant.equations.output_orders
            weights = {n: w for n, w in self._errors.items() if orders.get(n, 1)}
            return step * _squares(weights, view.output, view.reference)
        if isinstance(self.terminal, Mapping):
            return _squares(self.terminal, view.output, view.reference)
        error = view.state.vector[: plant.state.size] - view.reference.vector
        weight = ca.SX(ca.DM(np.asarray(self.terminal.weight(self, plant, linearise()))))
        return ca.bilin(weight, error, error)


@dataclass(frozen=True, eq=False)
class CustomCost(Cost):
    """A cost given as CasADi expressions.

    Args:
        terms: function of a View that returns {term: cost per unit of time of the problem}, 1/min where that is the minute.
        terminal: function of a View that returns the terminal cost; None: zero.
    """

    terms: Callable[[View], Mapping[str, Expression]]
    terminal: Callable[[View], Expression] | None = None

    def check(self, plant: Plant) -> None:
        """Accept every plant: mistakes show when the terms are built."""

    def stage(self, view: View) -> Mapping[str, Expression]:
        return called("cost", self.terms, view)

    def terminal_cost(
        self,
        view: View,
        plant: Plant,  # noqa: ARG002
        linearise: Callable[[], Linearisation],  # noqa: ARG002
        step: float,  # noqa: ARG002
    ) -> Expression:
        return ca.SX(0) if self.terminal is None else called("cost: terminal", self.terminal, view)


def _squares(weights: Mapping[str, float], value: Named, target: Named) -> Expression:
    return sum((w * (value[n] - target[n]) ** 2 for n, w in weights.items()), start=ca.SX(0))
