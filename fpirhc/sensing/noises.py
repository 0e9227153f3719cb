"""What beliefs with noise share: the checks of their names, and the covariance of the first state."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import quantities


def require_named(owner: str, **named: Mapping[str, float]) -> None:
    """Raise InvalidValue for a mapping without entries."""
    for name, values in named.items():
        if not values:
            raise InvalidValue(f"{owner}({name}={{}}): name at least one")


def name_mistakes(
    owner: str,
    plant: Plant,
    shown: tuple[str, ...],
    measured: Mapping[str, float],
    noise: Mapping[str, float],
    start: Mapping[str, float],
) -> Mistakes:
    """Return the mistakes in the names of a belief's noises.

    Args:
        owner: the belief's class.
        plant: the model.
        shown: names of what sensors show.
        measured: quantities with the noise of their sensors.
        noise: coordinates with their noise.
        start: states with the deviation of their first value.
    """
    mistakes, every = Mistakes(owner), quantities(plant)
    mistakes.unknown("measured: quantity", measured, every)
    for name in measured:
        if name in every and name not in shown:
            mistakes.add(f"measured: no sensor shows '{name}'; those of Sensing(measured=...) are {', '.join(shown)}")
    mistakes.unknown("noise: coordinate", noise, plant.coordinates)
    mistakes.unknown("start: state", start, plant.state.elements)
    return mistakes


def first_covariance(plant: Plant, start: Mapping[str, float]) -> np.ndarray:
    """Return the covariance of the first state, shape (nx, nx)."""
    return np.diag([start.get(e, 0.0) ** 2 for e in plant.state.elements])


def covariance_entries(plant: Plant) -> tuple[str, ...]:
    """Names of the entries of a covariance, column by column."""
    return tuple(f"{i},{j}" for j in plant.state.elements for i in plant.state.elements)
