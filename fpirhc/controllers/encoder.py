"""A controller that sees the plant through encoders: quantised positions, and derivatives filtered out of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller, Response, compose_controller, like
from fpirhc.controllers.predicted import embedded
from fpirhc.deformation.base import Deformation
from fpirhc.errors import InvalidValue, NotSupported
from fpirhc.plant import Plant
from fpirhc.problem import Problem
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.layout import Expression, Layout, Signal


@dataclass(frozen=True)
class ByEncoder(Controller):
    """The wrapped controller with positions q_c rounded to whole encoder counts, and velocity and acceleration filtered from them,

        f1' = w (q_c - f1),   f2' = w (f1 - f2),     q' seen as w (f1 - f2),   q'' seen as w^2 (q_c - 2 f1 + f2),

    w the bandwidth (a state-variable filter, discretised by the trapezoidal rule, so that constant velocities and accelerations
    are seen as they are). What it sees comes late by about 2 / w, and q'' jumps by resolution x w^2 at every count: a wide filter
    is noisy, a narrow one late.

    Parameters:
        controller: any controller.
        resolution: one encoder count by coordinate, in its unit.
        bandwidth: of the filter, rad/s.

    Raises:
        InvalidValue: a resolution or bandwidth that is not positive. When the loop is built: NotSupported where some coordinate is
        not of order 2 or not controlled; InvalidValue where a resolution is missing.
    """

    controller: Controller
    resolution: Mapping[str, float]
    bandwidth: float

    def __post_init__(self) -> None:
        for name, value in {"bandwidth": self.bandwidth, **self.resolution}.items():
            if not (math.isfinite(value) and value > 0):
                raise InvalidValue(f"ByEncoder: '{name}' is {value!r}; expected a positive number")

    @property
    def adaptive(self) -> Deformation:
        """The wrapped controller's deformation."""
        return self.controller.adaptive

    def parameters(self, plant: Plant) -> np.ndarray:
        """The wrapped controller's parameters."""
        return self.controller.parameters(plant)

    def resolved(self, problem: Problem) -> ByEncoder:
        """Return the wrapped controller resolved."""
        return replace(self, controller=self.controller.resolved(problem))

    def response(self, problem: Problem) -> Response | None:
        """The wrapped controller's."""
        return self.controller.response(problem)

    def notes(self, problem: Problem) -> tuple[str, ...]:
        """The wrapped controller's."""
        return self.controller.notes(problem)

    def check(self, problem: Problem) -> None:
        """Raise what the wrapped controller raises, and if the plant does not fit.

        Raises:
            NotSupported: a coordinate that is not of order 2, or not controlled. InvalidValue: resolutions of other coordinates.
        """
        plant = problem.plant
        if set(plant.orders) != {2} or plant.controlled_names != plant.names:
            raise NotSupported(
                "ByEncoder sees positions, velocities and accelerations: every coordinate controlled, of order 2"
            )
        odd = sorted(set(self.resolution) ^ set(plant.names))
        if odd:
            raise InvalidValue(
                f"ByEncoder: resolution must name every coordinate and no other; '{odd[0]}' is on one side only"
            )
        self.controller.check(problem)

    def blocks(self, problem: Problem) -> tuple[list[Block], list[Delay]]:
        """Blocks encode, and the wrapped controller as one."""
        inner = compose_controller(problem, self.controller)
        seen = {
            "state": like(problem.plant.state, "state_seen"),
            "realised": problem.plant.response_signal("response_seen"),
        }
        return [self._encode_block(problem, tuple(seen.values())), embedded("controller", inner, seen)], []

    def _encode_block(self, problem: Problem, writes: tuple[Signal, ...]) -> Block:
        plant, pole = problem.plant, self.bandwidth
        at, moving = list(plant.indices(0)), list(plant.indices(1))
        counts = ca.DM([self.resolution[name] for name in plant.names])
        kept, new = (2 / problem.period - pole) / (2 / problem.period + pole), pole / (2 / problem.period + pole)
        place, speed = problem.start_state[at], problem.start_state[moving]
        # As if the plant had moved at its first velocity for long.
        parts = {
            "encoder_first": place - speed * (problem.period + 1 / pole),
            "encoder_second": place - speed * (problem.period + 2 / pole),
            "encoder_first_input": place - speed * problem.period,
            "encoder_second_input": place - speed * (problem.period + 1 / pole),
        }
        memory = Layout(tuple(Signal(n, plant.names, start=tuple(map(float, v))) for n, v in parts.items()))

        def step(s: Any) -> dict[str, Expression]:
            position = counts * ca.floor(s.state[at] / counts + 0.5)
            first = kept * s.encoder_first + new * (position + s.encoder_first_input)
            second = kept * s.encoder_second + new * (first + s.encoder_second_input)
            velocity = pole * (first - second)
            seen = dict(zip([*at, *moving], [*ca.vertsplit(position), *ca.vertsplit(velocity)], strict=True))
            return {
                "state_seen": ca.vertcat(*(seen[k] for k in range(len(seen)))),
                "response_seen": pole**2 * (position - 2 * first + second),
                "encoder_first_next": first,
                "encoder_second_next": second,
                "encoder_first_input_next": position,
                "encoder_second_input_next": first,
            }

        reads = Layout((plant.state,))
        return Block("encode", reads, Layout(writes), step, memory)
