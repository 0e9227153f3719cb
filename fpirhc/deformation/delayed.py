"""Deformation under dead time: the response measured now belongs to the request of d + 1 cycles ago; and how much leak it needs.

    delta_k = p delta_{k-1} + (1 - p) G(delta_{k-1-d})        where the dead time may be wrong by some cycles

Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca

from fpirhc.deformation.base import Deformation, Form, Wrapper, memory_of_map
from fpirhc.errors import InvalidValue
from fpirhc.fields.kinds import BelowOne, finite_number
from fpirhc.symbolic.expression import stays
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.dead_time import MOST, WHOLE, Cycles, Queue, every

_BEYOND = 1.01, 1e-3  # factor and amount by which the default pole exceeds the bound: at the bound nothing is damped


def chosen_pole(gain: float, cycles: Cycles, uncertainty: int | None, pole: float | None) -> float:
    """Return the pole of a leaky pairing: `pole` itself, or for None the one that follows from the gain and the uncertainty."""
    if pole is not None:
        return pole
    error = default_uncertainty(max(every(cycles))) if uncertainty is None else uncertainty
    return default_pole(ca.fmax(abs(gain), 1.0), error)


def leaked(pole: float, before: Expression, deformation: Expression) -> Expression:
    """Return p delta_{k-1} + (1 - p) delta; delta itself without a leak."""
    return deformation if stays(pole, 0.0) else pole * before + (1 - pole) * deformation


def default_uncertainty(cycles: float) -> float:
    """A tenth of the dead time, at least one cycle; 0 without dead time."""
    return max(math.ceil(0.1 * cycles - 1e-9), 1) if cycles > 0 else 0


def default_pole(product: float, uncertainty: float) -> float:
    """The pole of the theorem and a little more, below one; 0 where the dead time is certain."""
    least = _least_pole(product, uncertainty)
    factor, amount = _BEYOND
    return ca.fmin(factor * least + amount, 0.5 * (1 + least)) if uncertainty > 0 else 0.0


def check_cycles(owner: str, cycles: Cycles, name: str = "cycles") -> None:
    """Raise InvalidValue for a dead time that is negative, not finite, or beyond 1000 cycles, and for an empty tuple."""
    values = every(cycles)
    if not values or not all(finite_number(c) and 0 <= c <= MOST for c in values):
        raise InvalidValue(
            f"{owner}({name}={cycles!r}): expected a dead time between 0 and {MOST} control cycles, or a tuple with one for "
            "every controlled coordinate"
        )


def check_whole(owner: str, cycles: Cycles, name: str) -> None:
    """Raise InvalidValue for parts of a cycle, which no model is late by."""
    for value in every(cycles):
        low = math.floor(value)
        if abs(value - round(value)) > WHOLE:
            raise InvalidValue(
                f"{owner}({name}={cycles!r}): a model is late by whole control cycles; give {low} or {low + 1} for {value:g}"
            )


def check_uncertainty(owner: str, uncertainty: int, cycles: Cycles) -> None:
    """Raise InvalidValue for an uncertainty that exceeds the shortest dead time, rounded up."""
    shortest = min(every(cycles))
    if not 0 <= uncertainty <= math.ceil(shortest):
        raise InvalidValue(
            f"{owner}(uncertainty={uncertainty!r}): expected whole cycles from 0 to {math.ceil(shortest)}, the dead time of "
            f"{shortest:g} rounded up: a dead time cannot be too long by more than itself"
        )


def _least_pole(product: float, uncertainty: float) -> float:
    """The least pole that the theorem allows for a product g of gain and plant in (0, 2) and a dead time wrong by m cycles.

    p = (2 c + 1 - sqrt(4 c + 1)) / (2 c) with c = g (2 + g) m^2 / 4, here without cancellation; the product may be open.
    """
    bound = product * (2 + product) * uncertainty**2 / 4
    return 2 * bound / (2 * bound + 1 + ca.sqrt(4 * bound + 1))


@dataclass(frozen=True)
class _Queued(Wrapper):
    """The wrapped map with its own past requests and desired responses.

    Args:
        cycles: dead time d between a request and its response, beyond the one cycle that every loop has; a tuple gives every
            controlled coordinate its own.

    Raises:
        InvalidValue: a dead time that is negative, not finite, or beyond 1000 cycles; an uncertainty beyond the dead time.
    """

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
        valid = memory["queue_filled"] >= queue.length - 1
        size = desired.numel()
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
        cycles: dead time d, or one for every controlled coordinate.

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
        super().__post_init__()
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
    def _pole(self) -> float:
        return chosen_pole(self.map.effective_gain(), self.cycles, self.uncertainty, self.pole)


def examples(inner: Deformation) -> tuple[Deformation, ...]:
    """Values for the laws, around any map."""
    return (Paired(inner, cycles=3), Increment(inner, cycles=2.5))
