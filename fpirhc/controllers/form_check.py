"""Refuses, before a run, a form of the deformation that the controller, the plant or a wrapper does not support."""

from __future__ import annotations

from typing import Protocol

from fpirhc.controllers.mirror_path import NONE
from fpirhc.deformation.base import Deformation
from fpirhc.deformation.model_referenced import form_inside
from fpirhc.deformation.queue import every
from fpirhc.errors import NotSupported
from fpirhc.task.problem import Problem

MAPS, ORDER_ZERO = "maps", "outputs of order 0"  # of `Controller.covers`


class _Controller(Protocol):
    """The members of a controller that the check needs; the contract itself imports this module."""

    @property
    def deformation(self) -> Deformation: ...

    @property
    def covers(self) -> frozenset[str]: ...

    @property
    def planner(self) -> object: ...


def check_outputs(problem: Problem, controller: _Controller) -> None:
    """Raise if the problem's plant has outputs that the deformation does not cover, or outputs of order 0.

    Raises:
        NotSupported: with the reason.
    """
    _check_order_zero(problem, controller)
    plant, mirror = problem.plant, controller.deformation.mirror
    late = 0.0 if mirror is None else mirror.measurement
    if plant.outputs and (late % 1 > NONE or (plant.step and late)):
        raise NotSupported(
            f"{type(controller.deformation).__name__} does not cover outputs that are expressions of the state "
            f"({', '.join(plant.outputs)}): its twin moves from the state that is given with the samples, and these are late by "
            f"{late:g} cycles; believe in whole cycles, and for a map in none"
        )


def check_maps(problem: Problem, controller: _Controller) -> None:
    """Raise if the problem's plant is a map and the controller does not cover maps.

    Raises:
        NotSupported: with the reason.
    """
    if problem.plant.step is not None and MAPS not in controller.covers:
        raise NotSupported(
            f"{type(controller).__name__} does not cover maps: it is written for derivatives with respect to time; use "
            "ComputedTorque, RecedingHorizon or FeedforwardOnly"
        )


def check_form(problem: Problem, controller: _Controller) -> None:
    """Raise if the controller's deformation has a form that cannot be used.

    Raises:
        NotSupported: the number of dead times or lags differs from the plant's number of channels; a wrapper changes what a
            model-referenced form inside it compares.
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
    if plant.step is not None and (
        any(every(mirror.lag)) or any(c % 1 for c in every(mirror.cycles)) or mirror.measurement % 1
    ):
        raise NotSupported(
            f"{type(deformation).__name__}: a map has no lag, and no dead time of parts of a cycle; write an actuator as a state "
            "of the map, and dead times in whole cycles"
        )


def _check_order_zero(problem: Problem, controller: _Controller) -> None:
    """Raise for outputs of order 0 that the controller does not cover."""
    plant, name = problem.plant, type(controller).__name__
    controlled = [n for n in plant.controlled_names if n in plant.instant_names]
    if controlled and ORDER_ZERO not in controller.covers:
        raise NotSupported(
            f"{name} does not cover outputs of order 0 ({', '.join(controlled)}): the command moves them at once, so there "
            "is no derivative to prescribe; use FeedforwardOnly(), and Cascade(FeedforwardOnly(), map) to iterate on its target"
        )
    if plant.instant_names and controller.planner is not None:
        raise NotSupported(
            f"{name} plans with outputs that are functions of the state, and {', '.join(plant.instant_names)} depends on the "
            "command too (order 0); leave it out of the outputs of the plant"
        )
    if controlled and not problem.sensing.estimator.measures_all:
        raise NotSupported(
            f"{type(problem.sensing.estimator).__name__} estimates derivatives, and outputs of order 0 ({', '.join(controlled)}) "
            "need none; leave the estimator out: Sensing(sensors=...)"
        )
