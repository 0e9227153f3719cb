"""Closes the loop: controller blocks and the exact plant as ONE step.

Per cycle k the loop holds the plant's state x_k and the response that was realised just before t_k under the command
held since t_{k-1}; the controller turns them into a command; the plant moves on by one period with that command held.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from fpirhc.controllers.base import Controller, like, prepared
from fpirhc.plant import Plant
from fpirhc.problem import Problem
from fpirhc.symbolic.block import Block, Composite, Delay, compose
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar


def close_loop(problem: Problem, controller: Controller) -> Composite:
    """Return the closed loop as one step: (memory, [disturbance]) -> (memory, trace).

    Both parameter sets are part of the memory (constant), so that other values need no new Function. The disturbance
    input exists only when the problem has disturbances.
    """
    plant = problem.plant
    chosen = prepared(problem, controller)
    blocks, delays = chosen.blocks(problem)
    disturbed = disturbance_signals(problem)
    around = [_clock_block(problem.period), _sense_block(plant), *blocks, _advance_block(problem, disturbed)]
    return compose("loop", Layout(disturbed), around, [*_plant_delays(problem, chosen), *delays])


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
    return [
        Delay(Signal("_state_before", plant.state.elements, plant.state.units, start), "_state_after"),
        Delay(like(plant.input, "_acting_before"), "_acting"),
        Delay(_forcing(plant, "_forcing_before"), "_forcing"),
        Delay(Signal("parameters", plant.parameter.elements, plant.parameter.units, approximate), "parameters"),
        Delay(Signal("_exact", plant.parameter.elements, plant.parameter.units, exact), "_exact"),
    ]


def _forcing(plant: Plant, name: str) -> Signal:
    """What disturbances add to the response of every coordinate."""
    return Signal(name, plant.names, plant.response_units)


def _clock_block(period: float) -> Block:
    """Time from a counter: no rounding error grows in a long run."""

    def step(s: Any) -> dict[str, Expression]:
        return {"time": s.cycle * period, "cycle_next": s.cycle + 1}

    return Block("clock", Layout(), Layout((scalar("time", "s"),)), step, Layout((scalar("cycle"),)))


def _sense_block(plant: Plant) -> Block:
    """What the controller measures: the true state, and the true response just before this cycle's command.

    The response is computed here and not at the end of the last cycle, because it shares its costly terms with the first
    Runge-Kutta evaluation of this cycle.
    """
    response = plant.controlled_response_function
    reads = (
        like(plant.state, "_state_before"),
        like(plant.input, "_acting_before"),
        _forcing(plant, "_forcing_before"),
        like(plant.parameter, "_exact"),
    )

    def step(s: Any) -> dict[str, Expression]:
        forcing = s._forcing_before[list(plant.controlled_indices)]
        return {"state": s._state_before, "realised": response(s._state_before, s._acting_before, s._exact) + forcing}

    return Block("sense", Layout(reads), Layout((plant.state, plant.response_signal("realised"))), step)


def _advance_block(problem: Problem, disturbed: tuple[Signal, ...]) -> Block:
    """The exact plant over one period with the command held."""
    plant = problem.plant
    advance = problem.integrator.step(plant, problem.period)
    reads = (plant.state, plant.input, like(plant.parameter, "_exact"), *disturbed)
    writes = (like(plant.state, "_state_after"), like(plant.input, "_acting"), _forcing(plant, "_forcing"))

    def step(s: Any) -> dict[str, Expression]:
        u, w = s.command, ca.DM.zeros(len(plant.names))
        if disturbed:
            added = dict(zip(problem.disturbances, ca.vertsplit(s.disturbance), strict=True))
            u = u + ca.vertcat(*(added.get(name, 0) for name in plant.inputs))
            w = ca.vertcat(*(added.get(name, 0) for name in plant.names))
        return {"_state_after": advance(s.state, u, s._exact, w), "_acting": u, "_forcing": w}

    return Block("advance", Layout(reads), Layout(writes), step, opaque=problem.integrator.opaque)
