"""The affine map: relaxed Picard iteration, without saturation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import casadi as ca
import numpy as np

from fpirhc.deformation.base import Deformation, Form
from fpirhc.describe import as_written
from fpirhc.errors import InvalidValue
from fpirhc.fields.kinds import NotZero, finite_number
from fpirhc.symbolic.layout import Expression


@dataclass(frozen=True)
class Affine(Deformation):
    """r+ = r + (A_c / 2) W (f - d), exactly linear.

    It is eq. (6) of Khan, Tar and Rudas with the kernel zeta(x) = x / 2 + D, whose fixed point x* = 2 D cancels D.

    Args:
        gain: A_c; negative, because the correction acts against the error (the model has the right sign of the input's effect).
        weights: W of coupled responses, by which the gain becomes a matrix: a tuple with one number per controlled coordinate, or
            one of rows. None: the one matrix, every response corrects its own request.

    Raises:
        InvalidValue: weights that are no diagonal and no square matrix of finite numbers, or a singular one.

    References:
        H. Khan, J. K. Tar, I. J. Rudas, Robot. Autom. Eng. J. 3(5), 2018, DOI 10.19080/RAEJ.2018.03.555623.
    """

    gain: NotZero
    weights: tuple[float, ...] | tuple[tuple[float, ...], ...] | None = field(default=None)

    def __post_init__(self) -> None:
        if self.weights is None:
            return
        rows = self._rows
        square = all(len(row) == len(rows) and all(map(finite_number, row)) for row in rows)
        if not square or not rows or np.linalg.matrix_rank(np.array(rows)) < len(rows):
            raise InvalidValue(
                f"Affine(weights={self.weights!r}): expected a tuple with a finite number other than zero per controlled "
                "coordinate, (1.0, 3.0), or the rows of a matrix that has an inverse, ((1.0, 0.2), (0.0, 3.0))"
            )

    def __repr__(self) -> str:
        return as_written(self)

    @property
    def form(self) -> Form:
        return Form(weights=None if self.weights is None else self._rows)

    @property
    def _rows(self) -> tuple[tuple[float, ...], ...]:
        weights = self.weights or ()
        if rows := tuple(one for one in weights if isinstance(one, tuple)):
            return rows
        numbers = [one for one in weights if not isinstance(one, tuple)]
        return tuple(tuple(w if j == k else 0.0 for j in range(len(numbers))) for k, w in enumerate(numbers))

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return r + (A_c / 2) W (f - d)."""
        del memory
        error = response - desired
        if self.weights is not None:
            error = ca.vertcat(*(sum(w * error[k] for k, w in enumerate(row)) for row in self._rows))
        return request + 0.5 * self.gain * error, {}

    def effective_gain(self) -> float:
        """The effective gain a = -A_c / 2."""
        return -0.5 * self.gain

    def with_effective_gain(self, gain: float) -> Self:
        """Return the map with A_c = -2 a."""
        return replace(self, gain=-2.0 * gain)


EXAMPLES = (Affine(gain=-0.5),)
