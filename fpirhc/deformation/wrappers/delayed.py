"""Deformation under dead time: the response measured now belongs to the request of d + 1 cycles ago.

Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import casadi as ca

from fpirhc.deformation.base import Deformation, Form, Wrapper, memory_of_map
from fpirhc.deformation.leaky import check_cycles, check_uncertainty, chosen_pole
from fpirhc.errors import InvalidValue
from fpirhc.fields.kinds import BelowOne
from fpirhc.symbolic.layout import Expression, Layout, Signal, discrete
from fpirhc.symbolic.open import stays
from fpirhc.task.dead_time import MOST, Cycles, Queue, every

__all__ = ["MOST", "Increment", "Paired"]


class _Past(NamedTuple):
    """The queues of requests and of desired responses, newest first."""

    requests: Expression
    desired: Expression


@dataclass(frozen=True)
class _Queued(Wrapper):
    """The wrapped map with its own past requests and desired responses.

    Args:
        cycles: dead time d between a request and its response, beyond the one cycle that every loop has; a tuple gives every
            controlled coordinate its own.

    Raises:
        InvalidValue: a dead time that is negative, not finite, or beyond 1000 cycles; an uncertainty beyond the dead time.
    """

    cycles: Cycles = field(metadata={"structure": True})

    @property
    def form(self) -> Form:
        return replace(self.map.form, cycles=self.cycles)

    @property
    @abstractmethod
    def _queue(self) -> Queue:
        """The delays of the pairs."""

    def memory(self, elements: tuple[str, ...]) -> Layout:
        past = tuple(f"{e}@{k}" for k in range(1, self._queue.length + 1) for e in elements)
        queues = Signal("queue_requests", past), Signal("queue_desired", past), Signal("queue_now", elements)
        return Layout((*queues, discrete("queue_filled"))) + self.map.memory(elements)

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        inner, queue = memory_of_map(self, memory, request.numel()), self._queue
        first = memory["queue_filled"] < 0.5
        # The first request of a run is the desired response itself.
        desired_then = ca.if_else(first, request, memory["queue_now"])
        past_requests = queue.pushed(memory["queue_requests"], request)
        past_desired = queue.pushed(memory["queue_desired"], desired_then)
        valid = memory["queue_filled"] >= queue.length - 1
        next_request, next_memory = self._request(_Past(past_requests, past_desired), response, desired, inner)
        remembered = {name: ca.if_else(valid, value, inner[name]) for name, value in next_memory.items()}
        filled = ca.fmin(memory["queue_filled"] + 1, queue.length)
        queues = {
            "queue_requests": past_requests,
            "queue_desired": past_desired,
            "queue_now": desired,
            "queue_filled": filled,
        }
        return ca.if_else(valid, next_request, desired), {**queues, **remembered}

    @abstractmethod
    def _request(
        self, past: _Past, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """The next request, from the queues and from the response and desired response of this cycle."""


@dataclass(frozen=True)
class Paired(_Queued):
    """The map on the pair that caused the response: r_k = G(r_{k-1-d}, f_k, d_k).

    Args:
        map: any deformation that iterates.
        cycles: dead time d, or one for every controlled coordinate.
        uncertainty: half width of the triangular mean over the requests around the pair, whole cycles, at most d.

    Raises:
        InvalidValue: a dead time that is negative, not finite, or beyond 1000 cycles; an uncertainty beyond the dead time.
    """

    uncertainty: int = 0

    def __post_init__(self) -> None:
        check_cycles("Paired", self.cycles)
        check_uncertainty("Paired", self.uncertainty, self.cycles)
        if self.uncertainty > min(every(self.cycles)):
            raise InvalidValue(
                f"Paired(uncertainty={self.uncertainty!r}): the mean would reach beyond the newest request; expected whole cycles "
                f"from 0 to the dead time of {min(every(self.cycles)):g}"
            )

    @property
    def _queue(self) -> Queue:
        return Queue(self.cycles, self.uncertainty)

    def _request(
        self, past: _Past, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        return self.map.step(self._queue.delayed(past.requests, desired.numel()), response, desired, memory)


@dataclass(frozen=True)
class Increment(_Queued):
    """The map on the deformation r - d of the pair that caused the response, with a leak.

    Args:
        map: any deformation that iterates; the effective gain 1 / lambda_max is the usual one.
        cycles: dead time d, or one for every controlled coordinate.
        uncertainty: m, by how many cycles the dead time may be wrong, at most d rounded up; None: max(1, 10 % of d), and 0
            without dead time.
        pole: p of the leak, in [0, 1); None: from the uncertainty, by the theorem.

    Raises:
        InvalidValue: a dead time that is negative, not finite, or beyond 1000 cycles; an uncertainty beyond the dead time; a pole
            outside [0, 1).
    """

    uncertainty: int | None = None
    pole: BelowOne | None = None

    def __post_init__(self) -> None:
        check_cycles("Increment", self.cycles)
        if self.uncertainty is not None:
            check_uncertainty("Increment", self.uncertainty, self.cycles)

    @classmethod
    def within(cls, map: Deformation, most: float) -> Increment:
        """Return the form that is stable for all dead times up to `most` cycles: believed D / 2, wrong by D / 2.

        Args:
            map: any deformation that iterates; the effective gain 1 / lambda_max is the usual one.
            most: D, longest dead time between a request and its response, in cycles, beyond the one that every loop has.

        Raises:
            InvalidValue: a dead time that is negative, not finite, or beyond 1000 cycles.
        """
        check_cycles("Increment.within", most, "most")
        return cls(map, cycles=most / 2, uncertainty=math.ceil(most / 2))

    @property
    def form(self) -> Form:
        return replace(super().form, compares="increment")

    @property
    def _leak(self) -> float:
        """The pole p in use."""
        return chosen_pole(self.map.effective_gain(), self.cycles, self.uncertainty, self.pole)

    @property
    def _queue(self) -> Queue:
        return Queue(self.cycles)

    def _request(
        self, past: _Past, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        size, pole = desired.numel(), self._leak
        undeformed, request = self._queue.delayed(past.desired, size), self._queue.delayed(past.requests, size)
        next_request, next_memory = self.map.step(request, response, undeformed, memory)
        deformation = next_request - undeformed
        if not stays(pole, 0.0):
            deformation = pole * (past.requests[:size] - past.desired[:size]) + (1 - pole) * deformation
        return desired + deformation, next_memory


def examples(inner: Deformation) -> tuple[Deformation, ...]:
    """Values for the laws, around any map."""
    return (Paired(inner, cycles=3), Increment(inner, cycles=2.5))
