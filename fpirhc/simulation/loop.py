"""Closes the loop: controller blocks and the exact plant as ONE step.

Per cycle k the loop holds the plant's state x_k and the response that was realised just before t_k under the command
held since t_{k-1}; the controller turns them into a command; the plant moves on by one period with that command held.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller, Response, error_signal, like, rename
from fpirhc.controllers.contract import checked
from fpirhc.controllers.face import measured_signals, on_face
from fpirhc.controllers.gap import BRIDGED, across_gaps, gap_of
from fpirhc.controllers.gate import INNER, Gate
from fpirhc.controllers.live_settings import LiveSettings
from fpirhc.controllers.own_reference import given_signals, own_signals
from fpirhc.controllers.plausible import plausible_range
from fpirhc.controllers.response_jumps import response_jumps
from fpirhc.controllers.seeing import compose_seeing, first_estimates, first_shown, seeing_blocks
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import response_names
from fpirhc.simulation.foreign_blocks import SENT, foreign_block, foreign_signals, sending_block, shows_truth
from fpirhc.simulation.map_blocks import with_true_response
from fpirhc.simulation.outside_blocks import outside_blocks, real_name
from fpirhc.simulation.true_motion import true_motion
from fpirhc.symbolic.block import Block, Composite, Delay, compose
from fpirhc.symbolic.expression import Signals, expression
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.symbolic.live import PREFIX, nominal
from fpirhc.task.dead_time import MEASUREMENT, Wait, delay_block
from fpirhc.task.output_disturbance import LOGGED, added, disturbance_signal, logged_signal
from fpirhc.task.problem import Problem

Shown: TypeAlias = tuple[tuple[Signal, ...], Signal]  # signals of the motion, and of the response
REALITY_STATE = "reality_state"  # signal of the state of a reality, in its own coordinates


def close_loop(problem: Problem, controller: Controller, live: LiveSettings | None = None) -> Composite:
    """Return the closed loop as one step: (memory, [disturbance], [sensing], [setpoints]) -> (memory, trace).

    With a foreign reality the step also reads its measurements, and returns the inputs that it is sent.

    Both parameter sets are part of the memory (constant), so that other values need no new Function; live settings likewise. The
    disturbance input exists only when the problem has disturbances, `sensing` only where sensors are noisy or lose samples,
    `setpoints` only where the reference is given some.

    Raises:
        NotSupported: a live setting that this loop cannot keep open.
    """
    if live is not None:
        return live.composed(lambda problem, controller: _closed(problem, controller, live))
    return _closed(problem, controller, None)


def _closed(problem: Problem, controller: Controller, live: LiveSettings | None) -> Composite:
    ready = checked(problem, controller)
    task = nominal(problem)
    # What a body outside measures may be wrong; what the loop computes itself is a result, however far it goes.
    plausible = plausible_range(task) if problem.foreign is not None else {}
    inner, gap = across_gaps(compose_seeing(problem, ready)), gap_of(task, BRIDGED)
    acting = Gate(task, inner, trusted=("time", "memory"), plausible=plausible, gap=gap)
    disturbed = disturbance_signals(problem)
    seeing = _sense_blocks(problem, ready.response(problem), predicts="state_ahead" in acting.inner.trace)
    judging = [block for block in seeing if "reference" in block.reads]  # along the reference that the controller had
    seeing = [block for block in seeing if block not in judging]
    clock, actuating = _clock_block(problem.plant.time, problem.period), _actuate(problem, disturbed)
    jumps = response_jumps(task, acting.reads) if problem.foreign is not None else None
    gated = [acting.block()] if jumps is None else jumps.around(acting.block())
    around = [clock, *outside_blocks(problem, ready), *seeing, *gated, *judging, *actuating]
    constants = live.held(around) if live is not None else []
    reads = Layout((*disturbed, *problem.sensing.drawn, *given_signals(problem), *foreign_signals(problem)))
    sent = () if problem.foreign is None else (SENT,)
    return compose("loop", reads, around, [*_plant_delays(problem, ready), *constants], outputs=sent)


def start_memory(
    loop: Composite, problem: Problem, controller: Controller, numbers: Mapping[str, float] | None = None
) -> np.ndarray:
    """Return the first memory of a loop, shape (loop.memory.size,).

    Args:
        loop: from `close_loop`.
        problem: the problem of the loop, or one that differs from it in the exact parameters only.
        controller: the controller of the loop, resolved.
        numbers: of all live settings, by path; None: those of the build.
    """
    remembered = []
    if not problem.sees_plant:
        sensing = _sense_blocks(problem, controller.response(problem), predicts=False)
        remembered += [s for block in sensing for s in block.memory.signals]
    remembered += [delay.now for delay in _plant_delays(problem, controller)]
    starts = {s.name: s.start_vector() for s in remembered}
    if numbers:
        derived = loop.derived(numbers)
        starts |= {PREFIX + path: np.array([value]) for path, value in numbers.items()}
        starts |= {**derived.signals, **derived.memory()}
    return loop.memory.pack(starts | _first_estimates(loop, problem, starts))


def _first_estimates(loop: Composite, problem: Problem, starts: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What the estimator remembers at the start of this problem; a graph has it inside the controller's one signal."""
    own = [s for block in seeing_blocks(problem) for s in block.memory.signals]
    if not own or own[0].name in loop.memory:
        return {s.name: s.start_vector() for s in own}
    whole = loop.memory[INNER]
    start, places = starts.get(INNER, whole.start_vector()).copy(), {c: k for k, c in enumerate(whole.elements)}
    for s in own:
        start[[places[c] for c in s.columns]] = s.start_vector()
    return {INNER: start}


def disturbance_signals(problem: Problem) -> tuple[Signal, ...]:
    """Return the signal of all disturbances in the order of the problem, or nothing when there are none."""
    if not problem.disturbances:
        return ()
    return (disturbance_signal(problem),)


def _plant_delays(problem: Problem, controller: Controller) -> list[Delay]:
    plant, model = problem.real_plant, controller.plant_model(problem)
    believed = _held("parameters", model.plant, model.parameters(model.plant))
    if problem.foreign is not None:
        return [believed]
    start = tuple(float(v) for v in problem.real_start)
    acting = tuple(map(float, problem.inputs_before))
    return [
        Delay(Signal("_state_before", plant.state.elements, plant.state.units, start), "_state_after"),
        Delay(Signal("_acting_before", plant.input.elements, plant.input.units, acting), "_acting"),
        Delay(_forcing(plant, "_forcing_before"), "_forcing"),
        believed,
        replace(_held("_exact", plant, problem.real_parameters), source=real_name(problem)),
    ]


def _held(name: str, plant: Plant, values: np.ndarray) -> Delay:
    """Parameters that stay what they are during a run."""
    return Delay(Signal(name, plant.parameter.elements, plant.parameter.units, tuple(map(float, values))), name)


def _forcing(plant: Plant, name: str) -> Signal:
    """Signal of what disturbances add to the response of every coordinate."""
    return Signal(name, plant.names, plant.response_units)


def _clock_block(time: Signal, period: float) -> Block:
    """Block -> time, computed from a counter so that no rounding error grows in a long run."""

    def step(s: Signals) -> dict[str, Expression]:
        return {"time": s.cycle * period, "cycle_next": s.cycle + 1}

    return Block("clock", Layout(), Layout((time,)), step, Layout((scalar("cycle"),)))


def _sense_blocks(problem: Problem, other: Response | None, *, predicts: bool) -> list[Block]:
    """Motion and response as the controller is given them; where these are not the plant's own, also the true ones and error."""
    plant, response = problem.plant, other or true_response(problem)
    if problem.sees_plant:
        sense = [_sense_block(problem, measured_signals(plant), response)]
        return [*sense, _truth_block(problem, plant.output)] if predicts or problem.dead_time.inputs else sense
    true, shown = _true_blocks(problem, response)
    if problem.sensing.ideal and MEASUREMENT not in problem.dead_time.queued:
        return true  # with coordinates measured in place of others
    return [*true, *_late_blocks(problem, shown)]


def _true_blocks(problem: Problem, response: Response) -> tuple[list[Block], Shown]:
    """Blocks of the true motion, response and error; and the signals that sensors see."""
    motion = true_motion(problem)
    hidden = tuple(like(s, f"_seen_{s.name}") for s in motion), like(response.signal, "_seen")
    if problem.foreign is not None and not shows_truth(problem):
        return [_sense_block(problem, hidden[0], Response(hidden[1], response.function))], hidden
    true = tuple(like(s, f"plant_{s.name}") for s in motion), like(response.signal, "plant_realised")
    sense = _sense_block(problem, true[0], Response(true[1], response.function))
    if problem.sensing.estimator.of_steps:
        sense = with_true_response(problem, sense, true[0][-1], true[1])
    blocks = [sense, _truth_block(problem, true[0][-1])]
    if not problem.truth.seen:
        return blocks, true
    direct = problem.sensing.ideal and MEASUREMENT not in problem.dead_time.queued
    shown = (motion, response.signal) if direct else hidden
    return [*blocks, _seen_block(problem, shown)], shown


def _late_blocks(problem: Problem, shown: Shown) -> list[Block]:
    """Blocks of sensors and their dead time, from what the sensors see to what the controller is given.

    Sensors are those of the outputs where the plant has some; its state then comes with the dead time alone.
    """
    plant, late, sensing = problem.plant, problem.dead_time.measurement_wait(problem.period), problem.sensing
    first, resting = first_estimates(problem)
    starts = (problem.start_state, first) if plant.outputs else (first,)
    states_pass = sensing.belief is None  # a believed state is the controller's own
    states = [*zip(shown[0], measured_signals(plant), starts, strict=True)] if states_pass else []
    if not sensing.ideal:
        others = states[:-1]
        all_shown = first_shown(problem)
        sensors = [*_late_states(others, late), *sensing.blocks(plant, all_shown, late, (*shown[0], shown[1]))]
        if sensing.estimates:
            return sensors
        raw = sensing.raw(plant, all_shown, late)
        return [*sensors, on_face(plant, sensing.estimator.block(plant.face, problem.period, first, raw))]
    assert late is not None
    realised = replace(shown[1], name="realised", start=tuple(map(float, resting)))
    return [*_late_states(states, late), delay_block("see_response", shown[1], realised, [late] * realised.size)]


def _late_states(states: Sequence[tuple[Signal, Signal, np.ndarray]], late: Wait | None) -> list[Block]:
    """Blocks of the dead time from true signals to measured ones, with the values before the run."""
    if late is None:
        return [rename(f"see_{to.name}", true, to) for true, to, _ in states]
    return [
        delay_block(f"see_{to.name}", true, replace(to, start=tuple(map(float, start))), [late] * to.size)
        for true, to, start in states
    ]


def _truth_block(problem: Problem, motion: Signal) -> Block:
    """Block (time, true state or outputs) -> true error of the judged ones."""
    plant = problem.plant
    places = [plant.output.elements.index(c) for c in problem.judged_names]
    own = [motion.elements.index(c) for c in problem.judged_names]  # what moves may not have every state of the model
    writes = Layout((error_signal(problem, "true_error"),))
    if own_signals(problem):
        reads = Layout((like(plant.output, "reference"), motion))
        return Block(
            "truth", reads, writes, lambda s: {"true_error": s.reference[places] - getattr(s, motion.name)[own]}
        )
    function = problem.reference.function(plant)

    def step(s: Signals) -> dict[str, Expression]:
        return {"true_error": function(s.time)[0][places] - getattr(s, motion.name)[own]}

    return Block("truth", Layout((plant.time, motion)), writes, step, opaque=problem.reference.opaque)


def true_response(problem: Problem) -> Response:
    """The response of what the controller controls, of the plant that moves."""
    plant = problem.plant
    return Response(plant.response_signal("realised"), problem.truth.function(response_names(plant.face)))


def _real_signals(problem: Problem) -> tuple[Signal, ...]:
    """What the plant that moves carries over a cycle: state, acting input, parameters, forcing."""
    plant = problem.real_plant
    names = "_state_before", "_acting_before", "_exact"
    signals = (like(s, n) for s, n in zip((plant.state, plant.input, plant.parameter), names, strict=True))
    return (*signals, _forcing(plant, "_forcing_before"))


def _sense_block(problem: Problem, motion: Sequence[Signal], response: Response) -> Block:
    """Block -> the true state and outputs, and the true response just before this cycle's command; with a reality also its state.

    The response is computed here and not at the end of the last cycle, because it shares its costly terms with the first
    Runge-Kutta evaluation of this cycle. Outputs are those of the moving plant, with its exact parameters.
    """
    if problem.foreign is not None:
        return foreign_block(problem, motion, response.signal)
    reads, writes, truth = _real_signals(problem), (*motion, response.signal), problem.truth
    own = () if problem.symbolic_reality is None else (like(truth.plant.state, REALITY_STATE),)
    shown = {signal.name: truth.function(signal.elements) for signal in motion}
    shifts = bool(problem.disturbed_outputs)
    if shifts:
        reads, writes = (*reads, disturbance_signal(problem)), (*writes, logged_signal(problem))

    def step(s: Signals) -> dict[str, Expression]:
        now = (s._state_before, s._acting_before, s._exact, s._forcing_before)
        values = {response.signal.name: response.function(*now)}
        values |= {name: function(*now) for name, function in shown.items()}
        if shifts:
            below, answered = added(problem, s.disturbance)
            sums = {response.signal.name: answered, motion[-1].name: below}
            values |= {name: values[name] + more for name, more in sums.items()} | {LOGGED: below}
        return {**values, **{signal.name: s._state_before for signal in own}}

    return Block("sense", Layout(reads), Layout((*writes, *own)), step)


def _seen_block(problem: Problem, shown: Shown) -> Block:
    """Block -> the state and the response that are measured in place of the true ones."""
    state = problem.truth.function(shown[0][0].elements, seen=True)
    response = problem.truth.function(response_names(problem.plant.face), seen=True)

    def step(s: Signals) -> dict[str, Expression]:
        now = (s._state_before, s._acting_before, s._exact, s._forcing_before)
        return {shown[0][0].name: state(*now), shown[1].name: response(*now)}

    return Block("seen", Layout(_real_signals(problem)), Layout((*shown[0], shown[1])), step)


def _actuate(problem: Problem, disturbed: tuple[Signal, ...]) -> list[Block]:
    """Blocks of the command's way to the plant, and of the plant over one period."""
    if not set(problem.plant.inputs) & set(problem.dead_time.queued):
        return [_advance_block(problem, disturbed, problem.plant.input)]
    plant, waits = problem.plant, [problem.dead_time.wait(name, problem.period) for name in problem.plant.inputs]
    arriving = Signal("arriving", plant.input.elements, plant.input.units, tuple(map(float, problem.inputs_before)))
    return [
        delay_block("send_command", problem.plant.input, arriving, waits),
        _advance_block(problem, disturbed, arriving),
    ]


def _advance_block(problem: Problem, disturbed: tuple[Signal, ...], arriving: Signal) -> Block:
    """Block of the plant that moves over one period with the arriving command held; a foreign reality is sent its inputs."""
    if problem.foreign is not None:
        return sending_block(problem, disturbed, arriving)
    plant = problem.real_plant
    advance = problem.real_integrator.step(plant, problem.period)
    state = plant.state if problem.sees_plant else like(plant.state, "plant_state")
    if problem.symbolic_reality is not None:  # its state is none of the model's
        state = like(plant.state, REALITY_STATE)
    exact = like(plant.parameter, real_name(problem))
    reads = (state, arriving, exact, *disturbed)
    writes = (like(plant.state, "_state_after"), like(plant.input, "_acting"), _forcing(plant, "_forcing"))

    def step(s: Signals) -> dict[str, Expression]:
        u, w = getattr(s, arriving.name), expression(ca.DM.zeros(len(plant.names)))
        if disturbed:
            adds = dict(zip(disturbed[0].elements, ca.vertsplit(s.disturbance), strict=True))
            u = u + ca.vertcat(*(adds.get(name, 0) for name in plant.inputs))
            w = ca.vertcat(*(adds.get(name, 0) for name in plant.names))
        return {
            "_state_after": advance(getattr(s, state.name), u, getattr(s, exact.name), w),
            "_acting": u,
            "_forcing": w,
        }

    return Block("advance", Layout(reads), Layout(writes), step, opaque=problem.real_integrator.opaque)
