"""A solver that fails: an optimiser of a user's own whose Function raises as CasADi's solvers do."""

from dataclasses import dataclass
from typing import Any

import casadi as ca

import fpirhc as fp


class _Guard(ca.Callback):
    """Hands its argument on, and raises in one call and after it, or when it is told to."""

    def __init__(self, size: int, at: int | None) -> None:
        ca.Callback.__init__(self)
        self.size, self.at, self.calls = size, at, 0
        self.construct("guard", {})

    def get_sparsity_in(self, k: int) -> ca.Sparsity:  # noqa: ARG002
        return ca.Sparsity.dense(self.size)

    get_sparsity_out = get_sparsity_in

    def eval(self, arguments: Any) -> Any:
        self.calls += 1
        if Failing.now or (self.at is not None and self.calls > self.at):
            raise RuntimeError("first line\nsolver failed")
        return arguments


_guards: list[_Guard] = []  # CasADi keeps no reference


@dataclass(frozen=True)
class Failing(fp.FixedPointSolver):
    """The fixed-point iteration; its solver fails from call `at` on, or while `Failing.now` is true."""

    at: int | None = None

    def step(self, ocp: Any) -> ca.Function:
        inner = super().step(ocp)
        symbols = [ca.MX.sym(inner.name_in(k), inner.sparsity_in(k)) for k in range(inner.n_in())]
        guard = _Guard(symbols[0].numel(), self.at)
        _guards.append(guard)
        results = inner(guard(symbols[0]), *symbols[1:])
        names = [[f(k) for k in range(n)] for f, n in ((inner.name_in, inner.n_in()), (inner.name_out, inner.n_out()))]
        return ca.Function(f"{inner.name()}_failing", symbols, results, *names)


Failing.now = False
