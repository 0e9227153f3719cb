"""The face in a control cycle: blocks that were written for coordinates run on the measured outputs.

A tracking law is built for the face (`Plant.face`), whose signal is named 'state' as that of every plant. In the cycle the signal
of the measured outputs is 'output', beside the plant's own 'state'. Without outputs both are the same signal, and nothing changes.
"""

from __future__ import annotations

from dataclasses import replace

from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, bridged
from fpirhc.symbolic.expression import Signals, Value
from fpirhc.symbolic.layout import Layout, Signal


def measured_signals(plant: Plant) -> tuple[Signal, ...]:
    """Return the signals of what a controller is given of the motion: the state, and the outputs where there are any."""
    return tuple(dict.fromkeys((plant.state, plant.output)))


def on_face(plant: Plant, block: Block) -> Block:
    """Return a block of the face with its signal 'state' read and written as 'output'; without outputs the block itself.

    Args:
        plant: whose face it is.
        block: built for `plant.face`.
    """
    own, name = plant.face.state.name, plant.output.name

    def renamed(layout: Layout) -> Layout:
        return Layout(tuple([replace(s, name=name) if s.name == own else s for s in layout.signals]))

    def step(s: Signals) -> dict[str, Value]:
        seen = Signals({**vars(s), own: getattr(s, name)} if own in block.reads else vars(s))
        return {name if key == own else key: value for key, value in block.step(seen).items()}

    lossy = None if block.bridged is None else lambda: on_face(plant, bridged(block))
    return replace(block, reads=renamed(block.reads), writes=renamed(block.writes), step=step, bridged=lossy)
