"""The plant left alone: its error where the input before the run is held. A controller that does worse is not a success.

The same plant, start, disturbances and noise as in the comparison; nothing is fed back. It is run in the virtual machine, because
one run is shorter than a compilation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from fpirhc.controllers.base import Controller, commanding_blocks, like, reference_block, rename
from fpirhc.deformation.base import Deformation
from fpirhc.deformation.identity import Identity
from fpirhc.errors import FpirhcError
from fpirhc.simulation.metrics.entries.errors import rms_error
from fpirhc.simulation.simulate import judged_run, simulator
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, expression
from fpirhc.symbolic.layout import Expression, Layout
from fpirhc.task.problem import Problem


def error_left_alone(problem: Problem, *, seed: int) -> Mapping[str, float]:
    """Return the rms error of every judged coordinate under the input before the run; empty where that is not known.

    It is not known for a plant outside, which is not run for the sake of a comparison, and where the run ends early.

    Args:
        problem: of the comparison.
        seed: of disturbances and noise.
    """
    if problem.foreign is not None:
        return {}
    try:
        run = judged_run(simulator(problem, _HeldInput(), compiled=False), seed=seed)
    except FpirhcError:
        return {}
    return {} if run.stop is not None else rms_error(problem, run)


@dataclass(frozen=True)
class _HeldInput(Controller):
    """The input before the run in every cycle."""

    @property
    def deformation(self) -> Deformation:
        """Identity(): no request is iterated."""
        return Identity()

    def blocks(self, problem: Problem) -> tuple[list[Block], list[Delay]]:
        """Return the blocks reference, hold, limit, judge, running."""
        plant, closing = problem.plant, commanding_blocks(problem)
        response = plant.response_signal("_reference_response")
        held = expression(ca.DM(problem.inputs_before))

        def step(s: Signals) -> dict[str, Expression]:
            return {"command_unclipped": held, "_deformed_unclipped": s._reference_response}

        writes = Layout((like(plant.input, "command_unclipped"), plant.response_signal("_deformed_unclipped")))
        named = [rename(name, response, plant.response_signal(name)) for name in ("nominal", "desired")]
        return [
            reference_block(problem),
            *named,
            Block("hold", Layout((response,)), writes, step),
            *closing[0],
        ], closing[1]
