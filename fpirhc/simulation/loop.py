"""Closes the loop: controller blocks and the exact plant as ONE step, from what moves through sensors to the command and back.

Per cycle k the loop holds the plant's state x_k and the response that was realised just before t_k under the command
held since t_{k-1}; sensors and their dead time show them to the controller, which turns them into a command; the plant moves
on by one period with that command held. The way from the command to what moves is in `fpirhc.simulation.moved`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller, closing_blocks, reference_block
from fpirhc.controllers.believed import plant_model
from fpirhc.controllers.built import Built, build
from fpirhc.controllers.contract import Undeformed
from fpirhc.controllers.gate import INNER
from fpirhc.controllers.seeing import seeing_blocks
from fpirhc.plant.chain import response_names
from fpirhc.sensing.base import backward_difference, combine
from fpirhc.simulation.moved import Mover, acting_blocks, moving, outside_blocks, real_signals
from fpirhc.simulation.replay import answer_blocks, gated_blocks
from fpirhc.simulation.tables import disturbance_signal
from fpirhc.symbolic.block import Block, Composite, Delay, compose, rename
from fpirhc.symbolic.expression import Signals, Value, expression
from fpirhc.symbolic.layout import Expression, Layout, Signal, like, scalar, vector
from fpirhc.task.dead_time import Queue, delay_block
from fpirhc.task.problem import Problem


def closed_loop(built: Built) -> Composite:
    """Return the closed loop of what is built as one step: (memory, [disturbance], [sensing], [setpoints]) -> (memory, trace).

    With an `ExternalPlant` the step also reads its measurements, and returns the inputs that it is sent.

    Both parameter sets are part of the memory (constant), so that other values need no new Function. The
    disturbance input exists only when the problem has disturbances, `sensing` only where sensors are noisy or lose samples,
    `setpoints` only where the reference is given some.
    """
    problem = built.problem
    mover, inner = moving(problem), built.step
    disturbed = (disturbance_signal(problem),) if problem.disturbances else ()
    seeing = sensing_blocks(mover, predicts="state_ahead" in inner.trace)
    judging = [block for block in seeing if "reference" in block.reads]  # along the reference that the controller had
    seeing = [block for block in seeing if block not in judging]
    clock, actuating = _clock_block(problem.plant.time, problem.period), acting_blocks(mover, disturbed)
    outside = [clock, *outside_blocks(mover, built.model), *answer_blocks(mover)]
    around = [*outside, *seeing, *gated_blocks(mover, inner), *judging, *actuating]
    reads = Layout((*disturbed, *problem.sensing.drawn, *built.given, *mover.reads))
    return compose("loop", reads, around, mover.delays, outputs=mover.sent, constants=(built.model.parameter,))


def start_memory(loop: Composite, problem: Problem, controller: Controller) -> np.ndarray:
    """Return the first memory of a loop, shape (loop.memory.size,).

    Args:
        problem: the problem of the loop, or one that differs from it in the exact parameters only.
    """
    mover, whole = moving(problem), loop.memory.start()
    blocks = (*sensing_blocks(mover, predicts=False), *seeing_blocks(problem)[0])
    signals = [signal for block in blocks for signal in block.memory.signals]
    signals += [*(delay.now for delay in mover.delays), plant_model(problem, controller).parameter]
    if INNER in loop.memory and plans_exactly(loop, problem, controller):
        whole[loop.memory.slice(INNER)] = build(problem, controller).step.memory.start()
    # A graph has the estimator's memory inside the controller's one signal.
    places = {column.removeprefix(f"{INNER}."): k for k, column in enumerate(loop.memory.columns)}
    for signal in signals:
        whole[[places[column] for column in signal.columns]] = signal.start_vector()
    return whole


def plans_exactly(loop: Composite, problem: Problem, controller: Controller) -> bool:
    """Return whether plans know the exact parameters, and those of this problem are not those of the build."""
    model, of_build = plant_model(problem, controller), loop.memory["parameters"].start_vector()
    exact = controller.planner is not None and model.exact
    return exact and not np.array_equal(of_build, model.parameters(model.plant))


def _clock_block(time: Signal, period: float) -> Block:
    """Block -> time, computed from a counter so that no rounding error grows in a long run."""

    def step(s: Signals) -> dict[str, Expression]:
        return {"time": s.cycle * period, "cycle_next": s.cycle + 1}

    return Block("clock", Layout(), Layout((time,)), step, Layout((scalar("cycle"),)))


@dataclass(frozen=True)
class HeldInput(Undeformed):
    """Sends the input before the run, within the limits."""

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        plant, (closing, delays), held = built.plant, closing_blocks(built), ca.DM(built.before.start_vector())
        responses = [plant.response_signal(name) for name in ("nominal", "desired", "_deformed_unclipped")]

        def step(s: Signals) -> dict[str, Expression]:
            response = plant.equations.controlled_response(s.state, held, s.parameters)
            return {"command_unclipped": expression(held), **{r.name: response for r in responses}}

        writes = Layout((*responses, like(plant.input, "command_unclipped")))
        return [
            reference_block(built),
            Block("hold", Layout((plant.state, plant.parameter)), writes, step),
            *closing,
        ], delays


Shown: TypeAlias = tuple[tuple[Signal, ...], Signal]  # signals of the motion, and of the response
_PAST, _FULL = "_outputs_past", "_outputs_known"


def sensing_blocks(mover: Mover, *, predicts: bool) -> list[Block]:
    """Motion and response as the controller is given them; where these are not the plant's own, also the true ones and error."""
    problem, plant = mover.problem, mover.problem.plant
    response = plant.response_signal("realised")
    at_once = problem.sensing.ideal and not problem.dead_time.measurement
    if at_once and not problem.reality_or_model.seen:
        sense = [mover.sense(plant.motion, response)]
        return [*sense, _error_block(problem, plant.output)] if predicts or problem.dead_time.inputs else sense
    true, shown = _true_blocks(mover, response)
    if predicts and not mover.shows_itself and all(map(problem.moves.shows, problem.judged_names)):
        true = [*true, _error_block(problem, shown[0][-1])]  # the reference of the controller is that of a later time
    if at_once:
        return true  # with coordinates measured in place of others
    return [*true, *_late_blocks(problem, shown)]


def _true_blocks(mover: Mover, response: Signal) -> tuple[list[Block], Shown]:
    """Blocks of the true motion, response and error; and the signals that sensors see."""
    problem, motion = mover.problem, mover.motion
    hidden = tuple(like(s, f"_seen_{s.name}") for s in motion), like(response, "_seen")
    if not mover.shows_itself:
        return [mover.sense(*hidden)], hidden
    true = tuple(like(s, f"plant_{s.name}") for s in motion), like(response, "plant_realised")
    sense = mover.sense(*true)
    sense = with_true_response(problem, sense, true[0][-1], true[1])
    blocks = [sense, _error_block(problem, true[0][-1])]
    if not problem.reality_or_model.seen:
        return blocks, true
    direct = problem.sensing.ideal and not problem.dead_time.measurement
    shown = (motion, response) if direct else hidden
    return [*blocks, _seen_block(problem, shown)], shown


def _late_blocks(problem: Problem, shown: Shown) -> list[Block]:
    """Blocks of sensors and their dead time, from what the sensors see to what the controller is given.

    Sensors are those of the outputs where the plant has some; its state then comes with the dead time alone.
    """
    plant, late, sensing = problem.plant, problem.dead_time.measurement_wait(problem.period), problem.sensing
    first = problem.first_output
    starts = {plant.state.name: problem.start_state, plant.output.name: first}
    motion = zip(shown[0], plant.motion, strict=False)
    # a believed state is the controller's own
    states = [(true, to, starts[to.name]) for true, to in motion] if sensing.observer is None else []
    if not sensing.ideal:
        others = states[:-1]
        sensors = [
            *_late_states(others, late),
            *sensing.blocks(plant, problem.first_shown, late, (*shown[0], shown[1])),
        ]
        if sensing.estimates:
            return sensors
        raw = sensing.raw(plant, problem.first_shown, late)
        return [*sensors, sensing.estimator.block(plant, problem.period, first, raw)]
    assert late is not None
    resting = tuple(problem.first_shown[name] for name in response_names(plant))
    realised = replace(shown[1], name="realised", start=resting)
    return [*_late_states(states, late), delay_block("see_response", shown[1], realised, [late] * realised.size)]


def _late_states(states: Sequence[tuple[Signal, Signal, np.ndarray]], late: Queue | None) -> list[Block]:
    """Blocks of the dead time from true signals to measured ones, with the values before the run."""
    if late is None:
        return [rename(f"see_{to.name}", true, to) for true, to, _ in states]
    return [
        delay_block(f"see_{to.name}", true, replace(to, start=tuple(map(float, start))), [late] * to.size)
        for true, to, start in states
    ]


def _error_block(problem: Problem, motion: Signal) -> Block:
    """Block (time, true state or outputs) -> true error of the judged ones."""
    plant = problem.plant
    places = [plant.output.elements.index(c) for c in problem.judged_names]
    own = [motion.elements.index(c) for c in problem.judged_names]  # what moves may not have every state of the model
    writes = Layout((vector("true_error", problem.judged_names, [plant.followed[c] for c in problem.judged_names]),))
    if problem.given_signals:
        reads = Layout((like(plant.output, "reference"), motion))
        return Block(
            "true_error", reads, writes, lambda s: {"true_error": s.reference[places] - getattr(s, motion.name)[own]}
        )
    function, reads = problem.reference.motion_now(plant), Layout((plant.time, motion, *problem.own_signals))

    def step(s: Signals) -> dict[str, Expression]:
        along = function(s.time, *(getattr(s, one.name) for one in problem.own_signals))[0]
        return {"true_error": along[places] - getattr(s, motion.name)[own]}

    return Block("true_error", reads, writes, step)


def _seen_block(problem: Problem, shown: Shown) -> Block:
    """Block -> the state, the outputs and the response that are measured in place of the true ones."""
    motion, response = shown
    functions = {one.name: problem.reality_or_model.function(one.elements, seen=True) for one in motion}
    functions[response.name] = problem.reality_or_model.function(response_names(problem.plant), seen=True)

    def step(s: Signals) -> dict[str, Expression]:
        now = (s._state_before, s._acting_before, s._exact, s._forcing_before)
        return {name: function(*now) for name, function in functions.items()}

    return Block("seen", Layout(real_signals(problem)), Layout((*motion, response)), step)


def with_true_response(problem: Problem, sense: Block, motion: Signal, response: Signal) -> Block:
    """Return the block of the true motion; on a map with the true response in place of the one that it writes.

    `motion`: signal of the state, or of the outputs where the plant has some.
    """
    period, orders = problem.period, problem.plant.response_orders
    if not any(problem.plant.differences.values()):
        return sense
    places = {c: problem.plant.output.elements.index(c) for c in orders}
    entries = [(c, j) for c, order in orders.items() for j in range(1, order + 1)]
    past = Signal(_PAST, tuple(f"{c}@{j}" for c, j in entries))
    known = Signal(_FULL)

    def step(s: Signals) -> dict[str, Value]:
        values = dict(sense.step(s))
        before = dict(zip(entries, ca.vertsplit(getattr(s, _PAST)), strict=True))
        now = expression(values[motion.name])
        samples = {c: [now[k], *(before[c, j] for j in range(1, orders[c] + 1))] for c, k in places.items()}
        enough = getattr(s, _FULL)
        values[response.name] = ca.vertcat(
            *(
                ca.if_else(enough > order - 0.5, combine(backward_difference(order), samples[c]) / period**order, 0)
                for c, order in orders.items()
            )
        )
        values[f"{_PAST}_next"] = ca.vertcat(*(samples[c][j - 1] for c, j in entries))
        values[f"{_FULL}_next"] = ca.fmin(enough + 1, max(orders.values()))
        return values

    return replace(sense, step=step, memory=sense.memory + Layout((past, known)))
