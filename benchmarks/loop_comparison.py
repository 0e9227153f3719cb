"""Two closed loops of one problem, FixedPoint's and IPOPT's: what the judge says of their plans, and the bars that are met."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from judging import Judgement
from limited_loop import Loop

import fpirhc as fp
from fpirhc.horizon.problem import OptimalControl
from fpirhc.optimisers.base import KEPT
from fpirhc.optimisers.bounds import scales

CONVERGED, SHARE, COST, TOGETHER = 1e-4, 0.01, 1e-4, 1e-3
PROMPT, SMALL = 2000.0, 5  # us, up to so many states


@dataclass(frozen=True)
class Judged:
    """A loop and what the judge says of its plans."""

    loop: Loop
    judged: list[Judgement]

    @cached_property
    def stationary(self) -> np.ndarray:
        """Which plans meet the first-order conditions, whether they keep the limits or pass them as little as possible."""
        return np.array([j.rough <= CONVERGED for j in self.judged])

    @cached_property
    def converged(self) -> np.ndarray:
        """Which plans are called OK and are so."""
        kept = np.array([j.violation <= CONVERGED for j in self.judged])
        return self.stationary & kept & self.said(fp.Status.OK)

    def said(self, status: fp.Status) -> np.ndarray:
        """In which cycles the optimiser says this."""
        return np.array([p.status == status for p in self.loop.plans])


@dataclass(frozen=True)
class Comparison:
    """Two loops of one problem.

    Args:
        ocp: the problem.
        own: FixedPoint's.
        rival: IPOPT's.
        empty: cycles of FixedPoint's loop for whose horizons IPOPT has no plan.
    """

    ocp: OptimalControl
    own: Judged
    rival: Judged
    empty: np.ndarray

    @cached_property
    def fork(self) -> int | None:
        """The cycle at which the loops find different optima; None where they find one."""
        unit = scales(self.ocp).states[: len(self.own.loop.states[0])]
        totals = (priced(self.ocp, self.own), priced(self.ocp, self.rival))
        for k, (a, b) in enumerate(zip(*totals, strict=False)):
            apart = np.max(np.abs(self.own.loop.states[k] - self.rival.loop.states[k]) / unit)
            if not apart <= TOGETHER:
                return None
            stationary = self.own.stationary[k] and self.rival.stationary[k]
            if stationary and abs(a - b) > COST * max(abs(a), abs(b)):
                return k
        return None

    @property
    def shares(self) -> tuple[float, float]:
        """Shares of converged plans, FixedPoint's and IPOPT's, of the cycles of the longer loop: a loop that diverges ends."""
        cycles = max(len(self.own.judged), len(self.rival.judged))
        return float(self.own.converged.sum() / cycles), float(self.rival.converged.sum() / cycles)

    @property
    def excess(self) -> float:
        """Relative cost of FixedPoint's loop over IPOPT's."""
        return (self.own.loop.cost - self.rival.loop.cost) / abs(self.rival.loop.cost)

    @cached_property
    def told(self) -> np.ndarray:
        """Cycles in which FixedPoint says that there is no plan."""
        return self.own.said(fp.Status.INFEASIBLE)

    @property
    def missed(self) -> list[str]:
        """The bars that are missed."""
        times = np.array([p.microseconds for p in self.own.loop.plans])
        slowest = times[self.told].max(initial=0.0)
        bars = {
            "share": self.shares[0] >= self.shares[1] - SHARE,
            "cost": self.excess <= COST or self.fork is not None,
            "violation": self.own.loop.violation <= self.rival.loop.violation + CONVERGED or self.fork is not None,
            "infeasible": np.mean(self.told != self.empty) <= SHARE,
            "2 ms": slowest <= PROMPT or self.ocp.state.size > SMALL,
        }
        return [name for name, met in bars.items() if not met]

    @property
    def active(self) -> float:
        """Share of FixedPoint's plans that touch a limit of a state."""
        return float(np.mean([room.min() < CONVERGED for room in rooms(self.ocp, self.own.loop)]))

    def cells(self) -> tuple[str, ...]:
        """The row of the table."""
        own, rival = self.own.loop, self.rival.loop
        times = np.array([p.microseconds for p in own.plans])
        count = np.array([p.iterations for p in own.plans])
        empty, told = int(self.empty.sum()), int((self.told & self.empty).sum())
        apart = "" if abs(self.excess) <= COST or self.fork is None else f", another optimum from {self.fork}"
        return (
            f"{100 * self.active:.0f} %",
            " / ".join(f"{100 * share:.1f}" for share in self.shares),
            f"{told} of {empty}" + (f", {wrong} wrongly" if (wrong := int((self.told & ~self.empty).sum())) else ""),
            f"{self.excess:+.0e}{apart}",
            f"{own.violation:.0e} / {rival.violation:.0e}",
            " / ".join(f"{v:.0f}" for v in (*np.quantile(times, (0.5, 0.95, 0.99)), times.max())),
            f"{np.median(count):.0f} / {count.max():.0f}",
            f"{np.median([p.microseconds for p in rival.plans]) / np.median(times):.0f}",
            ", ".join(self.missed),
        )


def rooms(ocp: OptimalControl, loop: Loop) -> Iterator[np.ndarray]:
    """Per plan, how far its states (N, ns) are from their nearer limit, in half ranges; negative beyond it."""
    for s0, data, plan in zip(loop.first, loop.data, loop.plans, strict=True):
        states = [s0]
        for k in range(ocp.stages):
            states.append(np.asarray(ocp.dynamics(states[-1], plan.inputs[:, k], data[:, k]).full()).ravel())
        reached = np.array(states[1:])
        yield np.minimum(reached - ocp.state_lower, ocp.state_upper - reached) / scales(ocp).states


def priced(ocp: OptimalControl, side: Judged) -> list[float]:
    """Cost of every plan with the price of its violations, but for IPOPT's own relaxation of limits."""
    measures = scales(ocp)
    places = list(measures.bounded)
    price = measures.capacity * measures.states[places]
    passed = (np.where(room < -KEPT, -room, 0.0)[:, places] for room in rooms(ocp, side.loop))
    beyond = [float(p.sum(axis=0) @ price) for p in passed]
    return [j.cost + b for j, b in zip(side.judged, beyond, strict=True)]
