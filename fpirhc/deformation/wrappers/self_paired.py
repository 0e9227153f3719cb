"""An unknown dead time: estimated and logged, or estimated and used.

    DelayWatched   the wrapped map as it is; the estimated dead time and its confidence are logged.
    SelfPaired     pairs each response with the request of as many cycles ago as the estimated dead time. An estimate is adopted
                   when it has been the same, to one cycle, in 100 confident cycles in succession; cycles without confidence in
                   between are not counted. Until then the last adopted estimate stays. Before the first one the request is the
                   desired response, because no adaptation is better than a wrong pair.

A request that moves smoothly shows no dead time. A task with steps, noise in the measurement, or a plan that starts anew shows it.
Signals: `dead_time_cycles` and `dead_time_confidence` (see `delay_estimate`); `paired_cycles` is the dead time that `SelfPaired`
uses, -1 before the first estimate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from fpirhc.deformation.base import Deformation, Pairing
from fpirhc.deformation.wrappers.base import Wrapper, of_map
from fpirhc.deformation.wrappers.delay_estimate import SIGNALS, estimate_held, estimate_memory, estimated
from fpirhc.errors import InvalidValue
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar

MOST = 200  # cycles: the estimate costs as many multiplications, twice, in every control cycle
_PATIENCE = 100


@dataclass(frozen=True)
class DelayWatched(Wrapper):
    """The wrapped map as it is, with an estimate of the dead time in the log.

    Args:
        map: any deformation.
        most: longest dead time that is searched, cycles.

    Raises:
        InvalidValue: a longest dead time outside 1 .. 200.
    """

    most: int

    def __post_init__(self) -> None:
        _check_most(type(self).__name__, self.most)

    @property
    def constant(self) -> bool:
        """As the map: the estimate does not change the iteration."""
        return self.map.constant

    def memory(self, elements: tuple[str, ...]) -> Layout:
        """The memory of the estimate and of the map."""
        return estimate_memory(elements, self.most) + self.map.memory(elements)

    def shown(self) -> Mapping[str, str]:
        """The estimate, its confidence, and the signals of the map."""
        return {**SIGNALS, **self.map.shown()}

    def held(self, request: Expression, memory: Mapping[str, Expression]) -> dict[str, Expression]:
        """Return the past requests of the estimate with the held one once more."""
        return {**estimate_held(request, memory), **self.map.held(request, memory)}

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return the next request of the map, unchanged."""
        inner = of_map(self, memory, request.numel())
        next_request, next_memory = self.map.step(request, response, desired, inner)
        return next_request, {**estimated(request, response, memory, self.most), **next_memory}


@dataclass(frozen=True)
class SelfPaired(Wrapper):
    """The map on the pair of an estimated dead time.

    Args:
        map: any deformation that iterates.
        most: longest dead time that is searched, cycles.
        confidence: least confidence of an estimate that is used, in (0, 1).

    Raises:
        InvalidValue: a longest dead time outside 1 .. 200, a confidence outside (0, 1).
    """

    most: int
    confidence: float = 0.6

    def __post_init__(self) -> None:
        _check_most(type(self).__name__, self.most)
        if not 0 < self.confidence < 1:
            raise InvalidValue(f"SelfPaired(confidence={self.confidence!r}): expected a share between 0 and 1")

    @property
    def pairing(self) -> Pairing:
        """A pairing whose dead time is estimated on line."""
        return Pairing(None)

    def memory(self, elements: tuple[str, ...]) -> Layout:
        """Past requests, the dead time in use, the candidate and its age; the memory of the estimate and of the map."""
        past = tuple(f"{e}@{k}" for k in range(self.most + 1) for e in elements)
        counts = (scalar("pair_filled"), scalar("pair_stood"), scalar("pair_candidate"))
        own = Layout((Signal("pair_requests", past), scalar("pair_cycles", start=-1.0), *counts))
        return own + estimate_memory(elements, self.most) + self.map.memory(elements)

    def shown(self) -> Mapping[str, str]:
        """The dead time in use, the estimate, its confidence, and the signals of the map."""
        return {"paired_cycles": "pair_cycles", **SIGNALS, **self.map.shown()}

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return the map's next request from the pair of the dead time in use."""
        inner = of_map(self, memory, request.numel())
        estimate = estimated(request, response, memory, self.most)
        stood, candidate, cycles = self._adopted(estimate, memory)
        size = request.numel()
        pushed: Expression = ca.vertcat(request, memory["pair_requests"])
        requests = pushed[: size * (self.most + 1)]
        own = requests[:size]
        for k in range(1, self.most + 1):
            own = ca.if_else(cycles > k - 0.5, requests[size * k : size * (k + 1)], own)
        valid = ca.logic_and(cycles > -0.5, memory["pair_filled"] >= cycles)
        next_request, next_memory = self.map.step(own, response, desired, inner)
        remembered = {name: ca.if_else(valid, value, inner[name]) for name, value in next_memory.items()}
        filled = ca.fmin(memory["pair_filled"] + 1, self.most + 1)
        pair = {"pair_requests": requests, "pair_cycles": cycles, "pair_filled": filled}
        pair |= {"pair_stood": stood, "pair_candidate": candidate}
        return ca.if_else(valid, next_request, desired), {**pair, **estimate, **remembered}

    def held(self, request: Expression, memory: Mapping[str, Expression]) -> dict[str, Expression]:
        """Return the queues with the held request once more."""
        requests: Expression = ca.vertcat(request, memory["pair_requests"])
        return {
            "pair_requests": requests[: request.numel() * (self.most + 1)],
            "pair_filled": ca.fmin(memory["pair_filled"] + 1, self.most + 1),
            **estimate_held(request, memory),
            **self.map.held(request, memory),
        }

    def _adopted(
        self, estimate: Mapping[str, Expression], memory: Mapping[str, Expression]
    ) -> tuple[Expression, Expression, Expression]:
        """For how many cycles the candidate has stayed the same, the candidate, and the dead time to use."""
        newest, trusted = estimate["delay_cycles"], estimate["delay_confidence"] > self.confidence
        same = ca.fabs(newest - memory["pair_candidate"]) < 1.5
        stood = ca.if_else(trusted, ca.if_else(same, memory["pair_stood"] + 1, 0), memory["pair_stood"])
        candidate = ca.if_else(ca.logic_or(same, ca.logic_not(trusted)), memory["pair_candidate"], newest)
        adopt = ca.logic_and(trusted, stood > _PATIENCE)
        return stood, candidate, ca.if_else(adopt, newest, memory["pair_cycles"])


def _check_most(owner: str, most: int) -> None:
    if not 1 <= most <= MOST:
        raise InvalidValue(f"{owner}(most={most!r}): expected a longest dead time between 1 and {MOST} cycles")


def examples(inner: Deformation) -> tuple[Deformation, ...]:
    """Values for the laws, around any map."""
    return (SelfPaired(inner, most=5), DelayWatched(inner, most=5))
