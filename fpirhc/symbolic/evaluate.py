"""The one door between numbers and CasADi: evaluation through buffers.

An ordinary call of a Function from Python costs tens of microseconds; through fixed buffers it costs a fraction of one. An
`Evaluator` owns numpy arrays for all arguments and results: write into `arguments`, call `evaluate`, read `results`.

CasADi matrices are column-major, so a (rows, columns) matrix appears as an array of shape (columns, rows); a column as (rows,).
Not for threads: a Function must not run in two threads at once. Use processes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidShape


class Evaluator:
    """A Function with its own argument and result arrays."""

    def __init__(self, function: ca.Function) -> None:
        """Allocate the arrays and bind them; sparse arguments and results become dense."""
        self.function = _dense(function)
        # The buffer must live as long as the evaluation handle: the handle alone points into freed memory.
        self._buffer: Any
        self._buffer, evaluate = self.function.buffer()
        self.evaluate: Callable[[], Any] = evaluate
        self.arguments = tuple(_array(self.function.size_in(k)) for k in range(self.function.n_in()))
        self.results = tuple(_array(self.function.size_out(k)) for k in range(self.function.n_out()))
        for k, array in enumerate(self.arguments):
            self._buffer.set_arg(k, array.data)
        for k, array in enumerate(self.results):
            self._buffer.set_res(k, array.data)

    def __call__(self, *values: np.ndarray | float) -> tuple[np.ndarray, ...]:
        """Evaluate with these arguments and return copies of the results.

        Raises:
            InvalidShape: a wrong number of arguments, or of entries of one.
        """
        if len(values) != len(self.arguments):
            raise InvalidShape(f"{self.function.name()} takes {len(self.arguments)} arguments, got {len(values)}")
        for k, (array, value) in enumerate(zip(self.arguments, values, strict=True)):
            given = np.asarray(value, dtype=float)
            if given.size != array.size:
                name = self.function.name_in(k)
                raise InvalidShape(
                    f"argument '{name}' has {array.size} entries (shape {array.shape}), got {given.size}"
                )
            array[...] = given.reshape(array.shape)
        self.evaluate()
        return tuple(result.copy() for result in self.results)


def _array(size: tuple[int, int]) -> np.ndarray:
    rows, columns = size
    return np.zeros(rows if columns == 1 else (columns, rows))


def _dense(function: ca.Function) -> ca.Function:
    sparse_in = any(not function.sparsity_in(k).is_dense() for k in range(function.n_in()))
    sparse_out = any(not function.sparsity_out(k).is_dense() for k in range(function.n_out()))
    if not (sparse_in or sparse_out):
        return function
    inputs = [ca.MX.sym(function.name_in(k), *function.size_in(k)) for k in range(function.n_in())]
    results = [ca.densify(r) for r in function.call(inputs)]
    return ca.Function(function.name(), inputs, results, function.name_in(), function.name_out())
