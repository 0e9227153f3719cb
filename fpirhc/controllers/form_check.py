"""Refuses a form of the deformation that the controller, the plant or a wrapper cannot serve, before anything runs."""

from __future__ import annotations

from typing import Protocol

from fpirhc.deformation.base import Deformation, Mirror
from fpirhc.deformation.model_referenced import form_inside
from fpirhc.deformation.queue import every
from fpirhc.errors import NotSupported
from fpirhc.task.problem import Problem


class _Serves(Protocol):
    @property
    def deformation(self) -> Deformation: ...

    def unusable(self, problem: Problem, mirror: Mirror) -> str: ...


def check_form(problem: Problem, controller: _Serves) -> None:
    """Raise if the controller's deformation has a form that cannot be used.

    Raises:
        NotSupported: dead times or lags of another number of channels than the plant has; a wrapper around a model-referenced form
            that changes what the form compares; a controller that cannot give it the model's response.
    """
    deformation, plant = controller.deformation, problem.plant
    channels, controlled = deformation.channels, len(plant.controlled_names)
    if channels is not None and channels != controlled:
        raise NotSupported(
            f"{type(deformation).__name__}: {channels} dead times are given, but the plant has {controlled} controlled coordinates "
            f"({', '.join(plant.controlled_names)}); give one for each, or one number for all"
        )
    outer, mirror = form_inside(deformation), deformation.mirror
    if outer is not None:
        name = type(outer).__name__
        raise NotSupported(
            f"{name} around a model-referenced form changes what the form compares, the model's response with the measured one; "
            f"put it inside: ModelReferenced({name}(map, ...))"
        )
    if mirror is None:
        return
    for name, values in (("cycles", every(mirror.cycles)), ("lag", every(mirror.lag))):
        if len(values) not in (1, len(plant.inputs)):
            raise NotSupported(
                f"ModelReferenced({name}={values!r}): the plant has {len(plant.inputs)} inputs ({', '.join(plant.inputs)}); give "
                "one number for each, or one for all"
            )
    why = controller.unusable(problem, mirror)
    if why:
        raise NotSupported(f"{type(controller).__name__} cannot use a model-referenced deformation here: {why}")
