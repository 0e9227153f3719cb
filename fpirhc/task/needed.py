"""What a problem needs of the plant that moves: the model's quantities that are measured, controlled or judged.

What is believed, nobody measures; a reality need not have it.
"""

from __future__ import annotations

from collections.abc import Sequence

from fpirhc.plant.plant import Plant
from fpirhc.sensing.sensing import Sensing


def needed_measurements(plant: Plant, sensing: Sensing) -> tuple[str, ...]:
    """Return the names of what is measured: by sensors, and the state that is given beside outputs where nothing is believed."""
    states = plant.state.elements if plant.outputs and sensing.belief is None else ()
    return tuple(dict.fromkeys((*states, *sensing.measures(plant))))


def needed_names(plant: Plant, sensing: Sensing, judged: Sequence[str] | None) -> frozenset[str]:
    """Return the names of the model's coordinates and outputs that the plant that moves must have.

    Args:
        plant: the model.
        sensing: of the problem.
        judged: names whose errors are judged beside the controlled ones; None: no other need be there.
    """
    if sensing.belief is None:
        return frozenset((*plant.coordinates, *plant.face.coordinates))
    measured = (name.rstrip("'") for name in needed_measurements(plant, sensing))
    return frozenset((*measured, *(judged or ()), *(plant.outputs or plant.controlled_names)))
