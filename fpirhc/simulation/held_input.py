"""A loop whose command nobody computes: the input before the run is held, until another one is written into its memory."""

from __future__ import annotations

from dataclasses import dataclass

from fpirhc.controllers.base import commanding_blocks, like, reference_block
from fpirhc.controllers.contract import Undeformed
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.task.problem import Problem

HELD_INPUT = "_held_input"  # signal in the memory of the loop, with one entry per input


@dataclass(frozen=True)
class HeldInput(Undeformed):
    """Sends the input that stands in its memory, within the limits."""

    def blocks(self, problem: Problem) -> tuple[list[Block], list[Delay]]:
        plant, (closing, delays) = problem.plant, commanding_blocks(problem)
        before = tuple(map(float, problem.inputs_before))
        held = Signal(HELD_INPUT, plant.input.elements, plant.input.units, before)
        responses = [plant.response_signal(name) for name in ("nominal", "desired", "_deformed_unclipped")]

        def step(s: Signals) -> dict[str, Expression]:
            response = plant.equations.controlled_response(s.state, getattr(s, HELD_INPUT), s.parameters)
            return {"command_unclipped": getattr(s, HELD_INPUT), **{r.name: response for r in responses}}

        writes = Layout((*responses, like(plant.input, "command_unclipped")))
        hold = Block("hold", Layout((held, plant.state, plant.parameter)), writes, step)
        return [reference_block(problem), hold, *closing], [*delays, Delay(held, HELD_INPUT)]
