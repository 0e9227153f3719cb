"""A controller that acts on the state in which its command will act. Theory: docs/theory.md."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.believed import measured
from fpirhc.controllers.built import Built, compose_controller, embedded
from fpirhc.controllers.contract import ControllerWrapper
from fpirhc.errors import InvalidValue, require
from fpirhc.fields.kinds import NotNegative, Positive
from fpirhc.members import Example
from fpirhc.plant.chain import derivatives_function
from fpirhc.plant.integrators import USUAL
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, expression
from fpirhc.symbolic.layout import Expression, Layout, Signal, like
from fpirhc.task.dead_time import MOST, DeadTime, Queue
from fpirhc.task.problem import Problem


def _terms(derivatives: Sequence[Expression], time: Expression | float) -> Iterator[Expression]:
    """The terms of a Taylor series, of a value and its derivatives."""
    factor: Expression | float = 1.0
    for j, value in enumerate(derivatives):
        yield factor * value
        factor *= time / (j + 1)


@dataclass(frozen=True)
class Predicted(ControllerWrapper):
    """The wrapped controller on the predicted state.

    The prediction uses the parameters that are given from outside: a learner belongs around it, `Estimating(Predicted(...), ...)`;
    one inside corrects the model of its controller alone.

    Args:
        controller: any controller.
        inputs: a time, the dead time of all inputs, s; the sum of both dead times is rounded to control cycles.
        measurement: a time too, the dead time of the measurement, s.
        by: what is integrated over the dead time: the "model" under the commands that are on their way, or the "desired" responses.
        residual_time: time constant of the low-pass on the residual of the model's responses that is added, s; None: no residual.
            The loop of the residual has a limit of its own: it is stable at moderate rate x dead time (0.4) and unstable at long
            ones.

    Raises:
        InvalidValue: a dead time that is negative or not finite.
    """

    once = True

    inputs: NotNegative
    measurement: NotNegative = 0.0
    by: Literal["model", "desired"] = "model"
    residual_time: Positive | None = None

    def notes(self, problem: Problem) -> tuple[str, ...]:
        notes, cycles = self.controller.notes(problem), self._cycles(problem.period)
        if self.controller.learns and not self._of_responses and cycles:
            notes += (
                "what is learned inside Predicted corrects the controller's model, and the prediction keeps the stated one, whose "
                "error leaves an offset; write Estimating(Predicted(controller, ...), ...)",
            )
        if not problem.given_signals or not cycles:
            return notes
        late = f"{cycles * problem.period:g} {problem.time_unit}"
        return (*notes, f"Predicted follows set-points {late} late; give one that is known ahead so much earlier")

    def check(self, problem: Problem) -> None:
        """Raise if the prediction or the dead time does not fit the problem."""
        plant, cycles = problem.plant, self._cycles(problem.period)
        free = (e for e in plant.output.elements if e.rstrip("'") not in plant.controlled_names)
        unmoved = [*plant.equations.hidden, *free]
        require(
            self.by == "model" or not unmoved,
            f"Predicted(by='desired') does not predict {', '.join(unmoved)}, which no desired response moves; use by='model'",
        )
        require(
            not self._of_responses or self.controller.deforms != "turns",
            "Predicted: what is desired and a residual are responses of the plant's controlled coordinates, and "
            f"{type(self.controller).__name__} has others in turn; use by='model' without a residual",
        )
        if self.by == "desired" and self.residual_time is not None:
            raise InvalidValue("Predicted: a residual is the model's; leave residual_time or by='desired' out")
        if cycles > MOST:
            raise InvalidValue(f"Predicted: {cycles} cycles of dead time, more than {MOST}")

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        plant = built.plant
        if not self._cycles(built.period):
            return self.controller.blocks(built.inner(self))
        inner = compose_controller(built.inner(self), ahead=True)
        given = plant.time, *plant.motion
        ahead = {s.name: like(s, f"{s.name}_ahead") for s in given}
        feeds = {**ahead, **{measured(s).name: s for s in given}}
        command = replace(built.before, name=plant.input.name)
        sent = plant.response_signal("desired") if self.by == "desired" else command
        before = replace(sent, name="_sent_before")
        predict = self._predict_block(built, before, tuple(ahead.values()))
        return [predict, embedded("controller", inner, feeds)], [Delay(before, sent.name)]

    @property
    def _of_responses(self) -> bool:
        """Whether the prediction needs responses beside the model."""
        return self.by == "desired" or self.residual_time is not None

    def _cycles(self, period: float) -> int:
        """Cycles over which the state is predicted."""
        return round((self.inputs + self.measurement) / period)

    def _predict_block(self, built: Built, before: Signal, writes: tuple[Signal, ...]) -> Block:
        """Block (time, what is measured, parameters, what was sent last) -> what will be when the command acts."""
        plant, period, cycles = built.plant, built.period, self._cycles(built.period)
        # One value more than is on its way: the oldest acted while the response was realised.
        queue, calm = Queue(cycles), ca.MX.zeros(len(plant.names))
        advance = USUAL.step(plant, period) if self.by == "model" else _along_desired(plant, period)
        corrected = _residual(plant, self.residual_time, period) if self.residual_time else None
        residual = like(plant.forcing, "residual")
        answered = Queue(plant.response_age)  # of the state to which the measured response belongs
        past = answered.memory("state_answered", plant.state.elements, built.state.start)
        own = (residual, *past) if corrected else ()
        responses = (plant.response_signal("realised"),) if corrected else ()
        reads = (plant.time, *plant.motion, *responses, plant.parameter, before)
        # An output that is the state is where the state is.
        outputs_ahead = {s.name: _output_ahead(plant) for s in plant.beside}

        def step(s: Signals) -> dict[str, Expression]:
            queued, values = queue.column(s, "sent", getattr(s, before.name))
            error = expression(calm)
            if corrected:
                at, later = answered.arrived(s, "state_answered", s.state)
                error = corrected(s.residual, at, queue.delayed(queued, before.size), s.realised, s.parameters)
                values |= {"residual_next": error, **later}
            state = s.state
            if cycles:
                sent = ca.horzcat(*(queued[before.size * k : before.size * (k + 1)] for k in reversed(range(cycles))))
                state = advance.mapaccum("fpirhc_driven", cycles)(s.state, sent, s.parameters, error)[:, -1]
            for name, function in outputs_ahead.items():
                values[f"{name}_ahead"] = function(getattr(s, name), s.state, state, s.parameters, cycles * period)
            return {"time_ahead": s.time + self.inputs, "state_ahead": state, **values}

        memory = Layout((*queue.memory("sent", before.elements, tuple(before.start_vector())), *own))
        return Block("predict", Layout(reads), Layout(writes), step, memory, opaque=True)


def _along_desired(plant: Plant, period: float) -> ca.Function:
    """Function (state, desired responses, parameters, forcing) -> state one cycle later, where the plant does what is desired."""
    x, u, p = plant.symbols()
    d, w = ca.SX.sym("d", len(plant.controlled_names)), ca.SX.sym("w", len(plant.names))
    seen = plant.equations.output(x, 0 * u, p, 0 * w)
    elements, later = plant.output.elements, dict[str, Expression]()
    for k, name in enumerate(plant.controlled_names):
        chain = sorted((e for e in elements if e.rstrip("'") == name), key=len)
        values = [seen[elements.index(e)] for e in chain] + [d[k]]
        later |= {element: sum(_terms(values[j:], period), start=ca.SX(0)) for j, element in enumerate(chain)}
    outputs_next = ca.vertcat(*(later[element] for element in elements))
    return ca.Function("fpirhc_predict", [x, d, p, w], [plant.equations.state_of(outputs_next, x)])


def _residual(plant: Plant, time: float, period: float) -> ca.Function:
    """Function (residual, state, command that acted, realised, parameters) -> the low-passed residual one cycle later.

    It is the smallest forcing w of the states' rates that makes the model's response the measured one, D w = f - f^ with
    D = d f^/d w; of controlled coordinates these are their responses themselves.
    """
    x, u, p = plant.symbols()
    old, w, f = (
        ca.SX.sym(n, k) for n, k in (("old", len(plant.names)), ("w", len(plant.names)), ("f", len(plant.inputs)))
    )
    forced = derivatives_function(plant, tuple(plant.response_orders.items()))(x, u, p, w)
    effect = ca.substitute(ca.jacobian(forced, w), w, 0 * w)
    missing = f - plant.equations.controlled_response(x, u, p)
    residual_now = ca.mtimes(effect.T, ca.solve(ca.mtimes(effect, effect.T), missing))
    share = 1 - float(np.exp(-period / time))
    return ca.Function("fpirhc_residual", [old, x, u, f, p], [ca.densify(old + share * (residual_now - old))])


def _output_ahead(plant: Plant) -> ca.Function:
    """Return the Function (measured outputs, state, state ahead, parameters, time ahead) -> outputs ahead.

    They are the model's at the predicted state, and the distance d of the measured ones,

        y^(k)(t + tau) = h_k(x(t + tau), p) + sum_{j >= k} d^(j)(t) tau^(j-k) / (j-k)!,      d^(j) = y^(j) - h_j(x, p),   j < r,

    where d^(r) is taken as zero: over a dead time, which is short. Over a horizon it is not, see `consistent_state`.
    """
    x, u, p = plant.symbols()
    later, y, time = ca.SX.sym("later", x.numel()), ca.SX.sym("y", plant.output.size), ca.SX.sym("time")
    held = ca.SX.zeros(u.numel()), p, ca.SX.zeros(len(plant.names))
    distance, ahead = y - plant.equations.output(x, *held), plant.equations.output(later, *held)
    elements, entries = plant.output.elements, []
    for k, element in enumerate(elements):
        higher = [i for i, e in enumerate(elements) if e.startswith(element) and not e[len(element) :].strip("'")]
        entries.append(sum(_terms([distance[i] for i in higher], time), start=ahead[k]))
    return ca.Function("fpirhc_output_ahead", [y, x, later, p, time], [ca.densify(ca.vertcat(*entries))])


def examples(inner: Controller) -> tuple[Example, ...]:
    """Values for the laws, around any controller: the command arrives two cycles late."""
    late = DeadTime(inputs={"Fa": 0.01, "Fb": 0.01})
    return (Example(Predicted(inner, inputs=0.01), changes={"dead_time": late}),)
