"""A twin of the plant: the estimator's output if the plant were the model.

The twin is the model without the deformation, f^(x, u) - delta, which is the believed response of the plant. It is integrated over
the cycle, and its samples pass the same estimator as the plant's. The estimate of delta is then added again. With an exact model
delta is zero, and both estimates are the same number, equally late, rounded and smoothed.

A twin would drift away from the plant. After each cycle it is therefore moved to where its own estimate of the state is the
controller's. The estimator's memory of the twin is moved along the same path, a polynomial below the plant's order, which does not
change an estimate of the response: the twin's response remains the model's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from fpirhc.controllers.mirror_path import MEASURED, MEASURED_OUTPUT, Path, measured_output
from fpirhc.plant.motion import controlled_places
from fpirhc.sensing.base import response_names, values_of
from fpirhc.symbolic.block import Block, unseen
from fpirhc.symbolic.expression import Signals, expression, is_finite, total
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.task.problem import Problem

BEFORE = "_deformation_before"


def twin_block(path: Path) -> Block:
    """Block (measured state, last command, last deformation, parameters) -> the twin's estimated response and the deformation's."""
    problem, plant = path.problem, path.problem.plant
    start, names = problem.start_state, problem.sensing.estimator.measures(plant)
    estimate = problem.sensing.estimator.block(plant, problem.period, start, Signal("_seen", names))
    own = tuple(Signal(f"mirror_{m.name}", m.elements, m.units, m.start) for m in estimate.memory.signals)
    twin = Signal("mirror_state", plant.state.elements, plant.state.units, tuple(map(float, start)))
    seen, controlled = _seen(problem, names, response_names(plant)), controlled_places(plant)
    resting = np.asarray(seen(start, problem.inputs_before, plant.approximate, 0).full()).ravel()
    late = (Signal("mirror_sample", names, start=tuple(map(float, resting))),) if path.fraction else ()
    advance, moves, past = (
        problem.integrator.step(plant, problem.period),
        _Moves(problem, names, path),
        _Deformations(path),
    )

    def step(s: Signals) -> dict[str, Expression]:
        end, mean, remembered = path.acted(s)
        parameters, signals = path.known.acted(s, path.late)
        acting, answered, next_deformations = past.seen(s)
        waits = s.mirror_cycles < path.late + 0.5  # the samples still show the start
        at = ca.if_else(waits, s.mirror_state, advance(s.mirror_state, mean, parameters, -acting))
        sample = seen(at, end, parameters, -acting[controlled])
        arrived = (1 - path.fraction) * sample + path.fraction * s.mirror_sample if late else sample
        state, response, *memories = estimate.function(arrived, *(getattr(s, m.name) for m in own))
        away = getattr(s, MEASURED) - state
        # What is not finite must not be remembered.
        move = ca.if_else(is_finite(away), away, 0)
        remembered |= {"mirror_state_next": at + moves.state @ move, **next_deformations, **signals}
        if late:
            remembered["mirror_sample_next"] = sample + moves.sample @ move
        for signal, value, matrix in zip(own, memories, moves.memory, strict=True):
            remembered[f"{signal.name}_next"] = value + matrix @ move
        return {"_modelled": response + answered, **remembered}

    writes, memory = (
        Layout((plant.response_signal("_modelled"),)),
        Layout((*path.memory, past.memory, twin, *late, *own)),
    )
    reads = Layout((*path.reads, plant.response_signal(BEFORE)))
    block = Block("mirror", reads, writes, step, memory, opaque=problem.integrator.opaque)
    return replace(block, waits=unseen(block, (MEASURED,)))


class _Deformations:
    """Deformations of earlier cycles: the one that acts, and their share in the estimated response."""

    def __init__(self, path: Path) -> None:
        plant = path.problem.plant
        self._plant, self._names = plant, plant.controlled_names
        self._acting = path.queue
        estimator, period = path.problem.sensing.estimator, path.problem.period
        every_weight = [estimator.weights(plant.orders[k], period) for k in controlled_places(plant)]
        self._weights = [np.convolve(w, [1 - path.fraction, path.fraction]) for w in every_weight]
        self._length = max(max(w.size for w in self._weights) - 1, 1) + self._acting.length - 1

    @property
    def memory(self) -> Signal:
        return Signal("mirror_deformations", tuple(f"{e}@{k}" for k in range(1, self._length + 1) for e in self._names))

    def seen(self, s: Signals) -> tuple[Expression, Expression, dict[str, Expression]]:
        """Return the forcing that stands for the acting deformation, its estimated response, and what is remembered."""
        size = len(self._names)
        column = ca.vertcat(getattr(s, BEFORE), s.mirror_deformations)
        late = [self._acting.delayed(column[size * j :], size) for j in range(max(w.size for w in self._weights))]
        answered = [
            total(v * late[j][k] for j, v in enumerate(weights) if v != 0) for k, weights in enumerate(self._weights)
        ]
        forcing: list[Expression] = [expression(0.0)] * len(self._plant.names)
        for place, value in zip(controlled_places(self._plant), ca.vertsplit(late[0]), strict=True):
            forcing[place] = value
        remembered = {"mirror_deformations_next": column[: size * self._length]}
        return ca.vertcat(*forcing), ca.vertcat(*answered), remembered


def _seen(problem: Problem, names: Sequence[str], shifted: Sequence[str]) -> ca.Function:
    """Function (state, command that acted, parameters, shift) -> what the sensors show without noise, rounded as they round.

    Args:
        problem: with the model and the sensors.
        names: of what they show.
        shifted: names of the quantities to which the entries of the shift are added.
    """
    (x, u, p), shift = problem.plant.symbols(), ca.SX.sym("shift", len(shifted))
    values = values_of(problem.plant, x, u, p)
    values |= {name: values[name] + one for name, one in zip(shifted, ca.vertsplit(shift), strict=True)}
    shown = [problem.sensing.rounded(name, values[name]) for name in names]
    return ca.Function("fpirhc_mirror_seen", [x, u, p, shift], [ca.densify(ca.vertcat(*shown))])


class _Moves:
    """Matrices that turn a move of the estimated state into moves of the twin and of what its estimator remembers."""

    def __init__(self, problem: Problem, names: Sequence[str], path: Path) -> None:
        plant, period = problem.plant, problem.period
        self.state = ca.DM(drift(plant.output, path.fraction * period))
        places = {e: k for k, e in enumerate(plant.state.elements)}
        rows = [np.asarray(self.state)[places[n]] if n in places else np.zeros(plant.state.size) for n in names]
        self.sample = ca.DM(np.array(rows))
        self.memory = memory_moves(problem, names)


def memory_moves(problem: Problem, names: Sequence[str]) -> list[ca.DM]:
    """Return the matrices that turn a move of the estimated state, or outputs, into moves of what the estimator remembers.

    What is remembered at a start is linear in the start; a cycle later the start would have been on the same path.

    Args:
        problem: with the estimator.
        names: of what it measures.
    """
    motion = problem.plant.output
    ahead, size = drift(motion, problem.period), motion.size
    columns = [_remembered(problem, names, unit) for unit in (np.zeros(size), *np.eye(size))]
    return [ca.DM(np.column_stack([c[k] - columns[0][k] for c in columns[1:]]) @ ahead) for k in range(len(columns[0]))]


def _remembered(problem: Problem, names: Sequence[str], start: np.ndarray) -> list[np.ndarray]:
    """What the estimator remembers at a start, signal by signal."""
    block = problem.sensing.estimator.block(problem.plant, problem.period, start, Signal("_seen", tuple(names)))
    return [m.start_vector() for m in block.memory.signals]


def drift(motion: Signal, time: float) -> np.ndarray:
    """Return the matrix by which a motion goes on for that time while all highest derivatives are zero: Taylor's formula."""
    elements = motion.elements
    drift = np.zeros((len(elements), len(elements)))
    for k, element in enumerate(elements):
        for j, other in enumerate(elements):
            power = len(other) - len(element)
            if other.rstrip("'") == element.rstrip("'") and power >= 0:
                drift[k, j] = time**power / math.factorial(power)
    return drift


_STATE, _OFFSET = "mirror_state", "mirror_offset"


def twin_of_outputs(path: Path) -> Block:
    """Block (state, outputs, last command, parameters) -> the model's response behind the estimator.

    The model moves over a cycle from the state that is given, x_{k-1}, to x^ = F(x_{k-1}, u), and shows its outputs there. Outputs
    that the model computes are not the measured ones, so the twin has an offset o, a polynomial in y ... y^(r-1) as the plans have:

        y~_k = y^(x^) + o_k.

    After each cycle the offset is moved to where the estimate of the twin is the controller's, and it takes up the difference
    between x^ and the state that is given next, so that the samples stay on one path.

    Args:
        path: of the commands to the model, without a fraction of a cycle in the measurement.
    """
    problem, plant = path.problem, path.problem.plant
    names = problem.sensing.estimator.measures(plant)
    estimate = problem.sensing.estimator.block(plant, problem.period, problem.start_output, Signal("_seen", names))
    own = tuple(Signal(f"mirror_{m.name}", m.elements, m.units, m.start) for m in estimate.memory.signals)
    moves, ahead = memory_moves(problem, names), ca.DM(drift(plant.output, problem.period))
    advance, chain, shown = (
        problem.integrator.step(plant, problem.period),
        _chain(problem),
        _seen(problem, names, plant.output.elements),
    )
    calm = np.zeros(len(plant.names))

    def step(s: Signals) -> dict[str, Expression]:
        end, mean, remembered = path.acted(s)
        parameters, signals = path.known.acted(s, path.late)
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
    entries = plant.equations.output(x, u, p, np.zeros(len(plant.names)))
    return ca.Function("fpirhc_mirror_chain", [x, u, p], [entries])
