"""Filters of the response error of a map: a low-pass, and a causal, undecimated Haar denoiser.

low-pass   g_k = p g_{k-1} + (1 - p) (f_k - d_k),     r_{k+1} = G(r_k, d_k + g_k, d_k)
Haar       c_0 = f - d,   c_j(k) = (c_{j-1}(k) + c_{j-1}(k - 2^(j-1))) / 2,   d_j = c_{j-1} - c_j,   g = c_J + sum of large d_j
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import casadi as ca

from fpirhc.deformation.base import Deformation, Form, Wrapper, memory_of_map, with_inner
from fpirhc.fields.kinds import BelowOne, Positive, whole
from fpirhc.symbolic.layout import Expression, Layout, Signal


@dataclass(frozen=True)
class Filtered(Wrapper):
    """The wrapped map on a low-passed response error.

    Args:
        map: any deformation that iterates.
        pole: p of the filter, from 0 (none) to below 1; exp(-period / time constant).
    """

    pole: BelowOne

    def memory(self, elements: tuple[str, ...]) -> Layout:
        return Layout((Signal("filter_error", elements),)) + self.map.memory(elements)

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        inner = memory_of_map(self, memory, request.numel())
        error = self.pole * memory["filter_error"] + (1 - self.pole) * (response - desired)
        next_request, next_memory = self.map.step(request, desired + error, desired, inner)
        return next_request, {"filter_error": error, **next_memory}


def with_filter(deformation: Deformation, pole: float) -> Deformation:
    """Return a deformation whose innermost map is filtered."""
    inner = deformation.inner
    return Filtered(deformation, pole) if inner is None else with_inner(deformation, with_filter(inner, pole))


_THRESHOLD = 3.0  # deviations of a detail, noise / 2^(j/2) for white noise, up to which it counts as noise


@dataclass(frozen=True)
class Haar(Wrapper):
    """The wrapped map on a response error whose small details are left out: jumps pass at once, noise is averaged.

    Args:
        map: any deformation that iterates.
        noise: deviation of the response's noise, in its unit.
        levels: J; what is small is the mean of 2^J cycles.
    """

    noise: Positive
    levels: Annotated[int, whole(1, 8)] = 4

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
            detail, small = smooth[:, 0] - coarse[:, 0], _THRESHOLD * self.noise / math.sqrt(2.0) ** level
            jumps = jumps + ca.if_else(ca.fabs(detail) > small, detail, 0)
            smooth = coarse
        next_request, next_memory = self.map.step(request, desired + smooth[:, 0] + jumps, desired, inner)
        return next_request, {"haar_errors": errors[:-size], **next_memory}


def examples(inner: Deformation) -> tuple[Deformation, ...]:
    """Values for the laws, around any map."""
    return Filtered(inner, pole=0.5), Haar(inner, noise=1e-12, levels=2)  # the laws try errors of 1e-6
