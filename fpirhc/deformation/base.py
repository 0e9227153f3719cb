"""The contract of deformations: how the next request follows from the last request and its response error.

A controller wants a response d (desired) and asks its model for r (the request, or deformed response); the plant
answers f(r). A deformation is the fixed-point iteration r+ = G(r, f, d) with G(r, d, d) = r: where the response is the
desired one the request stays, so at the fixed point the plant does what was desired although the model is wrong. To
first order every map here is r+ = r - a (f - d) with one number a, its effective gain.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar, Self

import casadi as ca

from fpirhc.errors import InvalidValue
from fpirhc.symbolic.layout import Expression, Layout


class Deformation(ABC):
    """Contract: a map from (request, response, desired) to the next request.

    Concrete maps are frozen dataclasses. `fpirhc.conformance.check_deformation` tests that a map keeps this contract.
    """

    gain_name: ClassVar[str] = "gain"  # the field that the effective gain is proportional to

    def memory(self, elements: tuple[str, ...]) -> Layout:
        """What the map remembers besides the pair (request, desired); nothing unless it says otherwise."""
        del elements
        return Layout()

    def shown(self) -> Mapping[str, str]:
        """Signals to log: name -> the scalar of the memory that it shows."""
        return {}

    @abstractmethod
    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return the next request and what to remember.

        Parameters: `request` caused `response`; `desired` is asked for now; all are CasADi columns of the same size.
        Values and derivatives of any order are finite at response = desired.
        """

    @abstractmethod
    def effective_gain(self) -> float:
        """First-order step per unit of response error: r+ = r - a (response - desired) + ..., dimensionless."""

    @abstractmethod
    def secant_gain(self) -> float:
        """Largest step per unit of response error at any size of the error, with the sign of the effective gain."""

    @abstractmethod
    def largest_step(self) -> float:
        """Bound of |r+ - r| in one cycle, in units of the response; infinite when there is none."""

    @abstractmethod
    def with_effective_gain(self, gain: float) -> Self:
        """Return the same map with another effective gain."""


def smooth_norm(column: Expression, floor: float) -> Expression:
    """Return sqrt(|column|^2 + floor^2): the Euclidean norm, differentiable at zero and never zero."""
    return ca.sqrt(ca.sumsqr(column) + floor**2)


def require_numbers(owner: str, values: Mapping[str, float]) -> None:
    """Check that every value is a finite number other than zero.

    Raises:
        InvalidValue: naming every value that is not.
    """
    wrong = [f"{name}={value!r}" for name, value in values.items() if not _is_number(value) or value == 0]
    if wrong:
        raise InvalidValue(
            f"{owner}({', '.join(wrong)}): expected finite numbers other than zero. "
            "Zero would freeze the request; no adaptation is Identity()"
        )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
