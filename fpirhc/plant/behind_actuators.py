"""A plant behind actuators that lag: tau u_act' = u - u_act, the positions of the actuators further coordinates of order one."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi as ca

from fpirhc.errors import NotSupported
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.layout import Expression, Named


def behind_actuators(plant: Plant, lags: Sequence[float]) -> Plant:
    """Return the plant whose inputs act through lags.

    Args:
        plant: given by differential equations, without algebraic states.
        lags: time constant of every input's actuator, in the plant's unit of time; 0: the input acts at once.

    Raises:
        NotSupported: a map, or a plant with algebraic states.
    """
    if plant.step is not None or plant.algebraic is not None:
        raise NotSupported("a lag before the inputs of a map, or of a plant with algebraic states, is not covered")
    taus = {name: tau for name, tau in zip(plant.inputs, lags, strict=True) if tau > 0}
    acting = {name: _free(f"{name}_acting", plant) for name in taus}

    def response(*arguments: Named) -> Mapping[str, Expression]:
        *derivatives, u, p = arguments
        arrived = ca.vertcat(*(derivatives[0][acting[name]] if name in acting else u[name] for name in plant.inputs))
        rates = {acting[name]: (u[name] - derivatives[0][acting[name]]) / tau for name, tau in taus.items()}
        return {**plant.response(*derivatives, Named(tuple(plant.inputs), arrived, "input"), p), **rates}

    vars(response)["__signature__"] = inspect.signature(plant.response)
    order = dict(zip(plant.names, plant.orders, strict=True)) | dict.fromkeys(acting.values(), 1)
    positions = {acting[name]: plant.inputs[name] for name in taus}
    # An input reaches the controlled quantities one derivative later, so they are those of the model and not its own.
    return replace(
        plant,
        coordinates={**plant.coordinates, **positions},
        response=response,
        order=order,
        controlled=None,
        inverse=None,
    )


def _free(name: str, plant: Plant) -> str:
    """The name, lengthened until nothing of the plant has it."""
    taken = {*plant.coordinates, *plant.inputs, *plant.parameters, *plant.outputs}
    while name in taken:
        name += "_"
    return name
