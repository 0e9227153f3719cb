"""Closes the loop: controller blocks and the exact plant as ONE step.

Per cycle k the loop holds the plant's state x_k and the response that was realised just before t_k under the command
held since t_{k-1}; the controller turns them into a command; the plant moves on by one period with that command held.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller, Response, compose_controller, error_signal, like
from fpirhc.controllers.contract import checked
from fpirhc.controllers.gate import Gate
from fpirhc.controllers.live_settings import LiveSettings
from fpirhc.plant.plant import Plant
from fpirhc.simulation.foreign_blocks import SENT, foreign_block, foreign_signals, measures_all, sending_block
from fpirhc.symbolic.block import Block, Composite, Delay, compose
from fpirhc.symbolic.expression import Signals, expression
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.symbolic.live import PREFIX, nominal
from fpirhc.task.dead_time import MEASUREMENT, delay_block
from fpirhc.task.problem import Problem

REALITY_STATE = "reality_state"  # signal of the state of a reality, in its own coordinates


def close_loop(problem: Problem, controller: Controller, live: LiveSettings | None = None) -> Composite:
    """Return the closed loop as one step: (memory, [disturbance], [sensing]) -> (memory, trace).

    With a foreign reality the step also reads its measurements, and returns the inputs that it is sent.

    Both parameter sets are part of the memory (constant), so that other values need no new Function; live settings likewise. The
    disturbance input exists only when the problem has disturbances, `sensing` only where sensors are noisy or lose samples.

    Raises:
        NotSupported: a live setting that this loop cannot keep open.
    """
    if live is not None:
        return live.composed(lambda problem, controller: _closed(problem, controller, live))
    return _closed(problem, controller, None)


def _closed(problem: Problem, controller: Controller, live: LiveSettings | None) -> Composite:
    ready = checked(problem, controller)
    acting = Gate(nominal(problem), compose_controller(problem, ready), trusted=("time", "memory"))
    disturbed = disturbance_signals(problem)
    seeing = _sense_blocks(problem, ready.response(problem), predicts="state_ahead" in acting.inner.trace)
    around = [_clock_block(problem.plant.time, problem.period), *seeing, acting.block(), *_actuate(problem, disturbed)]
    constants = live.held(around) if live is not None else []
    reads = Layout((*disturbed, *problem.sensing.drawn, *foreign_signals(problem)))
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
    return loop.memory.pack(starts)


def disturbance_signals(problem: Problem) -> tuple[Signal, ...]:
    """Return the signal of all disturbances in the order of the problem, or nothing when there are none."""
    if not problem.disturbances:
        return ()
    return (Signal("disturbance", tuple(problem.disturbances)),)


def _plant_delays(problem: Problem, controller: Controller) -> list[Delay]:
    plant, model = problem.real_plant, controller.model_plant(problem)
    believed = _held("parameters", model, controller.parameters(model))
    if problem.foreign is not None:
        return [believed]
    start = tuple(float(v) for v in problem.real_start)
    acting = tuple(map(float, problem.inputs_before))
    return [
        Delay(Signal("_state_before", plant.state.elements, plant.state.units, start), "_state_after"),
        Delay(Signal("_acting_before", plant.input.elements, plant.input.units, acting), "_acting"),
        Delay(_forcing(plant, "_forcing_before"), "_forcing"),
        believed,
        _held("_exact", plant, plant.exact),
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
    """State and response as the controller is given them; where these are not the plant's own, also the true ones and the error."""
    plant, response = problem.plant, other or _own_response(problem, seen=False)
    if problem.sees_plant:
        sense = [_sense_block(problem, plant.state, response)]
        return [*sense, _truth_block(problem, plant.state)] if predicts or problem.dead_time.inputs else sense
    true, shown, function = _true_blocks(problem, response)
    if problem.sensing.ideal and MEASUREMENT not in problem.dead_time.queued:
        return true  # with coordinates measured in place of others
    return [*true, *_late_blocks(problem, shown, function)]


def _true_blocks(problem: Problem, response: Response) -> tuple[list[Block], tuple[Signal, Signal], ca.Function]:
    """Blocks of the true state, response and error; the signals that sensors see; and the Function of the response among these."""
    plant = problem.plant
    hidden = like(plant.state, "_seen_state"), like(response.signal, "_seen")
    if problem.foreign is not None and not measures_all(problem):
        return [_sense_block(problem, hidden[0], Response(hidden[1], response.function))], hidden, response.function
    true = like(plant.state, "plant_state"), like(response.signal, "plant_realised")
    sense = _sense_block(problem, true[0], Response(true[1], response.function))
    blocks = [sense, _truth_block(problem, true[0])]
    if problem.symbolic_reality is None or not problem.symbolic_reality.seen:
        return blocks, true, response.function
    direct = problem.sensing.ideal and MEASUREMENT not in problem.dead_time.queued
    shown = (plant.state, response.signal) if direct else hidden
    function = _own_response(problem, seen=True).function
    return [*blocks, _seen_block(problem, shown, function)], shown, function


def _late_blocks(problem: Problem, shown: tuple[Signal, Signal], response: ca.Function) -> list[Block]:
    """Blocks of sensors, their dead time and the estimator, from what the sensors see to what the controller is given."""
    plant, behind = problem.plant, problem.dead_time.wait(MEASUREMENT, problem.period)
    at = problem.real_start, problem.inputs_before, problem.real_plant.exact, np.zeros(len(problem.real_plant.names))
    resting, first = response(*at).full().ravel(), problem.start_state
    if problem.symbolic_reality is not None:
        first = problem.symbolic_reality.state_function(plant, seen=True)(*at).full().ravel()
    if not problem.sensing.ideal:
        late = behind if MEASUREMENT in problem.dead_time.queued else None
        return problem.sensing.blocks(plant, problem.period, first, late, shown, resting)
    state = replace(plant.state, start=tuple(map(float, first)))
    realised = replace(shown[1], name="realised", start=tuple(map(float, resting)))
    return [
        delay_block("see_state", shown[0], state, [behind] * plant.state.size),
        delay_block("see_response", shown[1], realised, [behind] * realised.size),
    ]


def _truth_block(problem: Problem, state: Signal) -> Block:
    """Block (time, true state) -> true error of the judged coordinates."""
    plant, function = problem.plant, problem.reference.function(problem.plant)
    places = [plant.state.elements.index(c) for c in problem.judged_names]
    writes = Layout((error_signal(problem, "true_error"),))

    def step(s: Signals) -> dict[str, Expression]:
        return {"true_error": (function(s.time)[0] - getattr(s, state.name))[places]}

    return Block("truth", Layout((plant.time, state)), writes, step, opaque=problem.reference.opaque)


def _own_response(problem: Problem, *, seen: bool) -> Response:
    """The response of the controlled coordinates of the plant that moves; where `seen`, the measured one."""
    plant = problem.plant
    if problem.symbolic_reality is not None:
        return Response(plant.response_signal("realised"), problem.symbolic_reality.response_function(plant, seen=seen))
    x, u, p = plant.symbols()
    w = ca.SX.sym("w", len(plant.names))
    response = plant.controlled_response_function(x, u, p) + w[list(plant.controlled_indices)]
    return Response(plant.response_signal("realised"), ca.Function("fpirhc_realised", [x, u, p, w], [response]))


def _real_signals(problem: Problem) -> tuple[Signal, ...]:
    """What the plant that moves carries over a cycle: state, acting input, parameters, forcing."""
    plant = problem.real_plant
    names = "_state_before", "_acting_before", "_exact"
    signals = (like(s, n) for s, n in zip((plant.state, plant.input, plant.parameter), names, strict=True))
    return (*signals, _forcing(plant, "_forcing_before"))


def _sense_block(problem: Problem, state: Signal, response: Response) -> Block:
    """Block -> the true state, and the true response just before this cycle's command; with a reality also its state.

    The response is computed here and not at the end of the last cycle, because it shares its costly terms with the first
    Runge-Kutta evaluation of this cycle.
    """
    if problem.foreign is not None:
        return foreign_block(problem, state, response.signal)
    reality = problem.symbolic_reality
    reads, writes = _real_signals(problem), (state, response.signal)
    state_of = None if reality is None else reality.state_function(problem.plant, seen=False)
    own = () if reality is None else (like(reality.plant.state, REALITY_STATE),)

    def step(s: Signals) -> dict[str, Expression]:
        now = (s._state_before, s._acting_before, s._exact, s._forcing_before)
        measured = response.function(*now)
        if state_of is None:
            return {state.name: s._state_before, response.signal.name: measured}
        return {state.name: state_of(*now), response.signal.name: measured, REALITY_STATE: s._state_before}

    return Block("sense", Layout(reads), Layout((*writes, *own)), step)


def _seen_block(problem: Problem, shown: tuple[Signal, Signal], response: ca.Function) -> Block:
    """Block -> the state and the response that are measured in place of the true ones."""
    assert problem.symbolic_reality is not None
    state = problem.symbolic_reality.state_function(problem.plant, seen=True)

    def step(s: Signals) -> dict[str, Expression]:
        now = (s._state_before, s._acting_before, s._exact, s._forcing_before)
        return {shown[0].name: state(*now), shown[1].name: response(*now)}

    return Block("seen", Layout(_real_signals(problem)), Layout(shown), step)


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
    if problem.symbolic_reality is not None:
        state = like(plant.state, REALITY_STATE)
    reads = (state, arriving, like(plant.parameter, "_exact"), *disturbed)
    writes = (like(plant.state, "_state_after"), like(plant.input, "_acting"), _forcing(plant, "_forcing"))

    def step(s: Signals) -> dict[str, Expression]:
        u, w = getattr(s, arriving.name), expression(ca.DM.zeros(len(plant.names)))
        if disturbed:
            added = dict(zip(problem.disturbances, ca.vertsplit(s.disturbance), strict=True))
            u = u + ca.vertcat(*(added.get(name, 0) for name in plant.inputs))
            w = ca.vertcat(*(added.get(name, 0) for name in plant.names))
        return {"_state_after": advance(getattr(s, state.name), u, s._exact, w), "_acting": u, "_forcing": w}

    return Block("advance", Layout(reads), Layout(writes), step, opaque=problem.real_integrator.opaque)
