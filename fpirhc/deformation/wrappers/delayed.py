"""Deformation under dead time: the response seen now belongs to a request of d + 1 cycles ago.

    unpaired   the map itself: r_k = G(r_{k-1}, f_k, d_k). Stable on f = lambda r only for a lambda < 2 sin(pi / (2 (2 d + 1))).
    Paired     r_k = G(r_{k-1-d}, f_k, d_k): d + 1 interleaved iterations without delay, stable for 0 < a lambda < 2 whatever d is,
               with the rate |1 - a lambda|^(1/(d+1)).
    Increment  r_k = d_k + delta,  delta = G(r_{k-1-d}, f_k, d_{k-1-d}) - d_{k-1-d}: the same iteration on the deformation r - d, so
               that a change of the desired response passes at once. Use it where the state is predicted over the dead time.

d is in cycles and may be a fraction: then the pair is interpolated between two cycles. Until the first response to a request of
this controller arrives, the request is the desired response.

A dead time that is wrong by even one cycle makes the interleaved iterations answer each other: high modes grow at any gain, and
the command chatters. With an `uncertainty` of m cycles the remembered request (its deformation, in the increment form) is a mean
over the 2 m + 1 requests around the pair with triangular weights W. The modes then obey 1 = W(z) z^-(d+1) - a lambda z^-(d'+1) and
decay at a lambda <= 0.5 while the true dead time d' is within m cycles of d; a constant deformation is still found exactly.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from fpirhc.deformation.base import Deformation, Pairing
from fpirhc.deformation.wrappers.base import Wrapper, of_map
from fpirhc.errors import InvalidValue
from fpirhc.symbolic.expression import total
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar

MOST = 1000  # cycles of dead time: what is remembered is static


@dataclass(frozen=True)
class _Queued(Wrapper):
    """The wrapped map with its own past requests and desired responses.

    Parameters:
        map: any deformation that iterates.
        cycles: dead time d between a request and its response, beyond the one cycle that every loop has.
        uncertainty: by how many cycles the dead time may be wrong; at most d.

    Raises:
        InvalidValue: a dead time that is negative, not finite, or beyond 1000 cycles; an uncertainty beyond the dead time.
    """

    cycles: float
    uncertainty: int = 0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.cycles) and 0 <= self.cycles <= MOST):
            raise InvalidValue(
                f"{type(self).__name__}(cycles={self.cycles!r}): expected a dead time between 0 and {MOST} control cycles"
            )
        if not 0 <= self.uncertainty <= self.cycles:
            raise InvalidValue(
                f"{type(self).__name__}(uncertainty={self.uncertainty!r}): expected whole cycles from 0 to the dead time of "
                f"{self.cycles:g}"
            )

    @property
    def constant(self) -> bool:
        """What it remembers are pairs; gain and pairing stay."""
        return self.map.constant

    @property
    def pairing(self) -> Pairing:
        """The dead time that it is given."""
        return Pairing(self.cycles, self.uncertainty)

    @property
    def _length(self) -> int:
        return max(self._shares(self.uncertainty)) + 1

    def _shares(self, width: int) -> dict[int, float]:
        """Weights of what was pushed k cycles ago: a triangle over `width` cycles on both sides of `cycles`, interpolated."""
        shares: dict[int, float] = {}
        for j in range(-width, width + 1):
            height = (1 - abs(j) / (width + 1)) / (width + 1)
            whole = math.floor(self.cycles) + j
            part = self.cycles - math.floor(self.cycles)
            for place, share in ((whole, height * (1 - part)), (whole + 1, height * part)):
                if share > 0:
                    shares[place] = shares.get(place, 0.0) + share
        return shares

    def memory(self, elements: tuple[str, ...]) -> Layout:
        """The queues, how many pairs they hold, and the map's own memory."""
        past = tuple(f"{e}@{k}" for k in range(1, self._length + 1) for e in elements)
        queues = Signal("queue_requests", past), Signal("queue_desired", past), Signal("queue_now", elements)
        return Layout((*queues, scalar("queue_filled"))) + self.map.memory(elements)

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return the next request from the pair that caused the response."""
        inner = of_map(self, memory, request.numel())
        first = memory["queue_filled"] < 0.5
        # The first request of a run is the desired response itself.
        asked = ca.if_else(first, request, memory["queue_now"])
        requests = self._pushed(memory["queue_requests"], request)
        wishes = self._pushed(memory["queue_desired"], asked)
        valid = memory["queue_filled"] >= self._length - 1
        wanted, following = self._request(requests, wishes, response, desired, inner)
        kept = {name: ca.if_else(valid, value, inner[name]) for name, value in following.items()}
        filled = ca.fmin(memory["queue_filled"] + 1, self._length)
        queues = {"queue_requests": requests, "queue_desired": wishes, "queue_now": desired, "queue_filled": filled}
        return ca.if_else(valid, wanted, desired), {**queues, **kept}

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

    def _pushed(self, queue: Expression, newest: Expression) -> Expression:
        # Not an empty slice: CasADi's [:0] of one entry is that entry.
        kept = newest.numel() * (self._length - 1)
        return ca.vertcat(newest, queue[:kept]) if kept else newest

    def _mean(self, queue: Expression, size: int, width: int) -> Expression:
        """What was pushed `cycles` ago, a weighted mean over its neighbours within `width`."""
        return total(share * queue[size * k : size * (k + 1)] for k, share in self._shares(width).items())


@dataclass(frozen=True)
class Paired(_Queued):
    """The map on the pair that caused the response; see the module for parameters and errors."""

    def _request(
        self,
        requests: Expression,
        wishes: Expression,
        response: Expression,
        desired: Expression,
        memory: Mapping[str, Expression],
    ) -> tuple[Expression, dict[str, Expression]]:
        del wishes
        return self.map.step(self._mean(requests, desired.numel(), self.uncertainty), response, desired, memory)


@dataclass(frozen=True)
class Increment(_Queued):
    """The map on the deformation r - d of the pair that caused the response; see the module for parameters and errors."""

    @property
    def slows_desired(self) -> bool:
        """No: the desired response is added after the map."""
        return False

    def _request(
        self,
        requests: Expression,
        wishes: Expression,
        response: Expression,
        desired: Expression,
        memory: Mapping[str, Expression],
    ) -> tuple[Expression, dict[str, Expression]]:
        asked = self._mean(wishes, desired.numel(), 0)
        deformed = self._mean(requests - wishes, desired.numel(), self.uncertainty)
        wanted, following = self.map.step(asked + deformed, response, asked, memory)
        return desired + (wanted - asked), following


def examples(inner: Deformation) -> tuple[Deformation, ...]:
    """Values for the laws, around any map."""
    return (Paired(inner, cycles=3), Increment(inner, cycles=2.5))
