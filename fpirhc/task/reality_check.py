"""Whether a reality can stand for what a model describes: inputs, coordinates and outputs by name, unit and order."""

from __future__ import annotations

from collections.abc import Mapping

from fpirhc.errors import Mistakes
from fpirhc.plant.chain import input_reaches_at
from fpirhc.plant.outputs import output_order
from fpirhc.plant.plant import Plant
from fpirhc.plant.structural_order import structural_order


def quantities_of(plant: Plant) -> dict[str, str]:
    """Return the units of what a reality can show: its coordinates and its outputs."""
    return {**plant.coordinates, **{name: one.unit for name, one in plant.outputs.items()}}


def check_inputs(plant: Plant, model: Plant, mistakes: Mistakes) -> None:
    """Add what is wrong with the reality's inputs, which are the model's."""
    own, expected = ", ".join(plant.inputs), ", ".join(model.inputs)
    if own != expected:
        mistakes.add(
            f"its inputs are {own}, the model's are {expected}; both take the same commands, so name them alike, in order"
        )
    for name, unit in plant.inputs.items():
        other = model.inputs.get(name, unit)
        if unit != other:
            mistakes.add(f"its input '{name}' is in {unit}, the model's in {other}; write both in one unit")


def check_coordinate(plant: Plant, seen: Mapping[str, str], model: Plant, name: str, mistakes: Mistakes) -> None:
    """Add what is wrong with the coordinate of a reality that stands for a coordinate of the model.

    Args:
        plant: the reality's.
        seen: name of the model's coordinate -> name of what is measured in its place.
        model: of the problem.
        name: of the model's coordinate.
        mistakes: to which it is added.
    """
    own, units, unit = seen.get(name, name), quantities_of(plant), model.coordinates[name]
    if own not in units:
        if name not in seen:
            followed = not model.outputs and name in (model.controlled or model.names)
            believed = "" if followed else ", or have it believed: Sensing(measured=..., belief=ModelStates())"
            mistakes.add(
                f"it has no coordinate '{name}', which the model has and the controller is given; add it, or name the one that is "
                f"measured in its place: Reality(seen={{'{name}': ...}}){believed}. Its coordinates: {', '.join(plant.coordinates)}"
            )
        return
    for one in sorted({own, name} & set(units)):
        if units[one] != unit:
            mistakes.add(other_unit(plant, one, name, unit))
    order = model.orders[model.names.index(name)]
    at_once = input_reaches_at(plant, own, order - 1)
    if at_once is not None:
        mistakes.add(
            f"its derivative {own}{chr(39) * at_once} jumps with the command, but it is a state of the model, where '{name}' has "
            f"the order {order}; give the model this order, or the reality a coordinate of its own"
        )
    elif not model.outputs and name in (model.controlled or model.names) and _order(plant, own) is None:
        mistakes.add(f"no input reaches its coordinate '{own}', however often it is differentiated")


def other_unit(plant: Plant, own: str, name: str, unit: str) -> str:
    """Return the sentence about a coordinate in another unit."""
    units = f"in {quantities_of(plant)[own]}, the model's '{name}' in {unit}"
    return f"its coordinate '{own}' is {units}; write both in one unit"


def check_expression(plant: Plant, model: Plant, name: str, mistakes: Mistakes) -> None:
    """Add what is wrong with the output, or coordinate, of a reality of the name of an output of the model."""
    unit = model.outputs[name].unit
    units = quantities_of(plant)
    if name not in units:
        mistakes.add(
            f"it has no output '{name}', which the model has and which is judged; give its plant this output too. Its coordinates "
            f"and outputs: {', '.join(units)}"
        )
        return
    if units[name] != unit:
        mistakes.add(f"its '{name}' is in {units[name]}, the model's in {unit}; write both in one unit")
    if name in model.instant_names:
        return
    order = model.face.orders[model.face.names.index(name)]
    at_once = input_reaches_at(plant, name, order - 1)
    if at_once is not None:
        mistakes.add(
            f"its derivative {name}{chr(39) * at_once} jumps with the command, but '{name}' has the relative order {order} in the "
            "model; give the model this order, or the reality an actuator"
        )


def _order(plant: Plant, name: str) -> int | None:
    """The relative order of a coordinate or an output; None where no input reaches it."""
    return structural_order(plant, name) if name in plant.coordinates else output_order(plant, name)
