"""A fixed-point iteration on the target of an inner controller: for plants that settle, whose output is y = h(u) when they have.

    target = reference + shift,        command = inner controller(target)

The response of the iteration is the output itself (order 0), and the model is what the inner controller believes. It needs no
derivative of the output, and it may be as slow as the plant is.

The output measured now belongs to targets of the past. So it is paired with the target that the model says was in force
(`ThroughModel`), and the shift is that of the model-referenced form,

    shift_k = G(f^_k, y_k, f^_k - shift_{k-1}) - (f^_k - shift_{k-1}).

Without pairing the iteration is r_k = G(r_{k-1}, y_k, reference): it goes on while the output is under way, and a plant that is
slower than its cycle limit-cycles at small gains.

While the command stands at a limit the shift may shrink, or move back from the limit, and nothing else, so it does not wind up. It
moves back where its change has the other direction than what the limit took off the model's response, f(u_unclipped) - f(u).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller, compose_controller, embedded, like, reference_block
from fpirhc.controllers.contract import Deforms, without_deformation
from fpirhc.controllers.target_pairing import ThroughModel
from fpirhc.deformation.base import Deformation, Demand, automatic
from fpirhc.errors import NotContractive, NotSupported
from fpirhc.members import Example
from fpirhc.plant.chain import measured_signals
from fpirhc.plant.motion import followed_units
from fpirhc.symbolic.block import Block, Composite, Delay
from fpirhc.symbolic.expression import Signals, expression, is_finite
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.problem import Problem
from fpirhc.task.shifted import SHIFT, Shifted

_RENAMED = {"reference": "target", "error": "target_error"}  # what the inner controller calls these
_COMMANDS = {"_unclipped_last": "command_unclipped", "_command_last": "command"}
_SAMPLES = 200


@dataclass(frozen=True, eq=False)
class Cascade(Controller):
    """The inner controller on a target that is deformed until the measured output is the reference.

    Args:
        controller: the inner one: `FeedforwardOnly()`, or any that follows the reference.
        deformation: the map on targets; a scale is in units of the output.
        paired: which target an output belongs to; None: that of the last cycle.
    """

    controller: Controller
    deformation: Deformation
    paired: ThroughModel | None = field(default_factory=ThroughModel)

    @property
    def inner(self) -> Controller:
        """The inner controller."""
        return self.controller

    def inner_problem(self, problem: Problem) -> Problem:
        """Return the problem with a reference that can be shifted."""
        return replace(problem, reference=Shifted(problem.reference))

    @property
    def deforms(self) -> Deforms:
        """The target."""
        return "target"

    @property
    def planner(self) -> None:
        """None: plans of the inner controller follow the target, and not the reference of the problem."""

    def with_deformation(self, deformation: Deformation) -> Controller:  # type: ignore[override]
        """Return the cascade with another map; without adaptation the inner controller, whose target is then the reference."""
        return replace(self, deformation=deformation) if deformation.adapts else without_deformation(self.controller)

    def with_defaults(self, problem: Problem) -> Cascade:
        """Return the cascade with lag and dead time of its pairing as numbers, and a scale of the map where it has none."""
        paired, map_ = self.paired, self.deformation
        return replace(
            self,
            paired=None if paired is None else paired.stated(problem),
            deformation=map_.suited(self._demand(problem)) if automatic(map_) else map_,
        )

    def _demand(self, problem: Problem) -> Demand:
        """Return the size of the reference's controlled quantities, which the shift may have to make up for at once."""
        plant, function = problem.plant, problem.reference.function(problem.plant)
        times = np.linspace(0.0, problem.duration, _SAMPLES)
        motion = np.array([np.asarray(function(t)[0].full()).ravel() for t in times])
        places = [plant.output.elements.index(n) for n in plant.controlled_names]
        outputs = np.vstack([problem.start_output[places], motion[:, places]])
        return Demand(float(np.linalg.norm(np.ptp(outputs, axis=0))), sudden=True)

    def check(self, problem: Problem) -> None:
        """Raise if the inner controller, the map or the pairing does not fit the problem.

        Raises:
            NotContractive: a gain of the wrong sign.
            NotSupported: a model-referenced map, or one with a pairing of its own; a controller that predicts over the dead time
                inside.
            InvalidValue: see `ThroughModel`.
        """
        self.controller.check(self.inner_problem(problem))
        if self.deformation.mirror is not None:
            raise NotSupported(
                "Cascade cannot use a model-referenced deformation: `paired` already compares with the model; use the map itself"
            )
        if self.deformation.iteration.pairing is not None:
            raise NotSupported(
                f"Cascade: {type(self.deformation).__name__} pairs by itself; give the map inside, and "
                "ThroughModel(dead_time=...)"
            )
        if self.deformation.effective_gain() < 0:
            raise NotContractive(
                f"Cascade: an effective gain of {self.deformation.effective_gain():.3g} moves the target away from the reference; "
                "use the other sign"
            )
        if self.paired is not None:
            self.paired.decays(problem)
            self.paired.queue(problem)

    def blocks(self, problem: Problem) -> tuple[list[Block], list[Delay]]:
        """Return the blocks reference, shift, and the inner controller as one block."""
        reference, shift = reference_block(problem), self._shift_block(problem)
        inner = compose_controller(self.inner_problem(problem), self.controller)
        written = {*reference.writes.names, *shift.writes.names}
        last = (
            Delay(scalar("clipped_last"), "clipped"),
            *(Delay(like(problem.plant.input, last), source) for last, source in _COMMANDS.items()),
        )
        return [reference, shift, _renamed(inner, written)], list(last)

    def _shift_block(self, problem: Problem) -> Block:
        """Block (reference, measured outputs, what a limit did to the last command) -> shift of the target."""
        plant, names = problem.plant, problem.plant.controlled_names
        seen, pairing = plant.output, self.paired
        places, units = [seen.elements.index(n) for n in names], tuple(followed_units(plant)[n] for n in names)
        start = tuple(map(float, problem.start_output[places]))
        own = self.deformation.memory(names)
        last = Signal("shift_last", names, units), Signal("target_last", names, units, start), scalar("shift_cycles")
        response = plant.equations.controlled_response
        memory = Layout((*last, *(pairing.memory(problem) if pairing else ()))) + own

        def step(s: Signals) -> dict[str, Expression]:
            wanted, output, before = s.reference[places], getattr(s, seen.name)[places], s.shift_last
            in_force = pairing.in_force(problem, s, wanted) if pairing else s.target_last
            undeformed = in_force - before if pairing else wanted
            remembered = {m: getattr(s, m) for m in own.names}
            request, after = self.deformation.step(in_force, output, undeformed, remembered)
            change = request - undeformed
            running = ca.logic_and(s.shift_cycles > problem.warm_up_cycles - 0.5, is_finite(change))
            beyond, sent = (response(s.state, getattr(s, u), s.parameters) for u in _COMMANDS)
            onwards = ca.logic_not(ca.dot(change - before, beyond - sent) < 0)  # NaN is no way back
            grows = ca.logic_and(ca.logic_and(s.clipped_last > 0.5, onwards), ca.fabs(change) > ca.fabs(before))
            shift = ca.if_else(running, ca.if_else(grows, before, change), before)
            target = wanted + shift
            paired = pairing.remembered(problem, s, wanted, shift) if pairing else {}
            counted = {"shift_cycles_next": ca.fmin(s.shift_cycles + 1, problem.warm_up_cycles)}
            own_next = {f"{m}_next": ca.if_else(running, after[m], remembered[m]) for m in own.names}
            held = {"shift_last_next": shift, "target_last_next": target, **counted}
            return {SHIFT: shift, "shift": shift, **held, **paired, **own_next}

        commands = (like(plant.input, name) for name in _COMMANDS)
        measured = (*measured_signals(plant), plant.parameter)
        reads = Layout((Signal("reference", seen.elements), *measured, scalar("clipped_last"), *commands))
        writes = Layout((Signal(SHIFT, names, units), Signal("shift", names, units)))
        return Block("shift", reads, writes, step, memory)


def _renamed(inner: Composite, written: set[str]) -> Block:
    """The inner controller as one block, with other names for what the outer blocks write too."""
    block = embedded("inner", inner, {})
    names = {s.name: _RENAMED.get(s.name, s.name) for s in block.writes.signals}
    shown = {name: other for name, other in names.items() if other not in written}
    writes = Layout(tuple(replace(s, name=shown[s.name]) for s in block.writes.signals if s.name in shown))

    def step(s: Signals) -> Mapping[str, Expression]:
        values = {name: expression(value) for name, value in block.step(s).items()}
        renamed = {other: values[name] for name, other in shown.items()}
        return {**renamed, **{f"{m}_next": values[f"{m}_next"] for m in block.memory.names}}

    lossy = inner.bridged_if_any
    bridged = None if lossy is None else lambda: _renamed(lossy(), written)
    return replace(block, writes=writes, step=step, bridged=bridged)


# What is left is the dead time of the problem.
EXAMPLES = (Example(problem="heat_exchanger", controller="Cascade", left=0.4, changes={"reality": None}),)
