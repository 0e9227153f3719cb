"""A dead time that is not known: watched, or found and used.

    DelayWatched   the wrapped map as it is, with the estimated dead time and its confidence in the run.
    SelfPaired     pairs each response with the request of as many cycles ago as the estimate says. An estimate is adopted when it
                   was found, to one cycle, in 100 confident cycles in succession, smooth ones in between not counted; until then
                   the last one stays, and before the first one the request is the desired response: no adaptation is better
                   than a wrong pair.

A request that moves smoothly shows no dead time: a task with steps, noise in the measurement, or a restarted plan does.
Signals: `dead_time_cycles` and `dead_time_confidence` (see `delay_estimate`); `paired_cycles` is what `SelfPaired` uses, -1 before
the first estimate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from fpirhc.deformation.base import Deformation, Pairing
from fpirhc.deformation.wrappers.base import Wrapper, of_map
from fpirhc.deformation.wrappers.delay_estimate import SIGNALS, estimate_memory, estimated
from fpirhc.errors import InvalidValue
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar

MOST = 200  # cycles: the estimate costs as many multiplications, twice, in every control cycle
_PATIENCE = 100


@dataclass(frozen=True)
class DelayWatched(Wrapper):
    """The wrapped map, with an estimate of the dead time beside it.

    Parameters:
        map: any deformation.
        most: longest dead time that is looked for, cycles.

    Raises:
        InvalidValue: a longest dead time outside 1 .. 200.
    """

    most: int

    def __post_init__(self) -> None:
        _check_most(type(self).__name__, self.most)

    @property
    def constant(self) -> bool:
        """What it remembers serves the estimate alone."""
        return self.map.constant

    def memory(self, elements: tuple[str, ...]) -> Layout:
        """The estimate's memory and the map's own."""
        return estimate_memory(elements, self.most) + self.map.memory(elements)

    def shown(self) -> Mapping[str, str]:
        """The estimate and its confidence, and what the map shows."""
        return {**SIGNALS, **self.map.shown()}

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return what the map returns."""
        inner = of_map(self, memory, request.numel())
        wanted, following = self.map.step(request, response, desired, inner)
        return wanted, {**estimated(request, response, memory, self.most), **following}


@dataclass(frozen=True)
class SelfPaired(Wrapper):
    """The map on the pair of an estimated dead time.

    Parameters:
        map: any deformation that iterates.
        most: longest dead time that is looked for, cycles.
        confidence: from which an estimate is trusted, in (0, 1).

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
        """Estimated on line."""
        return Pairing(None)

    def memory(self, elements: tuple[str, ...]) -> Layout:
        """Past requests, what is believed and for how long the estimate has stood; the estimate's memory and the map's own."""
        past = tuple(f"{e}@{k}" for k in range(self.most + 1) for e in elements)
        counts = (scalar("pair_filled"), scalar("pair_stood"), scalar("pair_candidate"))
        own = Layout((Signal("pair_requests", past), scalar("pair_cycles", start=-1.0), *counts))
        return own + estimate_memory(elements, self.most) + self.map.memory(elements)

    def shown(self) -> Mapping[str, str]:
        """The dead time in use, the estimate and its confidence, and what the map shows."""
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
        wanted, following = self.map.step(own, response, desired, inner)
        kept = {name: ca.if_else(valid, value, inner[name]) for name, value in following.items()}
        filled = ca.fmin(memory["pair_filled"] + 1, self.most + 1)
        pair = {"pair_requests": requests, "pair_cycles": cycles, "pair_filled": filled}
        pair |= {"pair_stood": stood, "pair_candidate": candidate}
        return ca.if_else(valid, wanted, desired), {**pair, **estimate, **kept}

    def _adopted(
        self, estimate: Mapping[str, Expression], memory: Mapping[str, Expression]
    ) -> tuple[Expression, Expression, Expression]:
        """For how long the estimate has stood, which one it is, and the dead time to use."""
        found, trusted = estimate["delay_cycles"], estimate["delay_confidence"] > self.confidence
        same = ca.fabs(found - memory["pair_candidate"]) < 1.5
        stood = ca.if_else(trusted, ca.if_else(same, memory["pair_stood"] + 1, 0), memory["pair_stood"])
        candidate = ca.if_else(ca.logic_or(same, ca.logic_not(trusted)), memory["pair_candidate"], found)
        adopt = ca.logic_and(trusted, stood > _PATIENCE)
        return stood, candidate, ca.if_else(adopt, found, memory["pair_cycles"])


def _check_most(owner: str, most: int) -> None:
    if not 1 <= most <= MOST:
        raise InvalidValue(f"{owner}(most={most!r}): expected a longest dead time between 1 and {MOST} cycles")


def examples(inner: Deformation) -> tuple[Deformation, ...]:
    """Values for the laws, around any map."""
    return (SelfPaired(inner, most=5), DelayWatched(inner, most=5))
