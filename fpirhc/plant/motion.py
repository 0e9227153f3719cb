"""What is said of a plant: names, units, places in its vectors, and the same plant with other parameters or outputs."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from copy import copy
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from fpirhc.plant.parameter import with_exact_values
from fpirhc.symbolic.layout import Expression, Named, Signal, vector

if TYPE_CHECKING:
    from fpirhc.plant.plant import Plant


SECONDS = {"s": 1.0, "us": 1e-6, "ms": 1e-3, "min": 60.0, "h": 3600.0, "day": 86400.0}
"""Seconds in a unit of time, for what is compared with a real clock."""


def derivative_unit(unit: str, derivative: int, time: str = "s") -> str:
    """Return the unit of a time derivative, with the unit of time: 'm' -> 'm/s' -> 'm/s^2'."""
    if derivative == 0:
        return unit
    if found := re.fullmatch(rf"(.+)/{re.escape(time)}(?:\^(\d+))?", unit):
        unit, derivative = found[1], derivative + int(found[2] or 1)
    return f"{unit}/{time}" if derivative == 1 else f"{unit}/{time}^{derivative}"


def unit_of(plant: Plant, quantity: str) -> str:
    """Return the unit of a coordinate, an output, or a derivative of one: q1''."""
    units, primes = {**plant.coordinates, **plant.followed}, quantity.count("'")
    return derivative_unit(units[quantity.rstrip("'")], primes, plant.time_unit)


def with_space(unit: str) -> str:
    """Return a unit as it stands behind a number: ' kg', and nothing for '1'."""
    return "" if unit == "1" else f" {unit}"


def derivatives_signal(name: str, units: Mapping[str, str], orders: Mapping[str, int], time_unit: str) -> Signal:
    """Return the signal of some quantities and their derivatives below each order, derivative-major."""
    entries = [(n, k) for k in range(max(orders.values(), default=0)) for n, order in orders.items() if order > k]
    own = [derivative_unit(units[n], k, time_unit) for n, k in entries]
    return vector(name, [n + "'" * k for n, k in entries], own)


def words(plant: Plant) -> tuple[str, str]:
    """What a coordinate and the response are called: "state" and "rates", or "next", where the plant is given by its states."""
    if plant.step is not None:
        return "state", "next"
    return ("state", "rates") if plant.outputs and set(plant.orders) == {1} else ("coordinate", "response")


def sampling(plant: Plant) -> float:
    """Return the time from one state of a map to the next that a controller sees, its cycle; NaN for differential equations."""
    return math.nan if plant.step is None else plant.step * plant.steps


def with_exact_parameters(plant: Plant, exact: np.ndarray) -> Plant:
    """Return the same with other exact parameters, shape (np,); both share the Functions derived from the symbols."""
    parameters, other = with_exact_values(plant.parameters, exact), copy(plant)
    # No other cached property depends on the exact values.
    other.__dict__.pop("exact", None)
    object.__setattr__(other, "parameters", parameters)
    return other


def controlled_places(plant: Plant) -> list[int]:
    """Return the places of the controlled quantities among all outputs, or without any among all coordinates."""
    return [list(plant.followed).index(c) for c in plant.controlled_names]


def places(plant: Plant, derivative: int) -> list[int]:
    """Return the places in the state vector of one derivative, for every coordinate whose order is higher."""
    elements = [c + "'" * derivative for c, r in zip(plant.names, plant.orders, strict=True) if r > derivative]
    return [plant.state.elements.index(e) for e in elements]


def arguments_of(plant: Plant, x: Expression, u: Expression, p: Expression) -> tuple[Named, ...]:
    """Return the arguments of the response by name: q, q', ..., u, p."""
    *derivatives, parameters = by_name(plant, x, p)
    return (*derivatives, Named(plant.input.elements, u, "input"), parameters)


def believed_in(plant: Plant, name: str, p: Expression) -> Expression:
    """Return what a model believes to add to a coordinate's response, an output, or an output's response: zero, or a parameter."""
    return p[plant.parameter.elements.index(plant.believed[name])] if name in plant.believed else ca.SX(0)


def by_name(plant: Plant, x: Expression, p: Expression) -> tuple[Named, ...]:
    """Return the arguments of a user's function without the inputs, each with its entries by name: q, q', ..., p."""
    derivatives = [
        Named(
            [c for c, r in zip(plant.names, plant.orders, strict=True) if r > k], x[places(plant, k)], words(plant)[0]
        )
        for k in range(max(plant.orders, default=0))
    ]
    own = [n for n in plant.parameters if n not in plant.believed.values()]
    column = p[[plant.parameter.elements.index(n) for n in own]] if plant.believed else p
    return (*derivatives, Named(own, column, "parameter"))
