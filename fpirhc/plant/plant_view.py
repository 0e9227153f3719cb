"""A plant on one line, and as a table for a notebook: its quantities with units, orders and both sets of parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fpirhc.summary import number, table

if TYPE_CHECKING:
    from fpirhc.plant.plant import Plant


def plant_facts(plant: Plant) -> tuple[str, ...]:
    """Return what sums up a plant: its coordinates or outputs with their orders, its inputs, the number of its parameters."""
    if plant.outputs:
        face = zip(plant.face.names, _orders(plant), strict=True)
        shown = ", ".join(f"{name} of relative order {order}" for name, order in face)
        states = f"{plant.state.size} states"
        return f"outputs {shown}", states, f"inputs {', '.join(plant.inputs)}", f"{len(plant.parameters)} parameters"
    orders = ", ".join(f"{name} of order {order}" for name, order in zip(plant.names, plant.orders, strict=True))
    return orders, f"inputs {', '.join(plant.inputs)}", f"{len(plant.parameters)} parameters"


def plant_table(plant: Plant) -> str:
    """Return HTML: coordinates, inputs and parameters, one per row."""
    rows = [
        (name, f"coordinate, order {order}", unit, "", "")
        for (name, unit), order in zip(plant.coordinates.items(), plant.orders, strict=True)
    ]
    face = zip(plant.face.coordinates.items(), _orders(plant), strict=True) if plant.outputs else ()
    rows += [(name, f"output, relative order {order}", unit, "", "") for (name, unit), order in face]
    rows += [(name, "input", unit, "", "") for name, unit in plant.inputs.items()]
    rows += [
        (
            name,
            "signal from outside" if one.outside else "parameter",
            one.unit,
            number(one.approximate),
            number(one.exact),
        )
        for name, one in plant.parameters.items()
    ]
    notes = [f"Unit of time: {plant.time_unit}."]
    if plant.controlled is not None:
        notes.append(f"Controlled: {', '.join(plant.controlled)}.")
    return table("Plant", ("name", "is", "unit", "model", "plant"), rows, notes)


def _orders(plant: Plant) -> list[int]:
    """Relative orders of the outputs."""
    face = zip(plant.face.names, plant.face.orders, strict=True)
    return [0 if name in plant.instant_names else order for name, order in face]
