"""Deformation under dead time: the response measured now belongs to the request of d + 1 cycles ago.

    delta_k = p delta_{k-1} + (1 - p) G(delta_{k-1-d})        where the dead time may be wrong by some cycles

Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca

from fpirhc.deformation.base import Deformation, Form, Wrapper, chosen_pole, leaked, memory_of_map
from fpirhc.fields.kinds import BelowOne
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.dead_time import Cycles, Queue, check_cycles


@dataclass(frozen=True)
class _Queued(Wrapper):
    """The wrapped map with its own past requests and desired responses."""

    cycles: Cycles

    def __post_init__(self) -> None:
        check_cycles(type(self).__name__, self.cycles)

    @property
    def form(self) -> Form:
        return replace(self.map.form, cycles=self.cycles)

    @property
    def _queue(self) -> Queue:
        """The delays of the pairs."""
        return Queue(self.cycles)

    @property
    def _pole(self) -> float:
        """The pole of the leak of an increment."""
        return 0.0

    def memory(self, elements: tuple[str, ...]) -> Layout:
        past = tuple(f"{e}@{k}" for k in range(1, self._queue.length + 1) for e in elements)
        queues = Signal("queue_requests", past), Signal("queue_desired", past), Signal("queue_now", elements)
        return Layout((*queues, scalar("queue_filled"))) + self.map.memory(elements)

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        inner, queue = memory_of_map(self, memory, request.numel()), self._queue
        # The first request of a run is the desired response itself.
        desired_then = ca.if_else(memory["queue_filled"] < 0.5, request, memory["queue_now"])
        requests = queue.pushed(memory["queue_requests"], request)
        undeformed = queue.pushed(memory["queue_desired"], desired_then)
        valid, size = memory["queue_filled"] >= queue.length - 1, desired.numel()
        request, then = (queue.delayed(past, size) for past in (requests, undeformed))
        increments = self.form.compares == "increment"
        next_request, next_memory = self.map.step(request, response, then if increments else desired, inner)
        if increments:
            before = requests[:size] - undeformed[:size]
            next_request = desired + leaked(self._pole, before, next_request - then)
        remembered = {name: ca.if_else(valid, value, inner[name]) for name, value in next_memory.items()}
        queues = {
            "queue_requests": requests,
            "queue_desired": undeformed,
            "queue_now": desired,
            "queue_filled": ca.fmin(memory["queue_filled"] + 1, queue.length),
        }
        return ca.if_else(valid, next_request, desired), {**queues, **remembered}


@dataclass(frozen=True)
class Paired(_Queued):
    """The map on the pair that caused the response: r_k = G(r_{k-1-d}, f_k, d_k).

    Args:
        map: any deformation that iterates.
        cycles: dead time d beyond the one cycle that every loop has, or a tuple with one for every controlled coordinate.

    Raises:
        InvalidValue: a dead time that is negative, not finite, or beyond 1000 cycles.
    """


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
        check_cycles("Increment", self.cycles, uncertainty=self.uncertainty)

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
    def _pole(self) -> float:
        return chosen_pole(self.map.effective_gain(), self.cycles, self.uncertainty, self.pole)


def examples(inner: Deformation) -> tuple[Deformation, ...]:
    """Values for the laws, around any map."""
    return (Paired(inner, cycles=3), Increment(inner, cycles=2.5))
