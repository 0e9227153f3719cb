"""The model-referenced form: the iteration runs on the difference between the measured response and the model's.

Theory: docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import casadi as ca

from fpirhc.deformation.base import Deformation, Form, Wrapper, chosen_pole, leaked, memory_of_map
from fpirhc.errors import require
from fpirhc.fields.kinds import BelowOne, NotNegative
from fpirhc.symbolic.expression import is_finite
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.task.dead_time import Cycles, Queue, check_cycles


@dataclass(frozen=True)
class ModelReferenced(Wrapper):
    """The map on the difference between the plant's response and the model's.

    Args:
        map: any deformation that iterates; wrappers that change the gain or the error go inside: ModelReferenced(Filtered(map)).
        cycles: believed dead time d of the inputs, in whole control cycles beyond the one that every loop has; a tuple gives every
            input its own, and then input k belongs to controlled coordinate k. None: that of the problem, to the nearest cycle.
        measurement: that of the measurement, in whole cycles. None: that of the problem, or 0 where `cycles` is given.
        lag: believed time constant of the actuators, tau u_act' = u - u_act, s; a tuple gives one per input. Too long a lag is
            nearly harmless, too short a lag is not, and no lag is worst. None: what an external plant states, else 0.
        uncertainty: by how many cycles the sum of the dead times may be wrong; None: the default of `Increment`.
        pole: of the leak, in [0, 1); None: from the uncertainty, as in `Increment`.

    Raises:
        InvalidValue: a dead time, lag, uncertainty or pole out of range, or parts of a cycle.
    """

    cycles: Cycles | None = field(default=None, metadata={"of_problem": "cycles"})  # if this field is open
    measurement: float | None = field(default=None, metadata={"of_problem": "cycles"})
    lag: NotNegative | tuple[NotNegative, ...] | None = field(default=None, metadata={"of_problem": "lag"})
    uncertainty: int | None = None
    pole: BelowOne | None = None

    def __post_init__(self) -> None:
        for name, value in zip(("cycles", "measurement"), self._late, strict=True):
            check_cycles("ModelReferenced", value, name, of_model=True)
        # without cycles it is checked with the problem's dead times
        check_cycles("ModelReferenced", self._delays, uncertainty=None if self.cycles is None else self.uncertainty)

    @property
    def form(self) -> Form:
        cycles, late = self._late
        return replace(self.map.form, compares="model", cycles=cycles, measurement=late, lag=self.lag or 0.0)

    def memory(self, elements: tuple[str, ...]) -> Layout:
        past = tuple(f"{e}@{k}" for k in range(1, self._queue.length + 1) for e in elements)
        return Layout((Signal("own_deformation", past),)) + self.map.memory(elements)

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        size, queue, past = request.numel(), self._queue, memory["own_deformation"]
        before = past[:size]
        pole = chosen_pole(self.map.effective_gain(), self._delays, self.uncertainty, self.pole)
        undeformed = request - queue.delayed(past, size)
        next_request, next_memory = self.map.step(request, response, undeformed, memory_of_map(self, memory, size))
        deformation = leaked(pole, before, next_request - undeformed)
        remembered = ca.if_else(is_finite(deformation), deformation, before)  # what is no number is not remembered
        return desired + deformation, {"own_deformation": queue.pushed(past, remembered), **next_memory}

    @property
    def _delays(self) -> Cycles:
        cycles, late = self._late
        return tuple(c + late for c in cycles) if isinstance(cycles, tuple) else cycles + late

    @property
    def _late(self) -> tuple[Cycles, float]:
        return 0.0 if self.cycles is None else self.cycles, self.measurement or 0.0

    @property
    def _queue(self) -> Queue:
        return Queue(self._delays)


def require_map_of_plan(owner: str, deformation: Deformation) -> None:
    """Check that a map may be given its own last request, as a plan has nothing else."""
    require(
        not deformation.form.modelled,
        f"{owner}(map={type(deformation).__name__}(...)): a model-referenced form compares a plant with its model, and a plan's "
        "gradient has no model beside it; use the map inside",
    )


def settled(deformation: Deformation, request: Expression, response: Expression) -> dict[str, Expression]:
    """Return what a map remembers where `request` causes the desired `response`, by name; other signals keep their start.

    At a fixed point every deformation of a model-referenced form is request minus response.
    """
    size = request.numel()
    memory = deformation.memory(tuple(f"q{k}" for k in range(size)))
    if "own_deformation" not in memory:
        return {}
    return {"own_deformation": ca.repmat(request - response, memory["own_deformation"].size // size, 1)}


def examples(inner: Deformation) -> tuple[Deformation, ...]:
    """Values for the laws, around any map."""
    return (ModelReferenced(inner), ModelReferenced(inner, cycles=2))
