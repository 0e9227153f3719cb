"""A fixed-point iteration on the target of an inner controller: for plants that settle, whose output is y = h(u) when they have.

    target = reference + shift,        command = inner controller(target)

A map may iterate in another unit of the output, as a user's own does in the problem anaesthesia_people. Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller, reference_block
from fpirhc.controllers.built import Built, compose_controller, embedded
from fpirhc.deformation.base import Deformation, automatic
from fpirhc.errors import InvalidValue, NotContractive, require
from fpirhc.fields.kinds import NotNegative
from fpirhc.members import Example
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay, under_names
from fpirhc.symbolic.expression import Signals, is_finite
from fpirhc.symbolic.layout import Expression, Layout, Signal, like, scalar
from fpirhc.task.dead_time import MOST, Queue, every
from fpirhc.task.problem import Problem
from fpirhc.task.reference import Reference, Steps

SHIFT = "_target_shift"  # given from outside: by how much every controlled coordinate is shifted


@dataclass(frozen=True, eq=False)
class Shifted(Reference):
    """The motion of another reference plus a shift of its controlled coordinates, which is held along a horizon.

    Whatever is decided before a run uses the motion without shift. Derivatives are not shifted: the shift changes slowly.
    """

    reference: Reference  # that is shifted. Its own signals are given from outside too.

    @property
    def set_points(self) -> Mapping[str, Steps]:
        return self.reference.set_points

    def coordinates(self, t: Expression) -> Mapping[str, Expression]:
        return self.reference.coordinates(t)

    def function(self, plant: Plant) -> ca.Function:
        """Function t -> (nominal state (nx), nominal response (n)) without shift."""
        return self.reference.function(plant)

    def given(self, plant: Plant) -> tuple[Signal, ...]:
        return self.own(plant)

    def own(self, plant: Plant) -> tuple[Signal, ...]:
        return (*self.reference.own(plant), _shift_signal(plant, SHIFT))

    def motion_now(self, plant: Plant, ahead: float = 0.0) -> ca.Function:
        """Function (t, own signals) -> (state, response), now or after some time with the shift held."""
        t, *own, shift = ca.SX.sym("t"), *(ca.SX.sym(signal.name, signal.size) for signal in self.own(plant))
        state, response = self.reference.motion_now(plant, ahead)(t, *own)
        return ca.Function("fpirhc_target", [t, *own, shift], [state + _places(plant) @ shift, response])


def _shift_signal(plant: Plant, name: str) -> Signal:
    units = plant.followed
    return Signal(name, plant.controlled_names, tuple(units[n] for n in plant.controlled_names))


def _places(plant: Plant) -> ca.DM:
    """The matrix that puts the shift into the outputs."""
    return ca.DM([[float(element == name) for name in plant.controlled_names] for element in plant.output.elements])


_RENAMED = {"reference": "target", "error": "target_error"}  # what the inner controller calls these
_COMMANDS = {"_unclipped_last": "command_unclipped", "_command_last": "command"}


@dataclass(frozen=True, eq=False)
class Cascade(Controller):
    """The inner controller on a target that is deformed until the measured output is the reference.

    Args:
        controller: the inner one: `FeedforwardOnly()`, or any that follows the reference.
        deformation: the map on targets; a scale is in units of the output, and stated.
        lag: an output belongs to the target that has passed the model's dead time and lag: the time constant with which the model
            follows a shift of its target; a tuple has one per controlled coordinate, 0 settles within a cycle, as outputs of order
            0 do. None: it belongs to the target of the last cycle.
        dead_time: from a target to its measured output; None: that of the problem, for the slowest input.
        plain: whether the output is compared with the reference, as in the published form, and the next target begins at the one in
            force. It corrects a right model too, while that is under way, and is quiet at gains that limit-cycle otherwise.
    """

    controller: Controller
    deformation: Deformation
    lag: NotNegative | tuple[NotNegative, ...] | None
    dead_time: NotNegative | None = None
    plain: bool = False

    deforms = "target"

    def inner_problem(self, problem: Problem, name: str = "") -> Problem:  # noqa: ARG002
        return replace(problem, reference=Shifted(problem.reference))

    def check(self, problem: Problem) -> None:
        """Raise if the map or the pairing does not fit the problem."""
        form, name = self.deformation.form, type(self.deformation).__name__
        if automatic(self.deformation):
            raise InvalidValue(
                f"Cascade: the scale of {name} is that of shifts, of which the reference says nothing; give it: scale=..."
            )
        require(
            not form.modelled,
            "Cascade cannot use a model-referenced deformation: `lag` already compares with the model; use the map itself",
        )
        require(not form.pairs, f"Cascade: {name} pairs by itself; give the map inside, and Cascade(dead_time=...)")
        gain = self.deformation.effective_gain()
        if gain < 0:
            raise NotContractive(
                f"Cascade: an effective gain of {gain:.3g} moves the target away from the reference; use the other sign"
            )
        count, cycles = len(problem.plant.controlled_names), self._cycles(problem)
        if isinstance(self.lag, tuple) and len(self.lag) != count:
            raise InvalidValue(
                f"Cascade(lag={self.lag!r}): there are {count} controlled coordinates; give one lag for each, or one for all"
            )
        if cycles > MOST:
            raise InvalidValue(f"Cascade: {cycles:g} cycles of dead time, more than {MOST}")

    def _cycles(self, problem: Problem) -> float:
        """Cycles from a target to its measured output."""
        late = max((0.0, *problem.dead_time.inputs.values())) + problem.dead_time.measurement
        return (late if self.dead_time is None else self.dead_time) / problem.period

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        inner = compose_controller(built.inner(self))
        last = [Delay(like(built.plant.input, last), source) for last, source in _COMMANDS.items()]
        blocks = [reference_block(built), self._shift_block(built), under_names(embedded("inner", inner, {}), _RENAMED)]
        return blocks, [Delay(scalar("clipped_last"), "clipped"), *last]

    def _shift_block(self, built: Built) -> Block:
        """Block (reference, measured outputs, what a limit did to the last command) -> shift of the target."""
        problem, plant, names, pairs = built.problem, built.plant, built.plant.controlled_names, self.lag is not None
        seen, places = plant.output, [plant.output.elements.index(n) for n in names]
        begun = problem.start_output[places]
        first = np.asarray(problem.reference.function(plant)(0.0)[0].full()).ravel()[places]
        away = tuple(map(float, begun - first))
        own, plain, queue = self.deformation.memory(names), pairs and self.plain, Queue(self._cycles(problem))
        rho = ca.DM([math.exp(-built.period / lag) if lag else 0.0 for lag in every(self.lag or 0.0)])
        rho = rho if rho.numel() == len(names) else ca.repmat(rho, len(names), 1)
        last: tuple[Signal, ...] = (
            # The plain form begins at the target in force from its first cycle on, and moves it once samples count.
            Signal("shift_last", names, start=away if plain else ()),
            Signal("target_last", names, start=tuple(map(float, begun))),
            scalar("shift_cycles"),
        )
        if pairs:
            last += queue.memory("references_sent", names, tuple(map(float, first)))
            last += queue.memory("shifts_sent", names, (0.0,) * len(names))
            last += (Signal("shift_in_force", names, start=away),)
        response = plant.equations.controlled_response

        def step(s: Signals) -> dict[str, Expression]:
            wanted, output, before = s.reference[places], getattr(s, seen.name)[places], s.shift_last
            in_force, undeformed, later = s.target_last, wanted, dict[str, Expression]()
            if pairs:
                target, later = queue.arrived(s, "references_sent", wanted)
                in_force = target + s.shift_in_force
                undeformed = in_force - (s.shift_in_force if plain else before)
            remembered = {m: getattr(s, m) for m in own.names}
            request, after = self.deformation.step(in_force, output, undeformed, remembered)
            change = request - undeformed
            running = ca.logic_and(s.shift_cycles > built.warm_up - 0.5, is_finite(change))
            beyond, sent = (response(s.state, getattr(s, u), s.parameters) for u in _COMMANDS)
            onwards = ca.logic_not(ca.dot(change - before, beyond - sent) < 0)  # NaN is no way back
            grows = ca.logic_and(ca.logic_and(s.clipped_last > 0.5, onwards), ca.fabs(change) > ca.fabs(before))
            shift = ca.if_else(running, ca.if_else(grows, before, change), before)
            if pairs:
                arrived, shifts = queue.arrived(s, "shifts_sent", shift)
                later |= shifts | {"shift_in_force_next": rho * s.shift_in_force + (1 - rho) * arrived}
            return {
                **dict.fromkeys((SHIFT, "shift", "shift_last_next"), shift),
                "target_last_next": wanted + shift,
                "shift_cycles_next": ca.fmin(s.shift_cycles + 1, built.warm_up),
                **later,
                **{f"{m}_next": ca.if_else(running, after[m], remembered[m]) for m in own.names},
            }

        commands = (like(plant.input, name) for name in _COMMANDS)
        measured = (*plant.motion, plant.parameter)
        reads = Layout((Signal("reference", seen.elements), *measured, scalar("clipped_last"), *commands))
        writes = Layout((_shift_signal(plant, SHIFT), _shift_signal(plant, "shift")))
        return Block("shift", reads, writes, step, Layout(last) + own)


# What is left is the dead time of the problem.
EXAMPLES = (Example(problem="heat_exchanger", controller="Cascade", left=0.4, changes={"reality": None}),)
