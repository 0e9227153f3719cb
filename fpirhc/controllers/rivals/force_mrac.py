"""Model reference adaptive control by fixed-point iteration: the command is deformed against a reference model.

Theory: docs/theory.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca

from fpirhc.controllers.base import Controller, law_blocks
from fpirhc.controllers.built import Built
from fpirhc.controllers.reference_states import request_of_commands
from fpirhc.deformation.base import Deformation, automatic, scaled_for
from fpirhc.errors import NotSupported
from fpirhc.members import Example
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, like, scalar
from fpirhc.task.dead_time import every
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Tracking


@dataclass(frozen=True, eq=False)
class ForceMRAC(Controller):
    """Tracking of the reference model, made true by deforming the command.

    Args:
        tracking: the law that gives the desired response.
        deformation: the fixed-point map on commands; a scale is in units of the inputs.
    """

    tracking: Tracking
    deformation: Deformation

    def with_defaults(self, problem: Problem) -> ForceMRAC:
        if not automatic(self.deformation):
            return self
        return replace(self, deformation=scaled_for(self.deformation, request_of_commands(problem)))

    deforms = "command"

    def check(self, problem: Problem) -> None:
        """Raise where the response does not recalculate the last command, with which a model-referenced map compares it.

        Raises:
            NotSupported: such a map where sensing is not ideal or something is late.
        """
        form, late = self.deformation.form, any((problem.dead_time.measurement, *problem.dead_time.inputs.values()))
        believes = form.late or any(every(form.lag))
        if form.modelled and (late or believes or not problem.sensing.ideal):
            raise NotSupported(
                "ForceMRAC cannot use a model-referenced deformation here: it compares the last command with the one recalculated "
                "from the response, through no estimator, dead time or lag; use the map itself or Increment"
            )

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        return law_blocks(built, self.tracking, self._force_block(built.plant, built.warm_up))

    def _force_block(self, plant: Plant, warm_up_cycles: float) -> Block:
        """Block (state, desired, realised, last command) -> Q^Des, Q^Rec, Q^Def, and the model's response to it."""
        memory = self.deformation.memory(plant.input.elements)
        inverse, response = plant.equations.inverse, plant.equations.controlled_response

        def step(s: Signals) -> dict[str, Expression]:
            remembered = {m: getattr(s, m) for m in memory.names}
            running = s.warm_up > warm_up_cycles - 0.5
            desired = inverse(s.state, s.desired, s.parameters)
            recalculated = ca.if_else(running, inverse(s.state, s.realised, s.parameters), desired)
            deformed, next_memory = self.deformation.step(s._command_before, recalculated, desired, remembered)
            next_values = {f"{m}_next": ca.if_else(running, next_memory[m], remembered[m]) for m in memory.names}
            command = ca.if_else(running, deformed, desired)
            return {
                "force_desired": desired,
                "force_recalculated": recalculated,
                "command_unclipped": command,
                "_deformed_unclipped": response(s.state, command, s.parameters),
                **next_values,
            }

        responses = [plant.response_signal(n) for n in ("desired", "realised")]
        reads = (plant.state, plant.parameter, *responses, like(plant.input, "_command_before"), scalar("warm_up"))
        forces = [like(plant.input, n) for n in ("force_desired", "force_recalculated", "command_unclipped")]
        writes = Layout((*forces, plant.response_signal("_deformed_unclipped")))
        return Block("force", Layout(reads), writes, step, memory, opaque=plant.equations.inverse_opaque)


EXAMPLES = (Example(problem="mrac_pendulum", controller="force MRAC", changes={"duration": 3.0, "measure_from": 0.0}),)
