"""Incremental nonlinear dynamic inversion: the command moves by what the model's input gain asks for.

Theory: docs/theory.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from fpirhc.controllers.base import law_blocks
from fpirhc.controllers.built import Built
from fpirhc.controllers.contract import Undeformed
from fpirhc.fields.kinds import Positive
from fpirhc.members import Example
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, is_finite
from fpirhc.symbolic.layout import Expression, Layout, like, scalar
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Tracking

_DAMPING = 0.55  # zeta of the low-pass


@dataclass(frozen=True)
class INDI(Undeformed):
    """Increments of the command by the model's input gain. Dead time is not compensated.

    Args:
        tracking: the law that gives the desired response.
        frequency: w of the low-pass on command and response, rad/s, with a damping of 0.55; None: no filter.
    """

    tracking: Tracking
    frequency: Positive | None = None

    def notes(self, problem: Problem) -> tuple[str, ...]:
        age = problem.dead_time.longest
        text = f"INDI takes a response for that of the last command, and it is that of a command {age:.3g} {problem.time_unit} "
        return (f"{text}older: dead time is not compensated",) if age else ()

    def filter(self, period: float) -> tuple[float, float]:
        """Return (c_1, c_2) of H for cycles of that period: y_k = (1 - c_1 - c_2) x_k + c_1 y_{k-1} + c_2 y_{k-2}."""
        if self.frequency is None:
            return 0.0, 0.0
        decay = ca.exp(-_DAMPING * self.frequency * period)
        return 2 * decay * ca.cos(self.frequency * period * ca.sqrt(1 - _DAMPING * _DAMPING)), -decay * decay

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        return law_blocks(built, self.tracking, self._increment_block(built))

    def _increment_block(self, built: Built) -> Block:
        """Block (state, last command, realised, desired) -> command; before the first response it is the model's inverse."""
        plant, warm_up_cycles, coefficients = built.plant, built.warm_up, self.filter(built.period)
        gain, response, inverse = (
            plant.equations.input_gain,
            plant.equations.controlled_response,
            plant.equations.inverse,
        )
        both = (("filtered_command", plant.input), ("filtered_response", plant.response_signal("_")))
        pairs = [like(signal, name + late) for name, signal in both for late in ("", "_before")]
        memory = Layout((*pairs, scalar("filter_begun"))) if self.frequency is not None else Layout()

        def filtered(s: Signals) -> tuple[dict[str, Expression], dict[str, Expression]]:
            """Command and response behind the filter, which begins settled, and what it remembers."""
            now = {"filtered_command": s._command_before, "filtered_response": s.realised}
            if not memory.names:
                return now, {}
            values, begun = {}, s.filter_begun > 0.5
            for name, x in now.items():
                last, before = getattr(s, name), getattr(s, f"{name}_before")
                first, second = coefficients
                values[name] = ca.if_else(begun, (1 - first - second) * x + first * last + second * before, x)
            usable = ca.logic_and(is_finite(ca.vertcat(*values.values())), s.warm_up > warm_up_cycles - 0.5)
            after = {f"{name}_next": ca.if_else(usable, value, getattr(s, name)) for name, value in values.items()}
            for name, value in values.items():
                last, before = getattr(s, name), getattr(s, f"{name}_before")
                after[f"{name}_before_next"] = ca.if_else(usable, ca.if_else(begun, last, value), before)
            return values, {**after, "filter_begun_next": ca.if_else(usable, 1, s.filter_begun)}

        def step(s: Signals) -> dict[str, Expression]:
            values, after = filtered(s)
            before, realised = values["filtered_command"], values["filtered_response"]
            moved = before + ca.solve(gain(s.state, before, s.parameters), s.desired - realised)
            running = s.warm_up > warm_up_cycles - 0.5
            command = ca.if_else(running, moved, inverse(s.state, s.desired, s.parameters))
            request = response(s.state, command, s.parameters)
            return {"command_unclipped": command, "_deformed_unclipped": request, **after}

        signals = (built.before, plant.response_signal("realised"), plant.response_signal("desired"))
        reads = Layout((plant.state, *signals, plant.parameter, scalar("warm_up")))
        writes = Layout((like(plant.input, "command_unclipped"), plant.response_signal("_deformed_unclipped")))
        return Block("increment", reads, writes, step, memory, opaque=plant.equations.inverse_opaque)


EXAMPLES = (
    Example(problem="mrac_pendulum", controller="INDI", changes={"duration": 3.0, "measure_from": 0.0}),
    Example(problem="mrac_pendulum", controller="INDI, filtered", changes={"duration": 3.0, "measure_from": 0.0}),
)
