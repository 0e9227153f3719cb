"""Watches an iteration that may leave its basin of attraction, and brings it back. Theory: docs/theory-maps.md."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import casadi as ca

from fpirhc.deformation.base import Deformation, Wrapper, forget, memory_of_map, smooth_norm, start_of_map
from fpirhc.fields.kinds import Positive
from fpirhc.symbolic.expression import is_finite
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.symbolic.live import nominal

EVENTS = {1: "oscillation at the step limit", 2: "growing oscillation", 3: "request too far from the desired response"}
EVENTS |= {4: "not finite", 5: "fallback: no adaptation any more", 6: "recovered: full gain again"}
_ALTERNATING, _PATIENCE = -0.8, 20
_FAST, _SLOW, _GROWTH = 1 / 20, 1 / 200, 4.0
_AT_LIMIT = 0.5  # share of the map's largest step that counts as saturated
_PAUSE, _CLEAN, _EVERY, _REGROW = 10, 1000, 8, 1.05
_TRIPS, _MEMORY = 2.5, 1 - 1 / 1000


@dataclass(frozen=True)
class Guarded(Wrapper):
    """The wrapped map, reset where its iteration leaves the basin of attraction.

    Args:
        map: any deformation that iterates.
        largest_deformation: |r - d| beyond which the iteration has left its basin, in units of the response.
    """

    passes_pair: ClassVar[bool] = True

    largest_deformation: Positive

    def memory(self, elements: tuple[str, ...]) -> Layout:
        numbers = ("sign", "oscillating", "growing", "fast", "slow", "pause", "trips", "clean", "event", "fallback")
        own = (scalar("guard_factor", start=1.0), *(scalar(f"guard_{n}") for n in numbers))
        return Layout((*own, Signal("guard_error", elements))) + self.map.memory(elements)

    def shown(self) -> Mapping[str, str]:
        return {"adaptation_event": "guard_event", "adaptation_factor": "guard_factor", **self.map.shown()}

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        own = {name.removeprefix("guard_"): v for name, v in memory.items() if name.startswith("guard_")}
        inner = memory_of_map(self, memory, request.numel())
        next_request, next_memory = self.map.step(request, response, desired, inner)
        # A model-referenced form begins at the desired response, not at the request that it is given.
        origin = self.map.mirror.origin(request, desired)
        candidate = origin + own["factor"] * (next_request - origin)
        active = ca.logic_not(ca.logic_or(own["pause"] > 0.5, own["fallback"] > 0.5))
        watched = self._watched(request, response, desired, candidate, own)
        trip = ca.logic_and(active, watched["event"] > 0.5)
        trips = _MEMORY * own["trips"] + trip
        fallback = ca.logic_or(own["fallback"] > 0.5, trips > _TRIPS)
        guard = self._next_guard(own, watched, trip, active, trips, fallback)
        running = ca.logic_and(active, ca.logic_not(trip))
        start = start_of_map(self, request.numel())
        remembered = {name: ca.if_else(running, value, start[name]) for name, value in next_memory.items()}
        return ca.if_else(running, candidate, desired), {**guard, **remembered}

    def _watched(
        self,
        request: Expression,
        response: Expression,
        desired: Expression,
        candidate: Expression,
        own: Mapping[str, Expression],
    ) -> dict[str, Expression]:
        """The error of this cycle, its means, the counts, and the number of the event (0: none)."""
        finite = ca.logic_and(is_finite(candidate), is_finite(response))
        error = ca.if_else(finite, response - desired, 0)
        size = smooth_norm(error, 1e-12)
        sign = forget(own["sign"], ca.sign(ca.dot(error, own["error"])))
        limit = own["factor"] * self.map.largest_step()
        at_limit = (
            smooth_norm(self.map.mirror.step(request, candidate), 1e-12) >= _AT_LIMIT * limit
            if math.isfinite(nominal(self.map.largest_step()))
            else 0
        )
        fast = own["fast"] + _FAST * (size - own["fast"])
        slow = own["slow"] + _SLOW * (size - own["slow"])
        oscillating = ca.if_else(ca.logic_and(sign < _ALTERNATING, at_limit), own["oscillating"] + 1, 0)
        grown = ca.logic_and(fast > _GROWTH * slow, fast > 1e-3 * self.largest_deformation)
        growing = ca.if_else(ca.logic_and(sign < _ALTERNATING, grown), own["growing"] + 1, 0)
        far = smooth_norm(candidate - desired, 1e-12) > self.largest_deformation
        event = ca.if_else(oscillating > _PATIENCE, 1, 0)
        event = ca.if_else(growing > _PATIENCE, 2, event)
        event = ca.if_else(far, 3, event)
        event = ca.if_else(finite, event, 4)
        means = {"error": error, "sign": sign, "fast": fast, "slow": slow}
        return {**means, "oscillating": oscillating, "growing": growing, "event": event}

    def _next_guard(
        self,
        own: Mapping[str, Expression],
        watched: Mapping[str, Expression],
        trip: Expression,
        active: Expression,
        trips: Expression,
        fallback: Expression,
    ) -> dict[str, Expression]:
        """The memory of the guard one cycle later: a trip clears the counts and halves the factor."""
        clean = ca.if_else(trip, 0, own["clean"] + 1)
        due = ca.logic_and(clean > _CLEAN, ca.fmod(clean, _EVERY) < 0.5)
        grown = ca.if_else(ca.logic_and(due, own["factor"] < 1), ca.fmin(1, _REGROW * own["factor"]), own["factor"])
        factor = ca.if_else(trip, 0.5 * own["factor"], grown)
        recovered = ca.logic_and(own["factor"] < 1, factor >= 1)
        first_fallback = ca.logic_and(fallback, own["fallback"] < 0.5)
        event = ca.if_else(first_fallback, 5, ca.if_else(trip, watched["event"], ca.if_else(recovered, 6, 0)))
        watching = ca.logic_and(active, ca.logic_not(trip))
        counted = {
            k: ca.if_else(watching, watched[k], 0) for k in ("sign", "oscillating", "growing", "error", "fast", "slow")
        }
        pause = ca.if_else(trip, _PAUSE, ca.fmax(own["pause"] - 1, 0))
        whole = {"factor": factor, "pause": pause, "trips": trips, "clean": clean, "event": event, "fallback": fallback}
        return {f"guard_{name}": value for name, value in {**counted, **whole}.items()}


def examples(inner: Deformation) -> tuple[Deformation, ...]:
    """Values for the laws, around any map."""
    return (Guarded(inner, largest_deformation=1e12),)
