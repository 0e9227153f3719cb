"""Signals of the true motion in the model's terms: the states of the model that what moves has, and the outputs.

A reality need not have the states that a belief gives to the controller. They have no true value then, and are in no signal of it.
"""

from __future__ import annotations

from dataclasses import replace

from fpirhc.controllers.face import measured_signals
from fpirhc.symbolic.layout import Signal
from fpirhc.task.problem import Problem


def true_motion(problem: Problem) -> tuple[Signal, ...]:
    """Return the signals of state and outputs, with the states that what moves has; without any, no state."""
    plant, foreign = problem.plant, problem.foreign
    state, *outputs = measured_signals(plant)
    shown = problem.truth.shown(plant)
    if foreign is not None and plant.outputs:
        shown = tuple(e for e in state.elements if e in foreign.measures)
    if shown == state.elements:
        return (state, *outputs)
    units = dict(zip(state.elements, state.entry_units, strict=True))
    return (*([replace(state, elements=shown, units=tuple(units[e] for e in shown))] if shown else []), *outputs)
