"""The one door between numbers and CasADi: evaluation through buffers, results that are kept, and results that break.

An ordinary call of a Function costs tens of microseconds; through fixed buffers it costs a fraction of one. A matrix appears as an
array of shape (columns, rows), a column as (rows,). A Function must not run in two threads at once: use processes, each with an
`Evaluator` of its own.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from functools import partial
from operator import is_
from typing import Any, Generic, TypeVar, cast

import casadi as ca
import numpy as np
import numpy.typing as npt

from fpirhc.errors import InvalidValue


class Evaluator:
    """A Function with its own argument and result arrays."""

    def __init__(self, function: ca.Function) -> None:
        """Allocate the arrays and bind them; arguments and results are dense."""
        self.function = function
        self._buffer, handle = cast(tuple[Any, Callable[[], object]], self.function.buffer())  # its stub is that of C++
        self.arguments = tuple(_array(self.function.size_in(k)) for k in range(self.function.n_in()))
        self.results = tuple(_array(self.function.size_out(k)) for k in range(self.function.n_out()))
        for k, array in enumerate(self.arguments):
            self._buffer.set_arg(k, array.data)
        for k, array in enumerate(self.results):
            self._buffer.set_res(k, array.data)
        self._redirected: dict[int, np.ndarray] = {}
        self.evaluate: Callable[[], object] = partial(handle)
        # The handle points into memory that the buffer and the arrays own, so it must keep them alive.
        owners = (self._buffer, self.arguments, self.results, self._redirected)
        vars(self.evaluate)["owners"] = owners

    def redirect(self, k: int, array: np.ndarray) -> None:
        """Write result `k` into `array` from now on, such as a slice of a log, and no longer into `results[k]`."""
        assert (array.size, array.dtype.char, array.flags.c_contiguous) == (self.results[k].size, "d", True)
        self._redirected[k] = array
        self._buffer.set_res(k, array.data)

    @property
    def failed(self) -> bool:
        """Whether the last evaluation failed; one of compiled code shows only here."""
        return bool(self._buffer.ret() != 0)

    def failure(self) -> str:
        """Evaluate; return why that failed, empty where it did not."""
        try:
            self.evaluate()
        except (RuntimeError, SystemError) as error:
            cause = unwrapped(error)
            if not isinstance(cause, RuntimeError):
                raise cause from None
            return (str(error).strip().splitlines() or ["no reason"])[-1]  # CasADi's own, of a solver in the loop
        return "compiled code failed" if self.failed else ""

    def __call__(self, *values: npt.ArrayLike) -> tuple[np.ndarray, ...]:
        """Evaluate with these arguments and return copies of the results."""
        for array, value in zip(self.arguments, values, strict=True):
            array[...] = np.reshape(value, array.shape)
        if why := self.failure():
            raise InvalidValue(f"'{self.function.name()}' fails for these arguments ({why}): {values}")
        return tuple(result.copy() for result in self.results)


def unwrapped(error: Exception) -> BaseException:
    """Return the interruption from the keyboard that CasADi wrapped, or else the error itself.

    A solver that Ctrl-C reaches returns with the interruption set, which Python reports as a SystemError; where CasADi itself looks
    for Ctrl-C between two operations, it raises a RuntimeError that ends in the name of the interruption.
    """
    cause = error.__cause__ or error.__context__
    if isinstance(error, RuntimeError) and str(error).strip().endswith(KeyboardInterrupt.__name__):
        return KeyboardInterrupt()
    return cause if isinstance(cause, KeyboardInterrupt) else error


def require_unsolved(error: RuntimeError) -> None:
    """Return where a solver inside a Function found no solution; raise every other error, and Ctrl-C as what it is."""
    if "Evaluation failed" not in str(error):  # of a rootfinder
        raise unwrapped(error) from None


def _array(size: tuple[int, int]) -> np.ndarray:
    rows, columns = size
    return np.zeros(rows if columns == 1 else (columns, rows))


T = TypeVar("T")


class Latest(threading.local, Generic[T]):
    """The latest few results of a function, of every thread its own: an evaluator among them has numbers of its last call."""

    def __init__(self, most: int) -> None:
        self._known: deque[tuple[tuple[object, ...], tuple[object, ...], T]] = deque(maxlen=most)

    def of(self, same: tuple[object, ...], equal: tuple[object, ...], build: Callable[[], T]) -> T:
        """Return what `build` returns, or what it returned for the `same` objects and `equal` values."""
        for objects, others, result in tuple(self._known):
            alike = len(objects) == len(same) and all(map(is_, objects, same))
            if alike and others == equal:
                return result
        result = build()
        self._known.append((same, equal, result))
        return result


def attempted(what: str, compute: Callable[..., T], *arguments: object, broken: list[str], **named: object) -> T | None:
    """Return what a function returns; None where it raises, with a sentence about it added to `broken`."""
    try:
        with np.errstate(all="ignore"):  # numbers that overflow show in the result
            return compute(*arguments, **named)
    except Exception as error:  # noqa: BLE001 -- whatever it is, what was computed before must not be lost
        interruption = unwrapped(error)
        if not isinstance(interruption, Exception):
            raise interruption from None
        first = f"{type(error).__name__}: {f'{error}'.strip().partition(chr(10))[0]}".removesuffix(": ")
        broken.append(f"{what} could not be computed ({first}); the rest does not depend on it")
        return None
