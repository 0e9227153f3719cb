"""Deformation under dead time: the response seen now belongs to a request of d + 1 cycles ago.

    unpaired   the map itself: r_k = G(r_{k-1}, f_k, d_k). Stable on f = lambda r only for a lambda < 2 sin(pi / (2 (2 d + 1))).
    Paired     r_k = G(r_{k-1-d}, f_k, d_k): d + 1 interleaved iterations without delay, stable for 0 < a lambda < 2 whatever d is,
               with the rate |1 - a lambda|^(1/(d+1)).
    Increment  r_k = d_k + delta,  delta = G(r_{k-1-d}, f_k, d_{k-1-d}) - d_{k-1-d}: the same iteration on the deformation r - d, so
               that a change of the desired response passes at once. Use it where the state is predicted over the dead time.

d is in cycles and may be a fraction: then the pair is interpolated between two cycles. Until the first response to a request of
this controller arrives, the request is the desired response.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import casadi as ca

from fpirhc.deformation.base import Deformation
from fpirhc.errors import InvalidValue
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar

MOST = 1000  # cycles of dead time: what is remembered is static


@dataclass(frozen=True)
class _Queued(Deformation):
    """The wrapped map with its own past requests and desired responses.

    Parameters:
        map: any deformation that iterates.
        cycles: dead time d between a request and its response, beyond the one cycle that every loop has.

    Raises:
        InvalidValue: a dead time that is negative, not finite, or beyond 1000 cycles.
    """

    map: Deformation
    cycles: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.cycles) and 0 <= self.cycles <= MOST):
            raise InvalidValue(
                f"{type(self).__name__}(cycles={self.cycles!r}): expected a dead time between 0 and {MOST} control cycles"
            )

    @property
    def gain(self) -> float:
        """The map's own gain."""
        return float(getattr(self.map, self.map.gain_name))

    @property
    def _length(self) -> int:
        return math.ceil(self.cycles) + 1

    def memory(self, elements: tuple[str, ...]) -> Layout:
        """The queues, how many pairs they hold, and the map's own memory."""
        past = tuple(f"{e}@{k}" for k in range(1, self._length + 1) for e in elements)
        queues = Signal("queue_requests", past), Signal("queue_desired", past), Signal("queue_now", elements)
        return Layout((*queues, scalar("queue_filled"))) + self.map.memory(elements)

    def shown(self) -> Mapping[str, str]:
        """What the map shows."""
        return self.map.shown()

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return the next request from the pair that caused the response."""
        inner = {name: value for name, value in memory.items() if not name.startswith("queue_")}
        first = memory["queue_filled"] < 0.5
        # The first request of a run is the desired response itself.
        asked = ca.if_else(first, request, memory["queue_now"])
        requests = self._pushed(memory["queue_requests"], request)
        wishes = self._pushed(memory["queue_desired"], asked)
        valid = memory["queue_filled"] >= self._length - 1
        own = self._at(requests, request.numel()), self._at(wishes, request.numel())
        wanted, following = self._request(*own, response, desired, inner)
        kept = {name: ca.if_else(valid, value, inner[name]) for name, value in following.items()}
        filled = ca.fmin(memory["queue_filled"] + 1, self._length)
        queues = {"queue_requests": requests, "queue_desired": wishes, "queue_now": desired, "queue_filled": filled}
        return ca.if_else(valid, wanted, desired), {**queues, **kept}

    @abstractmethod
    def _request(
        self,
        request: Expression,
        asked: Expression,
        response: Expression,
        desired: Expression,
        memory: Mapping[str, Expression],
    ) -> tuple[Expression, dict[str, Expression]]:
        """The next request from the own pair (request, asked), the response and the desired response now."""

    def _pushed(self, queue: Expression, newest: Expression) -> Expression:
        # Not an empty slice: CasADi's [:0] of one entry is that entry.
        kept = newest.numel() * (self._length - 1)
        return ca.vertcat(newest, queue[:kept]) if kept else newest

    def _at(self, queue: Expression, size: int) -> Expression:
        """What was pushed `cycles` ago, interpolated."""
        whole = math.floor(self.cycles)
        share = self.cycles - whole
        newer = queue[size * whole : size * (whole + 1)]
        if share == 0:
            return newer
        return (1 - share) * newer + share * queue[size * (whole + 1) : size * (whole + 2)]

    def effective_gain(self) -> float:
        """The map's own."""
        return self.map.effective_gain()

    def secant_gain(self) -> float:
        """The map's own."""
        return self.map.secant_gain()

    def largest_step(self) -> float:
        """The map's own, from one pair to the next."""
        return self.map.largest_step()

    def with_effective_gain(self, gain: float) -> Self:
        """Return the same form around the map with that gain."""
        return replace(self, map=self.map.with_effective_gain(gain))


@dataclass(frozen=True)
class Paired(_Queued):
    """The map on the pair that caused the response; see the module for parameters and errors."""

    def _request(
        self,
        request: Expression,
        asked: Expression,
        response: Expression,
        desired: Expression,
        memory: Mapping[str, Expression],
    ) -> tuple[Expression, dict[str, Expression]]:
        del asked
        return self.map.step(request, response, desired, memory)


@dataclass(frozen=True)
class Increment(_Queued):
    """The map on the deformation r - d of the pair that caused the response; see the module for parameters and errors."""

    def _request(
        self,
        request: Expression,
        asked: Expression,
        response: Expression,
        desired: Expression,
        memory: Mapping[str, Expression],
    ) -> tuple[Expression, dict[str, Expression]]:
        wanted, following = self.map.step(request, response, asked, memory)
        return desired + (wanted - asked), following
