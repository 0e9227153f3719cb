"""Where a horizon starts and what is tracked between two plans. Theory: docs/theory.md."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np

from fpirhc.controllers.built import Built
from fpirhc.horizon.nominal import consistent_state
from fpirhc.horizon.problem import OptimalControl
from fpirhc.optimisers.base import Optimiser, first_memory
from fpirhc.plant.chain import without_disturbances
from fpirhc.plant.integrators import USUAL
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay, fed
from fpirhc.symbolic.driver import plans_are_compiled
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import Signals, Value
from fpirhc.symbolic.layout import Expression, Layout, Signal, like, scalar
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Tracking

# blocks before the plan (-> _plan_state), after it (-> nominal, desired), after the command is limited; what is remembered
Parts = tuple[list[Block], list[Block], list[Block], list[Delay]]


def from_measurement(built: Built) -> Parts:
    """Plan from the measured state; the plan's first response is the desired one."""
    plant = built.plant
    start = _choose("plan_state", plant, lambda s: {"_plan_state": s.state}, ["_plan_state"])
    response = without_disturbances(plant).equations.controlled_response
    reads = Layout((plant.state, like(plant.input, "planned"), plant.parameter))
    writes = Layout((plant.response_signal("nominal"), plant.response_signal("desired")))

    def step(s: Signals) -> dict[str, Expression]:
        planned = response(s.state, s.planned, s.parameters)
        return {"nominal": planned, "desired": planned}

    return [start], [Block("nominal", reads, writes, step)], [], []


_FOLLOWED = "_followed_state"  # of the model on the planned motion


def from_plan(built: Built, tracking: Tracking) -> Parts:
    """Plan from the model's own state, and keep the plant on the planned motion by a law."""
    plant, law = built.plant, tracking.within(built.largest)

    def start(s: Signals) -> dict[str, Expression]:
        target = ca.if_else(s.warm_up < 0.5, s.state, s._target_before)
        return {"_plan_state": target, _FOLLOWED: target}

    begin = _choose("plan_state", plant, start, ["_plan_state", _FOLLOWED])
    delay = Delay(like(plant.state, "_target_before"), "target")
    after = [_propagate(plant, built.period), law.law(plant, built.period)]
    return [begin], after, [law.update(plant, built.period)], [delay, *law.delays(plant)]


def _choose(name: str, plant: Plant, step: Callable[[Signals], dict[str, Expression]], writes: list[str]) -> Block:
    reads = [plant.state]
    if len(writes) > 1:
        reads += [scalar("warm_up"), scalar("_due"), like(plant.state, "_target_before")]
    return Block(name, Layout(tuple(reads)), Layout(tuple(like(plant.state, w) for w in writes)), step)


def _propagate(plant: Plant, period: float) -> Block:
    """Block (model's state, planned input) -> (its outputs, its response, its state one cycle later)."""
    reads = Layout((like(plant.state, _FOLLOWED), like(plant.input, "planned"), plant.parameter))
    writes = Layout((like(plant.output, "_target"), plant.response_signal("nominal"), like(plant.state, "target")))
    model, calm = plant.equations, ca.DM.zeros(len(plant.names))
    after = USUAL.step(plant, period)

    def step(s: Signals) -> dict[str, Expression]:
        state = getattr(s, _FOLLOWED)
        return {
            "_target": model.output(state, s.planned, s.parameters, calm),
            "nominal": model.controlled_response(state, s.planned, s.parameters),
            "target": after(state, s.planned, s.parameters, calm),
        }

    return Block("propagate", reads, writes, step)


_STATE = "_consistent_state"


def consistent_start(plant: Plant) -> Block:
    """Return the block (state, measured outputs, parameters) -> the state at which the model has these outputs.

    A plan on outputs starts there; the inverse stays at the measured state, where the gain from request to response is the plant's.
    """
    function = consistent_state(plant)
    reads, writes = Layout((plant.state, plant.output, plant.parameter)), Layout((like(plant.state, _STATE),))

    def step(s: Signals) -> dict[str, Expression]:
        return {_STATE: function(s.state, s.output, s.parameters)}

    return Block("consistent_start", reads, writes, step, opaque=True)


def at_consistent_start(plant: Plant, blocks: Sequence[Block]) -> list[Block]:
    """Return the blocks with that state in place of the measured one."""
    return [fed(block, plant.state.name, like(plant.state, _STATE)) for block in blocks]


_PLANNED, _BEFORE = "_planned_with", "_planned_with_before"


def held_model(problem: Problem) -> tuple[Block, Delay]:
    """Return the block (whether a plan is due, parameters) -> parameters of the last plan, and what is remembered."""
    parameters = problem.plant.parameter
    before = Signal(_BEFORE, parameters.elements, parameters.units)

    def step(s: Signals) -> dict[str, Value]:
        return {_PLANNED: ca.if_else(s._due > 0.5, s.parameters, getattr(s, _BEFORE))}

    reads = Layout((scalar("_due"), parameters, before))
    return Block("planned_model", reads, Layout((_planned(problem),)), step), Delay(before, _PLANNED)


def as_planned(block: Block, problem: Problem) -> Block:
    """Return the block with the parameters of the last plan in place of the newest ones."""
    return fed(block, problem.plant.parameter.name, _planned(problem))


def _planned(problem: Problem) -> Signal:
    parameters = problem.plant.parameter
    return Signal(_PLANNED, parameters.elements, parameters.units)


_LATEST: Latest[np.ndarray] = Latest(8)


def first_memory_of(problem: Problem, optimiser: Optimiser, ocp: OptimalControl) -> np.ndarray:
    """Return the optimiser's memory before the run, with the numbers of the build."""
    state, inputs = problem.start_state, np.asarray(problem.inputs_before, dtype=float)

    def made() -> np.ndarray:
        return first_memory(optimiser, ocp, np.asarray(ocp.start(state, inputs).full()).ravel(), ocp.nodes[2])

    return _LATEST.of((ocp, optimiser), (state.tobytes(), inputs.tobytes(), plans_are_compiled()), made).copy()
