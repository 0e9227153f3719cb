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
from fpirhc.symbolic.block import Block, Composite, Delay, compose
from fpirhc.symbolic.expression import Signals, expression
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.symbolic.live import PREFIX, nominal
from fpirhc.task.dead_time import delay_block
from fpirhc.task.problem import Problem


def close_loop(problem: Problem, controller: Controller, live: LiveSettings | None = None) -> Composite:
    """Return the closed loop as one step: (memory, [disturbance], [sensing]) -> (memory, trace).

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
    delays = [*_plant_delays(problem, ready), *constants]
    return compose("loop", Layout((*disturbed, *problem.sensing.drawn)), around, delays)


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
    plant = problem.plant
    start = tuple(float(v) for v in problem.start_state)
    approximate = tuple(float(v) for v in controller.parameters(plant))
    exact = tuple(float(v) for v in plant.exact)
    acting = tuple(map(float, problem.inputs_before))
    return [
        Delay(Signal("_state_before", plant.state.elements, plant.state.units, start), "_state_after"),
        Delay(Signal("_acting_before", plant.input.elements, plant.input.units, acting), "_acting"),
        Delay(_forcing(plant, "_forcing_before"), "_forcing"),
        Delay(Signal("parameters", plant.parameter.elements, plant.parameter.units, approximate), "parameters"),
        Delay(Signal("_exact", plant.parameter.elements, plant.parameter.units, exact), "_exact"),
    ]


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
    plant, behind = problem.plant, problem.dead_time.measurement / problem.period
    response = other or _own_response(plant)
    if problem.sees_plant:
        sense = [_sense_block(plant, plant.state, response)]
        return [*sense, _truth_block(problem, plant.state)] if predicts or problem.dead_time.inputs else sense
    true_state, true_response = like(plant.state, "plant_state"), like(response.signal, "plant_realised")
    true = [
        _sense_block(plant, true_state, Response(true_response, response.function)),
        _truth_block(problem, true_state),
    ]
    if not problem.sensing.ideal:
        signals = true_state, true_response
        first, before = problem.start_state, problem.inputs_before
        return [*true, *problem.sensing.blocks(plant, problem.period, first, behind, signals, before)]
    start, calm = tuple(float(v) for v in problem.start_state), np.zeros(len(plant.names))
    resting = response.function(start, problem.inputs_before, plant.exact, calm).full().ravel()
    delayed = Signal("realised", true_response.elements, true_response.units, tuple(map(float, resting)))
    return [
        *true,
        delay_block("see_state", true_state, replace(plant.state, start=start), [behind] * plant.state.size),
        delay_block("see_response", true_response, delayed, [behind] * delayed.size),
    ]


def _truth_block(problem: Problem, state: Signal) -> Block:
    """Block (time, true state) -> true error of the judged coordinates."""
    plant, function = problem.plant, problem.reference.function(problem.plant)
    places = [plant.state.elements.index(c) for c in problem.judged_names]
    writes = Layout((error_signal(problem, "true_error"),))

    def step(s: Signals) -> dict[str, Expression]:
        return {"true_error": (function(s.time)[0] - getattr(s, state.name))[places]}

    return Block("truth", Layout((plant.time, state)), writes, step, opaque=problem.reference.opaque)


def _own_response(plant: Plant) -> Response:
    """The response of the controlled coordinates."""
    x, u, p = plant.symbols()
    w = ca.SX.sym("w", len(plant.names))
    response = plant.controlled_response_function(x, u, p) + w[list(plant.controlled_indices)]
    return Response(plant.response_signal("realised"), ca.Function("fpirhc_realised", [x, u, p, w], [response]))


def _sense_block(plant: Plant, state: Signal, response: Response) -> Block:
    """Block -> the true state, and the true response just before this cycle's command.

    The response is computed here and not at the end of the last cycle, because it shares its costly terms with the first
    Runge-Kutta evaluation of this cycle.
    """
    reads = (
        like(plant.state, "_state_before"),
        like(plant.input, "_acting_before"),
        _forcing(plant, "_forcing_before"),
        like(plant.parameter, "_exact"),
    )

    def step(s: Signals) -> dict[str, Expression]:
        measured = response.function(s._state_before, s._acting_before, s._exact, s._forcing_before)
        return {state.name: s._state_before, response.signal.name: measured}

    return Block("sense", Layout(reads), Layout((state, response.signal)), step)


def _actuate(problem: Problem, disturbed: tuple[Signal, ...]) -> list[Block]:
    """Blocks of the command's way to the plant, and of the plant over one period."""
    cycles = [problem.dead_time.inputs.get(name, 0.0) / problem.period for name in problem.plant.inputs]
    if not any(cycles):
        return [_advance_block(problem, disturbed, problem.plant.input)]
    plant = problem.plant
    arriving = Signal("arriving", plant.input.elements, plant.input.units, tuple(map(float, problem.inputs_before)))
    return [
        delay_block("send_command", problem.plant.input, arriving, cycles),
        _advance_block(problem, disturbed, arriving),
    ]


def _advance_block(problem: Problem, disturbed: tuple[Signal, ...], arriving: Signal) -> Block:
    """Block of the exact plant over one period with the arriving command held."""
    plant = problem.plant
    advance = problem.integrator.step(plant, problem.period)
    state = plant.state if problem.sees_plant else like(plant.state, "plant_state")
    reads = (state, arriving, like(plant.parameter, "_exact"), *disturbed)
    writes = (like(plant.state, "_state_after"), like(plant.input, "_acting"), _forcing(plant, "_forcing"))

    def step(s: Signals) -> dict[str, Expression]:
        u, w = getattr(s, arriving.name), expression(ca.DM.zeros(len(plant.names)))
        if disturbed:
            added = dict(zip(problem.disturbances, ca.vertsplit(s.disturbance), strict=True))
            u = u + ca.vertcat(*(added.get(name, 0) for name in plant.inputs))
            w = ca.vertcat(*(added.get(name, 0) for name in plant.names))
        return {"_state_after": advance(getattr(s, state.name), u, s._exact, w), "_acting": u, "_forcing": w}

    return Block("advance", Layout(reads), Layout(writes), step, opaque=problem.integrator.opaque)
