"""A controller that acts on the state in which its command will act.

With a dead time of the inputs the command of this cycle acts later, and with one of the measurement the measured state is old. The
wrapper integrates the measured state over both with what it has sent meanwhile, and hands the wrapped controller that state and the
time at which the command acts (O. J. M. Smith 1957; Z. Artstein 1982). A receding horizon then starts where its first input acts.

Two ways to predict, as values:

    ByModel    the approximate model integrated over the commands on their way; on request plus its residual, the low-passed
               difference between the response that was seen and the model's own.
    ByDesired  the desired responses on their way, integrated: no model is needed, because a deformation makes the realised
               response the desired one. For plants whose every coordinate is controlled.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller, compose_controller, embedded, like
from fpirhc.controllers.mirror import MEASURED
from fpirhc.deformation.base import Deformation
from fpirhc.errors import InvalidValue, NotSupported
from fpirhc.members import Example
from fpirhc.plant.integrators import RungeKutta4
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, expression
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.dead_time import MOST, DeadTime
from fpirhc.task.problem import Problem


class Predictor(ABC):
    """Contract: how the state moves over one cycle under what was sent, and what was sent."""

    @property
    def residual_time(self) -> float | None:
        """Time constant of the low-passed model residual that `advance` is given, s; None: it is zero."""
        return None

    @abstractmethod
    def check(self, plant: Plant) -> None:
        """Raise NotSupported where the plant does not fit."""

    @abstractmethod
    def sent(self, plant: Plant) -> Signal:
        """The signal that is queued: written by the controller."""

    @abstractmethod
    def sent_at_start(self, problem: Problem) -> tuple[float, ...]:
        """What is on its way when the run begins."""

    @abstractmethod
    def advance(self, plant: Plant, period: float) -> ca.Function:
        """Function (state, sent, parameters, residual of the responses) -> state one cycle later."""


@dataclass(frozen=True)
class ByModel(Predictor):
    """Integrate the approximate model over the queued commands.

    Parameters:
        residual_time: add the residual of the responses, low-passed with this time constant, s; None: no residual. Its loop has a
            dead-time limit of its own: good at moderate rate x dead time (0.4), unstable at long ones.

    Raises:
        InvalidValue: a time constant that is not positive.
    """

    residual_time: float | None = None

    def __post_init__(self) -> None:
        if self.residual_time is not None and not 0 < self.residual_time < np.inf:
            raise InvalidValue(
                f"ByModel(residual_time={self.residual_time!r}): expected a positive number of seconds or None"
            )

    def check(self, plant: Plant) -> None:
        """Every plant fits."""

    def sent(self, plant: Plant) -> Signal:
        """The commands."""
        return plant.input

    def sent_at_start(self, problem: Problem) -> tuple[float, ...]:
        """The commands that the problem says."""
        return problem.dead_time.commands_before(problem.plant)

    def advance(self, plant: Plant, period: float) -> ca.Function:
        """One Runge-Kutta step of the model."""
        step = RungeKutta4().step(plant, period)
        x, u, p = plant._symbols()
        w = ca.SX.sym("w", len(plant.names))
        return ca.Function("fpirhc_predict", [x, u, p, w], [step(x, u, p, w)])


@dataclass(frozen=True)
class ByDesired(Predictor):
    """Integrate the queued desired responses."""

    def check(self, plant: Plant) -> None:
        """Raise if some coordinate is not controlled.

        Raises:
            NotSupported: its motion needs a model.
        """
        if len(plant.controlled_names) != len(plant.names):
            raise NotSupported("ByDesired() needs every coordinate to be controlled; use ByModel()")

    def sent(self, plant: Plant) -> Signal:
        """The desired responses."""
        return plant.response_signal("desired")

    def sent_at_start(self, problem: Problem) -> tuple[float, ...]:
        """Zero: the plant was at rest or in steady motion."""
        return (0.0,) * len(problem.plant.controlled_names)

    def advance(self, plant: Plant, period: float) -> ca.Function:
        """Taylor's formula with the highest derivative held."""
        x, _, p = plant._symbols()
        d, w = ca.SX.sym("d", len(plant.names)), ca.SX.sym("w", len(plant.names))
        elements, following = plant.state.elements, {}
        for k, name in enumerate(plant.names):
            chain = [e for e in elements if e.rstrip("'") == name]
            values = [x[elements.index(e)] for e in sorted(chain, key=len)] + [d[k]]
            for order, element in enumerate(sorted(chain, key=len)):
                series, factor = ca.SX(0), 1.0
                for j, value in enumerate(values[order:]):
                    series += factor * value
                    factor *= period / (j + 1)
                following[element] = series
        return ca.Function("fpirhc_predict", [x, d, p, w], [ca.vertcat(*(following[e] for e in elements))])


@dataclass(frozen=True)
class Predicted(Controller):
    """The wrapped controller on the predicted state.

    Parameters:
        controller: any controller.
        inputs: dead time of the inputs that it is to bridge, s, rounded to control cycles. measurement: of the measurement, s.
        by: how to predict.

    Raises:
        InvalidValue: a dead time that is negative or not finite.
    """

    controller: Controller
    inputs: float
    measurement: float = 0.0
    by: Predictor = field(default_factory=ByModel)

    def __post_init__(self) -> None:
        for name, value in (("inputs", self.inputs), ("measurement", self.measurement)):
            if not (np.isfinite(value) and value >= 0):
                raise InvalidValue(f"Predicted({name}={value!r}): expected a number of seconds of at least 0")

    @property
    def inner(self) -> Controller:
        """The wrapped controller."""
        return self.controller

    @property
    def deformation(self) -> Deformation:
        """The wrapped controller's."""
        return self.controller.deformation

    @property
    def feeds(self) -> Mapping[str, str]:
        """The wrapped controller reads time and state ahead."""
        return {"time": "time_ahead", "state": "state_ahead", **self.controller.feeds}

    def check(self, problem: Problem) -> None:
        """Raise what the wrapped controller raises, and if the plant or the dead time does not fit.

        Raises:
            NotSupported: the predictor cannot serve the plant. InvalidValue: a dead time of more than 1000 cycles.
        """
        self.controller.check(problem)
        self.by.check(problem.plant)
        if self.controller.response(problem) is not None and self.by != ByModel():
            raise NotSupported(
                f"Predicted: {self.by} compares the responses of the plant's controlled coordinates, but "
                f"{type(self.controller).__name__} answers others; use by=ByModel()"
            )
        if self._cycles(problem) > MOST:
            raise InvalidValue(f"Predicted: {self._cycles(problem)} cycles of dead time, more than {MOST}")

    def blocks(self, problem: Problem) -> tuple[list[Block], list[Delay]]:
        """Blocks predict, and the wrapped controller as one; its own blocks when there is nothing to bridge."""
        plant, cycles = problem.plant, self._cycles(problem)
        if not cycles:
            return self.controller.blocks(problem)
        inner = compose_controller(problem, self.controller, ahead=True)
        ahead = {"time": scalar("time_ahead", "s"), "state": like(plant.state, "state_ahead")}
        feeds = {**ahead, MEASURED: plant.state}
        sent = self.by.sent(plant)
        before = Signal("_sent_before", sent.elements, sent.units, self.by.sent_at_start(problem))
        predict = _predict_block(problem, self.by, cycles, self.inputs, before, tuple(ahead.values()))
        return [predict, embedded("controller", inner, feeds)], [Delay(before, sent.name)]

    def _cycles(self, problem: Problem) -> int:
        return round((self.inputs + self.measurement) / problem.period)


def _predict_block(
    problem: Problem, by: Predictor, cycles: int, lead: float, before: Signal, writes: tuple[Signal, ...]
) -> Block:
    plant, size = problem.plant, before.size
    # One more than is on its way: the oldest is what acted while the response was realised.
    past = tuple(f"{e}@{k}" for k in range(1, cycles + 2) for e in before.elements)
    queue = Signal("sent", past, start=by.sent_at_start(problem) * (cycles + 1))
    residual = Signal("residual", plant.names, plant.response_units)
    advance = by.advance(plant, problem.period)
    corrected = _residual(plant, by.residual_time, problem.period) if by.residual_time else None
    seen = (plant.response_signal("realised"),) if corrected else ()
    reads = (scalar("time", "s"), plant.state, *seen, plant.parameter, before)
    own = (queue, residual) if corrected else (queue,)

    def step(s: Signals) -> dict[str, Expression]:
        kept = ca.vertcat(s._sent_before, s.sent[: size * cycles])
        following = {"sent_next": kept}
        error = expression(ca.MX.zeros(len(plant.names)))
        if corrected:
            error = corrected(s.residual, s.state, kept[size * cycles :], s.realised, s.parameters)
            following["residual_next"] = error
        columns = ca.horzcat(*(kept[size * k : size * (k + 1)] for k in reversed(range(cycles))))
        same = ca.repmat(s.parameters, 1, cycles), ca.repmat(error, 1, cycles)
        moved = advance.mapaccum("fpirhc_predicted", cycles)(s.state, columns, *same)
        return {"time_ahead": s.time + lead, "state_ahead": moved[:, -1], **following}

    return Block("predict", Layout(reads), Layout(writes), step, Layout(own), opaque=True)


def _residual(plant: Plant, time: float, period: float) -> ca.Function:
    """Function (residual, state, command that acted, realised, parameters) -> the low-passed residual one cycle later."""
    x, u, p = plant._symbols()
    old, f = ca.SX.sym("old", len(plant.names)), ca.SX.sym("f", len(plant.controlled_names))
    seen = ca.SX.zeros(len(plant.names))
    seen[list(plant.controlled_indices)] = f - plant.controlled_response_function(x, u, p)
    share = 1 - float(np.exp(-period / time))
    return ca.Function("fpirhc_residual", [old, x, u, f, p], [old + share * (seen - old)])


def examples(inner: Controller) -> tuple[Example, ...]:
    """Values for the laws, around any controller: the command arrives two cycles late."""
    late = DeadTime(inputs={"Fa": 0.01, "Fb": 0.01})
    return (Example(Predicted(inner, inputs=0.01), changes={"dead_time": late}),)
