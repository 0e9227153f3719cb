"""Limits of other quantities than states: rates of inputs, and paths.

Each limit adds an entry z to the stage's state, z_{i+1} = c(s_i, u_i, theta_i), with bounds. So every optimiser that keeps bounds
of states keeps these limits too, and they are verified and named like states.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from fpirhc.errors import Mistakes
from fpirhc.horizon.cost import View, read_by
from fpirhc.horizon.horizon import Horizon
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.layout import Expression, Named, Signal
from fpirhc.task.limits import Limits, PathConstraint


@dataclass(frozen=True, eq=False)
class ConstraintState:
    """One further entry of the stage's state."""

    name: str
    unit: str
    expression: Expression
    lower: float  # bound; infinite where free
    upper: float  # bound; infinite where free


def limited(limits: Limits, plant: Plant, view: View, step: float) -> list[ConstraintState]:
    """Limited expressions of state and input of stages 0 ... N-1: rates of inputs, and paths."""
    return [_entry_of(name, one, view) for name, one in limits.written(plant, step).items()]


def read_before(limits: Limits, plant: Plant, step: float) -> bool:
    """Return whether a limit reads the input of the stage before."""
    return any("input_before" in _read_by(name, one, plant) for name, one in limits.written(plant, step).items())


def _read_by(name: str, one: PathConstraint, plant: Plant) -> frozenset[str]:
    return read_by(plant, lambda view: [one.named_value(name, view)])


def check_names(horizon: Horizon, limits: Limits) -> None:
    """Raise where a margin is that of no limited state, or leaves nothing between two limits."""
    mistakes = Mistakes("horizon")
    mistakes.unknown("margins: limit of state", horizon.margins, list(limits.states))
    for name in sorted(horizon.margins.keys() & limits.prices.keys()):
        mistakes.add(f"margins of '{name}': its limit has a price, and a margin makes it hard; leave one of them out")
    for name in horizon.margins.keys() & limits.states.keys():
        lower, upper = limits.states[name]
        if 2 * horizon.margins[name] >= upper - lower:
            mistakes.add(
                f"margins of '{name}' is {horizon.margins[name]:.6g}, which leaves nothing between its limits "
                f"{lower:g} and {upper:g}; widen the limits, or adapt faster"
            )
    mistakes.raise_if_any()


def _entry_of(name: str, one: PathConstraint, view: View) -> ConstraintState:
    return ConstraintState(name, one.unit, one.named_value(name, view), one.lower, one.upper)


def inside(limits: Limits, plant: Plant, view: View, seen: Named, step: int) -> list[ConstraintState]:
    """Hard limits of states and paths after so many steps inside a stage of a map; no other limits hold between the nodes."""
    measured_view = replace(view, state=seen)
    states = [_entry_of(name, one, measured_view) for name, one in limits.boxes(plant).items()]
    paths = [
        _entry_of(name, one, view)
        for name, one in limits.paths.items()
        if "input_before" not in _read_by(name, one, plant)
    ]
    return [replace(w, name=f"{w.name}, step {step}") for w in (*states, *paths) if w.name not in limits.prices]


def measured(names: Collection[str], limits: Limits, plant: Plant, next_state: Expression) -> list[ConstraintState]:
    """Limits of states that hold for the measured state, as entries; `next_state` is as it will be measured."""
    places, boxes = {e: k for k, e in enumerate(plant.state.elements)}, limits.boxes(plant)
    entries = [(_as_measured(e), boxes[e], next_state[places[e]]) for e in names]
    return [ConstraintState(name, one.unit, value, one.lower, one.upper) for name, one, value in entries]


def state_prices(limits: Limits, state: Signal, plant: Plant, step: float) -> np.ndarray:
    """Price of a violation of every entry's limits at one node (ns,), in cost per unit; infinite where limits are hard."""
    prices = {f"{name} rate" if name in plant.inputs else name: step * price for name, price in limits.prices.items()}
    prices |= {_as_measured(entry): price for entry, price in prices.items()}
    return np.array([prices.get(e, math.inf) for e in state.elements])


def _as_measured(name: str) -> str:
    return f"{name} as measured"
