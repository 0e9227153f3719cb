"""Closes the loop: controller blocks and the exact plant as ONE step.

Per cycle k the loop holds the plant's state x_k and the response that was realised just before t_k under the command
held since t_{k-1}; the controller turns them into a command; the plant moves on by one period with that command held.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

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
    realised = plant.response_signal("_realised_before")
    resting = plant.controlled_response_function(start, np.zeros(plant.input.size), exact).full().ravel()
    return [
        Delay(Signal("_state_before", plant.state.elements, plant.state.units, start), "_state_after"),
        Delay(Signal(realised.name, realised.elements, realised.units, tuple(map(float, resting))), "_realised_after"),
        Delay(Signal("parameters", plant.parameter.elements, plant.parameter.units, approximate), "parameters"),
        Delay(Signal("_exact", plant.parameter.elements, plant.parameter.units, exact), "_exact"),
    ]


def _clock_block(period: float) -> Block:
    """Time from a counter: no rounding error grows in a long run."""

    def step(s: Any) -> dict[str, Expression]:
        return {"time": s.cycle * period, "cycle_next": s.cycle + 1}

    return Block("clock", Layout(), Layout((scalar("time", "s"),)), step, Layout((scalar("cycle"),)))


def _sense_block(plant: Plant) -> Block:
    """What the controller measures: the true state and the true response just before this cycle's command."""
    before = like(plant.state, "_state_before"), plant.response_signal("_realised_before")
    after = plant.state, plant.response_signal("realised")

    def step(s: Any) -> dict[str, Expression]:
        return {"state": s._state_before, "realised": s._realised_before}

    return Block("sense", Layout(before), Layout(after), step)


def _advance_block(problem: Problem, disturbed: tuple[Signal, ...]) -> Block:
    """The exact plant over one period with the command held, and the response at its end."""
    plant = problem.plant
    advance = problem.integrator.step(plant, problem.period)
    response = plant.controlled_response_function
    reads = (plant.state, plant.input, like(plant.parameter, "_exact"), *disturbed)
    writes = (like(plant.state, "_state_after"), plant.response_signal("_realised_after"))

    def step(s: Any) -> dict[str, Expression]:
        u, w = s.command, ca.DM.zeros(len(plant.names))
        if disturbed:
            acting = dict(zip(problem.disturbances, ca.vertsplit(s.disturbance), strict=True))
            u = u + ca.vertcat(*(acting.get(name, 0) for name in plant.inputs))
            w = ca.vertcat(*(acting.get(name, 0) for name in plant.names))
        following = advance(s.state, u, s._exact, w)
        realised = response(following, u, s._exact) + w[list(plant.controlled_indices)]
        return {"_state_after": following, "_realised_after": realised}

    return Block("advance", Layout(reads), Layout(writes), step, opaque=problem.integrator.opaque)
