"""The only door between numbers and CasADi: buffered evaluation."""

from __future__ import annotations
import casadi as ca
import numpy as np


class Evaluator:
    def __init__(self, function: ca.Function) -> None:
        self.function = function
        self._buffer, self.evaluate = function.buffer()

        def shape(n, m):
            return (n,) if m == 1 else (m, n)

        self.arguments = tuple(np.zeros(shape(*function.size_in(k))) for k in range(function.n_in()))
        self.results = tuple(np.zeros(shape(*function.size_out(k))) for k in range(function.n_out()))
        for k, a in enumerate(self.arguments):
            self._buffer.set_arg(k, memoryview(a))
        for k, a in enumerate(self.results):
            self._buffer.set_res(k, memoryview(a))
