"""Refuses, before a run, a form of the deformation that the controller, the plant or a wrapper does not support."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from fpirhc.controllers.mirror_path import NONE
from fpirhc.deformation.base import Deformation
from fpirhc.deformation.model_referenced import form_inside
from fpirhc.errors import NotSupported
from fpirhc.symbolic.live import nominal
from fpirhc.symbolic.queue import every
from fpirhc.task.problem import Problem


class _Controller(Protocol):
    """The members of a controller that the check needs; the contract itself imports this module."""

    @property
    def deformation(self) -> Deformation: ...


def check_outputs(problem: Problem, controller: _Controller) -> None:
    """Raise if the problem's plant has outputs that the deformation does not cover, or of order 0 behind an estimator.

    Raises:
        NotSupported: with the reason.
    """
    _refuse(_of_outputs(problem, controller))


def check_form(problem: Problem, controller: _Controller) -> None:
    """Raise if the controller's deformation has a form that cannot be used.

    Raises:
        NotSupported: the number of dead times or lags differs from the plant's number of channels; a wrapper changes what a
            model-referenced form inside it compares.
    """
    _refuse(_of_form(problem, nominal(controller.deformation)))


def _refuse(reasons: Iterator[str]) -> None:
    for reason in reasons:
        raise NotSupported(reason)


def _of_outputs(problem: Problem, controller: _Controller) -> Iterator[str]:
    """Reasons against outputs; those of order 0 have a response that is measured."""
    plant, mirror = problem.plant, nominal(controller.deformation).mirror
    instant = [name for name, order in plant.response_orders.items() if not order]
    if instant and not problem.sensing.estimator.measures_all:
        yield (
            f"{type(problem.sensing.estimator).__name__} estimates derivatives, and outputs of order 0 ({', '.join(instant)}) "
            "need none; leave the estimator out: Sensing(sensors=...)"
        )
    late = 0.0 if mirror is None else mirror.measurement
    if plant.outputs and (late % 1 > NONE or (plant.step and late)):
        yield (
            f"{type(controller.deformation).__name__} does not cover outputs that are expressions of the state "
            f"({', '.join(plant.chains)}): its twin moves from the state that is given with the samples, and these are late by "
            f"{late:g} cycles; believe in whole cycles, and for a map in none"
        )


def _of_form(problem: Problem, deformation: Deformation) -> Iterator[str]:
    """Reasons against the form, the first one first."""
    plant, channels, mirror = problem.plant, deformation.iteration.channels, deformation.mirror
    if channels not in (None, len(plant.controlled_names)):
        yield (
            f"{type(deformation).__name__}: {channels} dead times are given, but the plant has {len(plant.controlled_names)} "
            f"controlled coordinates ({', '.join(plant.controlled_names)}); give one for each, or one number for all"
        )
    if (outer := form_inside(deformation)) is not None:
        name = type(outer).__name__
        yield (
            f"{name} around a model-referenced form changes what the form compares, the model's response with the measured one; "
            f"put it inside: ModelReferenced({name}(map, ...))"
        )
    if mirror is None:
        return
    for field, values in (("cycles", every(mirror.cycles)), ("lag", every(mirror.lag))):
        if len(values) not in (1, len(plant.inputs)):
            yield (
                f"ModelReferenced({field}={values!r}): the plant has {len(plant.inputs)} inputs ({', '.join(plant.inputs)}); give "
                "one number for each, or one for all"
            )
    parts = any(c % 1 for c in (*every(mirror.cycles), mirror.measurement))
    if plant.step is not None and (any(every(mirror.lag)) or parts):
        yield (
            f"{type(deformation).__name__}: a map has no lag, and no dead time of parts of a cycle; write an actuator as a state "
            "of the map, and dead times in whole cycles"
        )


def check_derivatives(problem: Problem, law: str) -> None:
    """Raise for a map or an output of order 0, where a law has no meaning.

    Args:
        problem: the problem.
        law: what the law does with derivatives, as the beginning of a sentence.

    Raises:
        NotSupported: with the law.
    """
    plant = problem.plant
    instant = [name for name, order in plant.response_orders.items() if not order]
    what = (
        "a map has differences of its steps"
        if plant.step is not None
        else f"{instant[0]} is of order 0"
        if instant
        else ""
    )
    if what:
        raise NotSupported(
            f"{law} a derivative with respect to time, and {what}; use ComputedTorque with a deformation"
        )
