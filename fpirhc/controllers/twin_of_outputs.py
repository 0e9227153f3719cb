"""A twin of a plant with outputs: the estimator's outputs if the plant were the model, from the state that the controller has.

The model moves over a cycle from the state that is given, x_{k-1}, to x^ = F(x_{k-1}, u), and shows its outputs there. Outputs that
the model computes are not the measured ones, so the twin has an offset o, a polynomial in y ... y^(r-1) as the plans have one,

    y~_k = y^(x^) + o_k.

After each cycle the offset is moved to where the estimate of the twin is the controller's, and it takes up the difference between
x^ and the state that is given next, so that the samples stay on one path. A polynomial below the order r changes no estimate of
y^(r): the twin's response remains the model's. What the estimator remembers is moved along the same path.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from fpirhc.controllers.mirror_path import MEASURED, MEASURED_OUTPUT, Path, measured_output
from fpirhc.controllers.twin import drift, memory_moves
from fpirhc.sensing.base import values_of
from fpirhc.symbolic.block import Block, unseen
from fpirhc.symbolic.expression import Signals, is_finite
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.task.problem import Problem

_STATE, _OFFSET = "mirror_state", "mirror_offset"


def twin_of_outputs(path: Path) -> Block:
    """Block (state, outputs, last command, parameters) -> the model's response behind the estimator.

    Args:
        path: of the commands to the model, without a fraction of a cycle in the measurement.
    """
    problem, plant = path.problem, path.problem.plant
    names = problem.sensing.estimator.measures(plant.face)
    estimate = problem.sensing.estimator.block(plant.face, problem.period, problem.start_output, Signal("_seen", names))
    own = tuple(Signal(f"mirror_{m.name}", m.elements, m.units, m.start) for m in estimate.memory.signals)
    moves, ahead = memory_moves(problem, names), ca.DM(drift(plant.face, problem.period))
    advance, chain, shown = problem.integrator.step(plant, problem.period), _chain(problem), _shown(problem, names)
    calm = np.zeros(len(plant.names))

    def step(s: Signals) -> dict[str, Expression]:
        end, mean, remembered = path.acted(s)
        parameters, signals = path.told.acted(s, path.late)
        waits = s.mirror_cycles < path.late + 0.5  # the samples still show the start
        at = ca.if_else(waits, s.mirror_state, advance(s.mirror_state, mean, parameters, calm))
        offset = ca.if_else(waits, s.mirror_offset, ahead @ s.mirror_offset)
        sample = shown(at, end, parameters, offset)
        motion, response, *memories = estimate.function(sample, *(getattr(s, m.name) for m in own))
        away = getattr(s, MEASURED_OUTPUT) - motion
        move = ca.if_else(is_finite(away), away, 0)  # what is not finite must not be remembered
        measured = getattr(s, MEASURED)
        measured = ca.if_else(is_finite(measured), measured, at)
        turn = chain(at, end, parameters) - chain(measured, end, parameters)
        remembered |= {f"{_STATE}_next": measured, f"{_OFFSET}_next": offset + move + turn, **signals}
        for signal, value, matrix in zip(own, memories, moves, strict=True):
            remembered[f"{signal.name}_next"] = value + matrix @ move
        return {"_modelled": response, **remembered}

    memory = Layout((*path.memory, *_starts(problem), *own))
    reads, writes = Layout((*path.reads, measured_output(plant))), Layout((plant.response_signal("_modelled"),))
    block = Block("mirror", reads, writes, step, memory, opaque=problem.integrator.opaque)
    return replace(block, waits=unseen(block, (MEASURED, MEASURED_OUTPUT)))


def _starts(problem: Problem) -> tuple[Signal, Signal]:
    """The state that was given last, and the offset of the model's outputs from the real ones."""
    plant, start = problem.plant, problem.start_state
    own = np.asarray(_chain(problem)(start, problem.inputs_before, plant.approximate).full()).ravel()
    offset = tuple(map(float, problem.start_output - own))
    return (
        Signal(_STATE, plant.state.elements, plant.state.units, tuple(map(float, start))),
        Signal(_OFFSET, plant.output.elements, plant.output.units, offset),
    )


def _chain(problem: Problem) -> ca.Function:
    """Function (state, command, parameters) -> the model's outputs and their derivatives below the relative order."""
    plant = problem.plant
    x, u, p = plant.symbols()
    entries = plant.output_function(x, u, p, np.zeros(len(plant.names)))
    return ca.Function("fpirhc_mirror_chain", [x, u, p], [entries])


def _shown(problem: Problem, names: tuple[str, ...]) -> ca.Function:
    """Function (state, command that acted, parameters, offset) -> what the sensors show without noise, rounded as they round."""
    plant = problem.plant
    x, u, p = plant.symbols()
    offset = ca.SX.sym("offset", plant.output.size)
    values = values_of(plant, x, u, p)
    outputs = plant.output_function(x, u, p, np.zeros(len(plant.names))) + offset
    values |= dict(zip(plant.output.elements, ca.vertsplit(outputs), strict=True))
    entries = []
    for name in names:
        sensor = problem.sensing.sensors.get(name)
        quantum = sensor.quantum if sensor is not None else None
        entries.append(values[name] if quantum is None else quantum * ca.floor(values[name] / quantum + 0.5))
    return ca.Function("fpirhc_mirror_seen", [x, u, p, offset], [ca.densify(ca.vertcat(*entries))])
