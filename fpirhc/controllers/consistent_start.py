"""The start of a plan on outputs: the state at which the model has the measured outputs and their derivatives.

The plan and its nominal response are taken there. The inverse that corrects the response stays at the measured state, and so does
the mirror of a deformation: at another state the gain from a request to the plant's response would be another. An inverse that
corrects nothing is taken at the plan's state, and so returns the planned input.
"""

from __future__ import annotations

from collections.abc import Sequence

from fpirhc.controllers.base import fed, like
from fpirhc.horizon.consistent_state import consistent_state
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout

_STATE = "_consistent_state"


def consistent_start(plant: Plant) -> Block:
    """Return the block (state, measured outputs, parameters) -> the state at which the model has these outputs."""
    function = consistent_state(plant)
    reads, writes = Layout((plant.state, plant.output, plant.parameter)), Layout((like(plant.state, _STATE),))

    def step(s: Signals) -> dict[str, Expression]:
        return {_STATE: function(s.state, s.output, s.parameters)}

    return Block("consistent_start", reads, writes, step, opaque=True)


def at_consistent_start(plant: Plant, blocks: Sequence[Block]) -> list[Block]:
    """Return the blocks with that state in place of the measured one."""
    return [fed(block, plant.state.name, like(plant.state, _STATE)) for block in blocks]
