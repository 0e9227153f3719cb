"""Deformation under dead time: the response seen now belongs to a request of d + 1 cycles ago.

    unpaired   the map itself: r_k = G(r_{k-1}, f_k, d_k). Stable on f = lambda r only for a lambda < 2 sin(pi / (2 (2 d + 1))).
    Paired     r_k = G(r_{k-1-d}, f_k, d_k): d + 1 interleaved iterations without delay, stable for 0 < a lambda < 2 whatever d is,
               with the rate |1 - a lambda|^(1/(d+1)).
    Increment  r_k = d_k + delta_k,  delta_k = p delta_{k-1} + (1 - p) [G(r_{k-1-d}, f_k, d_{k-1-d}) - d_{k-1-d}]: the same
               iteration on the deformation r - d, so that a change of the desired response passes at once, and leaky. Use it where
               the state is predicted over the dead time.

d is in cycles and may be a fraction: then the pair is interpolated between two cycles. It may be a tuple, one dead time for every
controlled coordinate. Until the first response to a request of this controller arrives, the request is the desired response.

A dead time that is wrong by even one cycle makes the interleaved iterations answer each other: high modes grow at any gain, and
the command chatters. Two remedies:

    Increment  leaks. With a dead time wrong by at most m cycles it is stable for every d if 4 p / (1 - p)^2 > g (2 + g) m^2, g the
               effective gain times the plant's largest gain, below 2 (proof: `leaky`). The default is m = max(1, 10 % of d) and
               the p of g = 1, or of the map's own effective gain where that is larger; so give the map the gain 1 / lambda_max.
    Paired     with an `uncertainty` of m takes a triangular mean of the requests around the pair. Its modes decay for
               a lambda <= 0.5 only. It has no leak, because one in the request would make the desired response late.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from fpirhc.deformation.base import Deformation, Pairing
from fpirhc.deformation.leaky import check_pole, chosen_pole
from fpirhc.deformation.queue import MOST, Cycles, Queue, check_cycles, check_uncertainty, every
from fpirhc.deformation.wrappers.base import Wrapper, of_map
from fpirhc.errors import InvalidValue
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar

__all__ = ["MOST", "Increment", "Paired"]


@dataclass(frozen=True)
class _Queued(Wrapper):
    """The wrapped map with its own past requests and desired responses.

    Parameters:
        map: any deformation that iterates.
        cycles: dead time d between a request and its response, beyond the one cycle that every loop has; a tuple gives every
            controlled coordinate its own.

    Raises:
        InvalidValue: a dead time that is negative, not finite, or beyond 1000 cycles; an uncertainty beyond the dead time.
    """

    cycles: Cycles

    @property
    def constant(self) -> bool:
        """What it remembers are pairs; gain and pairing stay."""
        return self.map.constant

    @property
    def pairing(self) -> Pairing:
        """The dead time that it is given."""
        return Pairing(max(every(self.cycles)))

    @property
    def channels(self) -> int | None:
        """One for each dead time, where there are several."""
        return len(self.cycles) if isinstance(self.cycles, tuple) else self.map.channels

    @property
    @abstractmethod
    def _queue(self) -> Queue:
        """What is remembered, and for how long."""

    def memory(self, elements: tuple[str, ...]) -> Layout:
        """The queues, how many pairs they hold, and the map's own memory."""
        past = tuple(f"{e}@{k}" for k in range(1, self._queue.length + 1) for e in elements)
        queues = Signal("queue_requests", past), Signal("queue_desired", past), Signal("queue_now", elements)
        return Layout((*queues, scalar("queue_filled"))) + self.map.memory(elements)

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return the next request from the pair that caused the response."""
        inner, queue = of_map(self, memory, request.numel()), self._queue
        first = memory["queue_filled"] < 0.5
        # The first request of a run is the desired response itself.
        asked = ca.if_else(first, request, memory["queue_now"])
        requests = queue.pushed(memory["queue_requests"], request)
        wishes = queue.pushed(memory["queue_desired"], asked)
        valid = memory["queue_filled"] >= queue.length - 1
        wanted, following = self._request(requests, wishes, response, desired, inner)
        remembered = {name: ca.if_else(valid, value, inner[name]) for name, value in following.items()}
        filled = ca.fmin(memory["queue_filled"] + 1, queue.length)
        queues = {"queue_requests": requests, "queue_desired": wishes, "queue_now": desired, "queue_filled": filled}
        return ca.if_else(valid, wanted, desired), {**queues, **remembered}

    @abstractmethod
    def _request(
        self,
        requests: Expression,
        wishes: Expression,
        response: Expression,
        desired: Expression,
        memory: Mapping[str, Expression],
    ) -> tuple[Expression, dict[str, Expression]]:
        """The next request from the queues of requests and desired responses, the response and the desired response now."""


@dataclass(frozen=True)
class Paired(_Queued):
    """The map on the pair that caused the response; see the module for errors.

    Parameters:
        map: any deformation that iterates.
        cycles: dead time d, or one for every controlled coordinate.
        uncertainty: half width of the triangular mean over the requests around the pair, whole cycles, at most d.
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
    def pairing(self) -> Pairing:
        """The dead time that it is given, and the width of the mean."""
        return Pairing(max(every(self.cycles)), self.uncertainty)

    @property
    def _queue(self) -> Queue:
        return Queue(self.cycles, self.uncertainty)

    def _request(
        self,
        requests: Expression,
        wishes: Expression,
        response: Expression,
        desired: Expression,
        memory: Mapping[str, Expression],
    ) -> tuple[Expression, dict[str, Expression]]:
        del wishes
        return self.map.step(self._queue.delayed(requests, desired.numel()), response, desired, memory)


@dataclass(frozen=True)
class Increment(_Queued):
    """The map on the deformation r - d of the pair that caused the response, leaky; see the module for errors.

    Parameters:
        map: any deformation that iterates; the effective gain 1 / lambda_max is the usual one.
        cycles: dead time d, or one for every controlled coordinate.
        uncertainty: m, by how many cycles the dead time may be wrong, at most d rounded up; None: max(1, 10 % of d), and 0
            without dead time.
        pole: p of the leak, in [0, 1); None: from the uncertainty, by the theorem.
    """

    uncertainty: int | None = None
    pole: float | None = None

    def __post_init__(self) -> None:
        check_cycles("Increment", self.cycles)
        if self.uncertainty is not None:
            check_uncertainty("Increment", self.uncertainty, self.cycles)
        if self.pole is not None:
            check_pole("Increment", self.pole)

    @property
    def slows_desired(self) -> bool:
        """No: the desired response is added after the map."""
        return False

    @property
    def leak(self) -> float:
        """The pole p in use."""
        return chosen_pole(self.map.effective_gain(), self.cycles, self.uncertainty, self.pole)

    @property
    def _queue(self) -> Queue:
        return Queue(self.cycles)

    def _request(
        self,
        requests: Expression,
        wishes: Expression,
        response: Expression,
        desired: Expression,
        memory: Mapping[str, Expression],
    ) -> tuple[Expression, dict[str, Expression]]:
        size, pole = desired.numel(), self.leak
        asked, request = self._queue.delayed(wishes, size), self._queue.delayed(requests, size)
        wanted, following = self.map.step(request, response, asked, memory)
        deformation = wanted - asked
        if pole:
            deformation = pole * (requests[:size] - wishes[:size]) + (1 - pole) * deformation
        return desired + deformation, following


def examples(inner: Deformation) -> tuple[Deformation, ...]:
    """Values for the laws, around any map."""
    return (Paired(inner, cycles=3), Increment(inner, cycles=2.5))
