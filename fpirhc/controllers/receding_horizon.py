"""Receding-horizon control with a deformed acceleration, and what is tracked between two plans. Theory: docs/theory.md."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller, closing_blocks, reference_block
from fpirhc.controllers.built import Built
from fpirhc.deformation.base import Deformation, Identity
from fpirhc.deformation.sigmoid import Sigmoid
from fpirhc.errors import InvalidName, InvalidProblem, nearest
from fpirhc.fields.kinds import NotNegative
from fpirhc.horizon.cost import Cost
from fpirhc.horizon.nominal import consistent_state, offset_limits, shifted_reference
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.transcription import transcribe
from fpirhc.optimisers import Optimiser, built, first_memory
from fpirhc.optimisers.fixed_point import FixedPointSolver
from fpirhc.plant.chain import without_disturbances
from fpirhc.plant.integrators import USUAL
from fpirhc.plant.plant import Plant
from fpirhc.status import Status
from fpirhc.symbolic.block import Block, Delay, every, fed
from fpirhc.symbolic.driver import plans_are_compiled
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import Signals, Value, expression, graph
from fpirhc.symbolic.layout import Expression, Layout, Signal, like, scalar
from fpirhc.task.checks import cycles_per_plan
from fpirhc.task.exogenous import model_values
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Tracking, bounded

_SOLVE = ("cost", "stationarity", "feasibility", "iterations", "status")


@dataclass(frozen=True)
class RecedingHorizon(Controller):
    """Model-predictive control with a fixed-point deformation of its nominal acceleration.

    Args:
        optimiser: finds the plan.
        deformation: the map between desired response and request; Identity() is plain receding-horizon control.
        tracking: the law that keeps the plant on the planned motion, which then starts from the model's own state; None: every plan
            starts from the measured state, and its first response is the desired one.
        cost: of the plan; None: the problem's.
        room: by name of an input, what plans leave of its range at both ends, for `tracking` and deformation; 0 where not named. A
            plan then depends on the plans before it alone, whatever the plant does, which a certificate needs. None: plans have the
            range less the deformation of the last cycle, so they depend on the plant.
        consistent: whether a plan on outputs from the measured state starts at the state at which the model has measured outputs
            and derivatives, see `fpirhc.horizon.nominal`; None: where a deformation, or a believed disturbance of the response,
            makes the plant's response that of the plan: the plant then moves as it foresees. Coordinates are always consistent.
    """

    optimiser: Optimiser
    deformation: Deformation = field(default_factory=Identity)
    tracking: Tracking | None = None
    cost: Cost | None = None
    room: Mapping[str, NotNegative] | None = field(default=None, kw_only=True, hash=False)
    consistent: bool | None = field(default=None, kw_only=True)

    def notes(self, problem: Problem) -> tuple[str, ...]:
        sensing, planner = problem.sensing, self.planner
        assert planner is not None
        given = sensing.observer is None and sensing.delay(problem.plant, problem.period) > 0
        text = "its plans start where the model has the estimated outputs, and those without adaptation at the given state, so the "
        text += "pair differs with a right model too; consistent=False starts both at the state"
        return (text,) if given and planner.consistent is None and planner.starts_consistent(problem.plant) else ()

    def check(self, problem: Problem) -> None:
        """Raise if the problem has no horizon or cost, or the optimiser does not support it."""
        if problem.horizon is None:
            raise InvalidProblem("RecedingHorizon needs Problem(horizon=...), which this problem does not have")
        if self.cost is None and problem.cost is None:
            raise InvalidProblem("RecedingHorizon needs Problem(cost=...) or a cost of its own")
        if self.room is not None and self.tracking is None:
            raise InvalidProblem("RecedingHorizon: room is what plans leave for `tracking`; give the law, or omit it")
        _room(problem, self.room)
        assert self.planner is not None
        self.optimiser.check(_optimal_control(self.planner.planned(problem)))

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        problem, plant, planner = built.planned, built.plant, self.planner
        assert problem is not None
        assert planner is not None
        assert problem.horizon is not None
        cycles = cycles_per_plan(problem.horizon, problem.period)
        parts = from_measurement(built) if self.tracking is None else from_plan(built, self.tracking)
        (before, after, late, remembered), room = parts, _room(problem, self.room)
        same = built.problem, self.optimiser, self.tracking, self.cost, self.room, self.consistent
        others = self.deformation.adapts, built.follows, plans_are_compiled()
        plan = _PLANS.of(same, others, lambda: every(_plan_block(problem, self, room), cycles))
        closing, delays = closing_blocks(built, self.deformation, [scalar("_solve_status")])
        if planner.starts_consistent(plant):
            before, after = (at_consistent_start(plant, some) for some in (before, after))
            before = [consistent_start(plant), *before]
            closing = closing if planner.corrects(plant) else at_consistent_start(plant, closing)
        if built.follows:
            held, own = held_model(problem)
            newest, planned = problem.plant.parameter.name, _planned(problem)
            after, delays = [held, *(fed(block, newest, planned) for block in after)], [*delays, own]
        blocks = [reference_block(built), _due_block(cycles), *before, plan, *after, *closing, *late]
        delays = [*delays, *remembered]
        blocks.append(_command_shift_block(problem, self.deformation))
        delays.append(Delay(like(plant.input, "_command_shift_last"), "command_shift"))
        if room is not None:
            delays.append(Delay(replace(built.before, name=_PLANNED_BEFORE), "planned"))
        return blocks, delays


_PLANS: Latest[Block] = Latest(8)  # controllers that differ in their deformation alone plan alike


def _optimal_control(problem: Problem) -> OptimalControl:
    assert problem.horizon is not None
    assert problem.cost is not None
    ahead, limits, start = model_values(problem.plant, problem.signals), problem.limits, problem.start_state
    return transcribe(problem.plant, problem.reference, problem.horizon, problem.cost, limits, ahead, start)


def _due_block(cycles: int) -> Block:
    """Block -> whether a new plan is due in this cycle."""
    count = scalar("plan_count")

    def step(s: Signals) -> dict[str, Expression]:
        count_next = s.plan_count + 1
        return {"_due": s.plan_count < 0.5, "plan_count_next": ca.if_else(count_next > cycles - 0.5, 0, count_next)}

    return Block("due", Layout(), Layout((scalar("_due"),)), step, Layout((count,)))


_PLANNED_BEFORE = "_planned_before"


def _room(problem: Problem, given: Mapping[str, float] | None) -> np.ndarray | None:
    """What plans leave of the range of every input, shape (nu,); None: their range less the deformation of the last cycle."""
    if given is None:
        return None
    names = list(problem.plant.inputs)
    for name in given:
        if name not in names:
            raise InvalidName(f"RecedingHorizon: room of input '{name}' is unknown.{nearest(name, names)}")
    room = np.array([float(given.get(name, 0.0)) for name in names])
    for name, low, high, own in zip(names, *problem.limits.input_bounds(problem.plant), room, strict=True):
        if low + own >= high - own:
            raise InvalidProblem(
                f"RecedingHorizon: a room of {own:g} leaves nothing of input '{name}' between {low:g} and {high:g}; "
                f"less than {0.5 * (high - low):g} leaves something"
            )
    return room


def _plan_block(problem: Problem, controller: RecedingHorizon, room: np.ndarray | None) -> Block:
    """Block (time, plan state, parameters, shift and command of the last cycle) -> (planned input, solve statistics)."""
    assert problem.horizon is not None
    assert problem.cost is not None
    optimiser, planner = controller.optimiser, controller.planner
    assert planner is not None
    plant, horizon, ocp = problem.plant, problem.horizon, _optimal_control(problem)
    preview, corrected = problem.reference.preview(plant, horizon.nodes), planner.feeds_back(plant)
    data_of = ocp.data_of(previewed=preview is not None)
    memory = optimiser.memory(ocp).starting_at(first_memory_of(problem, optimiser, ocp))
    solve = built(optimiser, ocp, optimiser.step)

    def step(s: Signals) -> dict[str, Value]:
        own = [getattr(s, one.name) for one in problem.own_signals]
        motion = () if preview is None else preview(s.time, *own)
        data = data_of(s.time, *motion, s.parameters)
        for seen in plant.beside if planner.restarts else ():  # outputs that are given beside the state
            shifted = shifted_reference(plant, ocp.data, ocp.stages + 1, corrected=corrected)
            data = shifted(data, s._plan_state, getattr(s, seen.name), s.parameters, s._command_before)
        if horizon.measured:
            data = offset_limits(plant, horizon, ocp.data)(data, s._plan_state, s.state)
        if room is None:
            # The shift of the last cycle is added to the plan's inputs, so their rate counts from the last command without it.
            first = ocp.start(s._plan_state, s._command_before - s._command_shift_last)
            lower, upper = ocp.ends(s._command_shift_last, s._command_shift_last)
        else:
            own_room, planned_before = ca.MX(ca.DM(room)), getattr(s, _PLANNED_BEFORE)
            first = ocp.start(s._plan_state, planned_before)
            lower, upper = ocp.ends(expression(-own_room), expression(own_room))
        before = graph(memory.join({m: getattr(s, m) for m in memory.names}))
        remembered = expression(ca.if_else(graph(s.plan_begun) > 0.5, optimiser.shifted(ocp, before), before))
        inputs, diagnostics, next_memory = solve(first, data, lower, upper, remembered)
        status = diagnostics[_SOLVE.index("status")]
        # else the plan is held, of least violation or the last one, shifted
        judged = ca.if_else(status > int(Status.NOT_CONVERGED) + 0.5, int(Status.HELD), status)
        remembered_next = {f"{m}_next": v for m, v in memory.split(next_memory).items()}
        return {
            "planned": inputs[:, 0],
            "solve": diagnostics,
            "_solve_status": judged,
            "plan_begun_next": 1,
            **remembered_next,
        }

    own = memory + Layout((scalar("plan_begun"),))
    writes = (like(plant.input, "planned"), Signal("solve", _SOLVE), scalar("_solve_status"))
    return Block("plan", _plan_reads(problem, room), Layout(writes), step, own, opaque=True)


def _plan_reads(problem: Problem, room: np.ndarray | None) -> Layout:
    """Time, start of the plan, parameters, last command and its shift or last plan, outputs, own signals."""
    plant = problem.plant
    names = ("_command_shift_last", "_command_before") if room is None else (_PLANNED_BEFORE,)
    last = tuple(like(plant.input, name) for name in names)
    assert problem.horizon is not None
    own, outputs = problem.own_signals, plant.beside
    outputs = (*outputs, plant.state) if problem.horizon.measured else outputs
    start = like(plant.state, "_plan_state")
    return Layout((plant.time, start, *outputs, plant.parameter, *last, *own))


def _command_shift_block(problem: Problem, deformation: Deformation) -> Block:
    """Block (planned input, command) -> the deformation's change of the command; zero without adaptation."""
    plant = problem.plant
    reads, writes = Layout((like(plant.input, "planned"), plant.input)), Layout((like(plant.input, "command_shift"),))

    def step(s: Signals) -> dict[str, Expression]:
        return {"command_shift": s.command - s.planned if deformation.adapts else 0 * s.command}

    return Block("command_shift", reads, writes, step)


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
    plant, law = built.plant, bounded(tracking, built.largest)

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


EXAMPLES = (RecedingHorizon(FixedPointSolver(iterations=2, tolerance=1e-3), Sigmoid(gain=-0.5, scale=50.0)),)
