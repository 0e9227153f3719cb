"""A low-pass on the response error of a map.

    g_k = p g_{k-1} + (1 - p) (f_k - d_k),     r_{k+1} = G(r_k, d_k + g_k, d_k).

Theory: docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fpirhc.deformation.base import Deformation, Wrapper, memory_of_map, with_inner
from fpirhc.fields.kinds import BelowOne
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


def examples(inner: Deformation) -> tuple[Deformation, ...]:
    """Values for the laws, around any map."""
    return (Filtered(inner, pole=0.5),)
