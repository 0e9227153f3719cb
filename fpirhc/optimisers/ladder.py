"""Two optimisers in a row: the second one is called where the first one ends without a usable plan.

A plan is usable when its status is OK or NOT_CONVERGED. `FixedPoint` says INFEASIBLE wherever hard limits of states cannot be kept,
and the second one is called there. Both start from the last plan that was used. After a plan of the second optimiser, the first one
begins its next call from that plan's inputs alone. A run logs the number of plans of the second optimiser as `second_plans`, and
its metrics show it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from fpirhc.horizon.problem import OptimalControl
from fpirhc.optimisers.base import Optimiser
from fpirhc.status import Status
from fpirhc.symbolic.expression import FINITE
from fpirhc.symbolic.layout import Layout, discrete

_PLAN, _COUNT = "plan_inputs", "plan_second_plans"


@dataclass(frozen=True)
class Ladder(Optimiser):
    """The first optimiser, and a second one for horizons that the first leaves without a usable plan.

    Args:
        first: called in every cycle.
        second: called in the same cycle where the status of the first is INFEASIBLE or NON_FINITE. Of two plans that are not
            usable the finite one is returned, else that of the first.
    """

    first: Optimiser
    second: Optimiser

    @property
    def exportable(self) -> bool:
        return self.first.exportable and self.second.exportable

    @property
    def unbounded(self) -> str:
        return self.first.unbounded or self.second.unbounded

    @property
    def logged(self) -> Mapping[str, str]:
        return {"second_plans": _COUNT}

    @property
    def near_plan(self) -> Optimiser:
        return Ladder(self.first.near_plan, self.second.near_plan)

    def check(self, ocp: OptimalControl) -> None:
        self.first.check(ocp)
        self.second.check(ocp)

    def memory(self, ocp: OptimalControl) -> Layout:
        first, second = self.first.memory(ocp), self.second.memory(ocp)
        own = [replace(s, name=f"first_{s.name}") for s in first.signals if s.name != _PLAN]
        other = [replace(s, name=f"second_{s.name}") for s in second.signals if s.name != _PLAN]
        return Layout((first[_PLAN], *own, *other, discrete(_COUNT)))

    def shifted(self, ocp: OptimalControl, memory: ca.MX) -> ca.MX:
        parts = self.memory(ocp).split(memory)
        one = self.first.shifted(ocp, self._part(ocp, self.first, "first", parts))
        other = self.second.shifted(ocp, self._part(ocp, self.second, "second", parts))
        plan = self.first.memory(ocp).split(one)[_PLAN]
        return self._joined(ocp, plan, one, other, parts[_COUNT])

    def step(self, ocp: OptimalControl) -> ca.Function:
        return self._laddered(ocp, self.first.step(ocp), self.second.step(ocp))

    def converging(self, ocp: OptimalControl) -> ca.Function:
        return self._laddered(ocp, self.first.converging(ocp), self.second.converging(ocp))

    def first_memory(self, ocp: OptimalControl, state: np.ndarray, data: np.ndarray) -> np.ndarray:
        layout, one = self.memory(ocp), self.first.first_memory(ocp, state, data)
        parts = self.first.memory(ocp).unpack(one)
        return layout.pack({(n if n == _PLAN else f"first_{n}"): value for n, value in parts.items()})

    def _laddered(self, ocp: OptimalControl, first: ca.Function, second: ca.Function) -> ca.Function:
        layout = self.memory(ocp)
        symbols = [ca.MX.sym(first.name_in(k), *first.size_in(k)) for k in range(4)]
        arguments = [*symbols, ca.MX.sym("memory", layout.size)]
        parts = layout.split(arguments[4])
        begun = first(*symbols, self._part(ocp, self.first, "first", parts))
        names, shapes = ("U", "told", "after"), [first.size_out(k) for k in range(3)]
        results = [ca.MX.sym(name, *shape) for name, shape in zip(names, shapes, strict=True)]
        work = ca.Function("fpirhc_second", [*arguments, *results], self._second(ocp, second, arguments, results))
        before = self._part(ocp, self.second, "second", parts)
        plan = ca.vec(results[0])
        after = self._joined(ocp, plan, results[2], before, parts[_COUNT])
        rest = ca.Function("fpirhc_no_second", [*arguments, *results], [*results[:2], after])
        choice = ca.Function.if_else("fpirhc_second_if_needed", work, rest)
        better = choice(begun[1][4] > int(Status.NOT_CONVERGED) + 0.5, *arguments, *begun)
        inner = ca.Function("fpirhc_ladder_step", arguments, list(better))
        # A memory that is not finite would stay so where its optimiser is not called.
        usable = ca.if_else(ca.fabs(arguments[4]) <= FINITE, arguments[4], 0)
        return ca.Function("fpirhc_ladder", arguments, list(inner(*symbols, usable)))

    def _second(
        self, ocp: OptimalControl, second: ca.Function, arguments: list[ca.MX], results: list[ca.MX]
    ) -> list[ca.MX]:
        """The better one of both results."""
        parts = self.memory(ocp).split(arguments[4])
        inputs, diagnostics, after = second(*arguments[:4], self._part(ocp, self.second, "second", parts))
        usable = diagnostics[4] < int(Status.INFEASIBLE) - 0.5
        only = ca.logic_and(results[1][4] == int(Status.NON_FINITE), diagnostics[4] < int(Status.NON_FINITE) - 0.5)
        better = ca.logic_or(usable, only)
        plan = ca.if_else(better, inputs, results[0])
        # The next call of the first begins from the inputs alone.
        forgotten = ca.if_else(better, ca.MX(self.first.memory(ocp).start()), results[2])
        memory = self._joined(ocp, ca.vec(plan), forgotten, after, parts[_COUNT] + better)
        return [plan, ca.if_else(better, diagnostics, results[1]), memory]

    def _part(self, ocp: OptimalControl, optimiser: Optimiser, name: str, parts: Mapping[str, ca.MX]) -> ca.MX:
        layout = optimiser.memory(ocp)
        return layout.join({n: parts[n if n == _PLAN else f"{name}_{n}"] for n in layout.names})

    def _joined(self, ocp: OptimalControl, plan: ca.MX, one: ca.MX, other: ca.MX, count: ca.MX) -> ca.MX:
        joined: dict[str, ca.MX] = {_PLAN: plan, _COUNT: count}
        for name, optimiser, memory in (("first", self.first, one), ("second", self.second, other)):
            split = optimiser.memory(ocp).split(memory)
            joined |= {f"{name}_{n}": value for n, value in split.items() if n != _PLAN}
        return self.memory(ocp).join(joined)


def examples(inner: Optimiser) -> tuple[Optimiser, ...]:
    """Values for the laws, around any optimiser."""
    return (Ladder(inner, inner),)
