"""A causal, undecimated Haar denoiser on the response error of a map.

    c_0 = f - d,   c_j(k) = (c_{j-1}(k) + c_{j-1}(k - 2^(j-1))) / 2,   d_j = c_{j-1} - c_j,   g = c_J + sum of large d_j.

Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import casadi as ca

from fpirhc.deformation.base import Deformation, Form, Wrapper, memory_of_map
from fpirhc.fields.kinds import Positive, whole
from fpirhc.symbolic.layout import Expression, Layout, Signal


@dataclass(frozen=True)
class Haar(Wrapper):
    """The wrapped map on a response error whose small details are left out: jumps pass at once, noise is averaged.

    Args:
        map: any deformation that iterates.
        noise: deviation of the response's noise, in its unit.
        levels: J; what is small is the mean of 2^J cycles.
        threshold: details up to so many of their own deviations, noise / 2^(j/2) for white noise, count as noise.
    """

    noise: Positive
    levels: Annotated[int, whole(1, 8)] = 4
    threshold: Positive = 3.0

    @property
    def form(self) -> Form:
        """That of the map for errors beyond the noise; smaller ones are spread over 2^J cycles."""
        return replace(self.map.form, steady=False)

    def memory(self, elements: tuple[str, ...]) -> Layout:
        past = tuple(f"{e}@{k}" for k in range(1, 2**self.levels) for e in elements)
        return Layout((Signal("haar_errors", past),)) + self.map.memory(elements)

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return G(r, d + g, d), and the errors of the last 2^J - 1 cycles."""
        inner, size = memory_of_map(self, memory, request.numel()), request.numel()
        errors = ca.vertcat(response - desired, memory["haar_errors"])
        smooth, jumps = ca.reshape(errors, size, 2**self.levels), 0 * request
        for level in range(1, self.levels + 1):
            apart = 2 ** (level - 1)
            count = smooth.size2() - apart
            coarse = (smooth[:, :count] + smooth[:, apart:]) / 2
            detail, small = smooth[:, 0] - coarse[:, 0], self.threshold * self.noise / math.sqrt(2.0) ** level
            jumps = jumps + ca.if_else(ca.fabs(detail) > small, detail, 0)
            smooth = coarse
        next_request, next_memory = self.map.step(request, desired + smooth[:, 0] + jumps, desired, inner)
        return next_request, {"haar_errors": errors[:-size], **next_memory}


def examples(inner: Deformation) -> tuple[Deformation, ...]:
    """Values for the laws, around any map."""
    return (Haar(inner, noise=1e-12, levels=2),)  # the laws try errors of 1e-6
