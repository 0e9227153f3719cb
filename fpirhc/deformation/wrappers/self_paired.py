"""An unknown dead time: estimated and logged, or estimated and used. Theory: docs/theory-maps.md."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import casadi as ca

from fpirhc.deformation.base import Deformation, Iteration, Pairing, Wrapper, memory_of_map
from fpirhc.fields.kinds import Accuracy, whole
from fpirhc.symbolic.expression import total
from fpirhc.symbolic.layout import Expression, Kind, Layout, Signal, discrete, scalar

_MOST = 200  # cycles: the estimate costs as many multiplications, twice, in every control cycle
_PATIENCE = 100
_MEAN = 0.05  # share of a new value in the running means
_STEP = 0.2  # mu
_ROUGH = 0.1  # R from which requests are rough enough to distinguish a cycle from the next
_FLOOR = 1e-12  # of |r~|^2 relative to the running mean's square


@dataclass(frozen=True)
class DelayWatched(Wrapper):
    """The wrapped map as it is, with an estimate of the dead time in the log.

    Args:
        map: any deformation.
        most: longest dead time that is searched, cycles.
    """

    most: Annotated[int, whole(1, _MOST)]

    @property
    def iteration(self) -> Iteration:
        return self.map.iteration

    def memory(self, elements: tuple[str, ...]) -> Layout:
        return _estimate_memory(elements, self.most) + self.map.memory(elements)

    def shown(self) -> Mapping[str, str]:
        return {**_SIGNALS, **self.map.shown()}

    def held(self, request: Expression, memory: Mapping[str, Expression]) -> dict[str, Expression]:
        return {**_estimate_held(request, memory), **self.map.held(request, memory)}

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        inner = memory_of_map(self, memory, request.numel())
        next_request, next_memory = self.map.step(request, response, desired, inner)
        return next_request, {**_estimated(request, response, memory, self.most), **next_memory}


@dataclass(frozen=True)
class SelfPaired(Wrapper):
    """The map on the pair of an estimated dead time.

    Args:
        map: any deformation that iterates.
        most: longest dead time that is searched, cycles.
        confidence: least confidence of an estimate that is used, in (0, 1).
    """

    chooses_pair: ClassVar[bool] = True

    most: Annotated[int, whole(1, _MOST)]
    confidence: Accuracy = 0.6

    @property
    def iteration(self) -> Iteration:
        return replace(super().iteration, pairing=Pairing(None))

    def memory(self, elements: tuple[str, ...]) -> Layout:
        past = tuple(f"{e}@{k}" for k in range(self.most + 1) for e in elements)
        counts = (discrete("pair_filled"), discrete("pair_stood"), discrete("pair_candidate"))
        own = Layout((Signal("pair_requests", past), scalar("pair_cycles", start=-1.0), *counts))
        return own + _estimate_memory(elements, self.most) + self.map.memory(elements)

    def shown(self) -> Mapping[str, str]:
        return {"paired_cycles": "pair_cycles", **_SIGNALS, **self.map.shown()}

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        inner = memory_of_map(self, memory, request.numel())
        estimate = _estimated(request, response, memory, self.most)
        stood, candidate, cycles = self._adopted(estimate, memory)
        size = request.numel()
        pushed: Expression = ca.vertcat(request, memory["pair_requests"])
        requests = pushed[: size * (self.most + 1)]
        own = requests[:size]
        for k in range(1, self.most + 1):
            own = ca.if_else(cycles > k - 0.5, requests[size * k : size * (k + 1)], own)
        valid = ca.logic_and(cycles > -0.5, memory["pair_filled"] >= cycles)
        next_request, next_memory = self.map.step(own, response, desired, inner)
        remembered = {name: ca.if_else(valid, value, inner[name]) for name, value in next_memory.items()}
        filled = ca.fmin(memory["pair_filled"] + 1, self.most + 1)
        pair = {"pair_requests": requests, "pair_cycles": cycles, "pair_filled": filled}
        pair |= {"pair_stood": stood, "pair_candidate": candidate}
        return ca.if_else(valid, next_request, desired), {**pair, **estimate, **remembered}

    def held(self, request: Expression, memory: Mapping[str, Expression]) -> dict[str, Expression]:
        requests: Expression = ca.vertcat(request, memory["pair_requests"])
        return {
            "pair_requests": requests[: request.numel() * (self.most + 1)],
            "pair_filled": ca.fmin(memory["pair_filled"] + 1, self.most + 1),
            **_estimate_held(request, memory),
            **self.map.held(request, memory),
        }

    def _adopted(
        self, estimate: Mapping[str, Expression], memory: Mapping[str, Expression]
    ) -> tuple[Expression, Expression, Expression]:
        """For how many cycles the candidate has stayed the same, the candidate, and the dead time to use."""
        newest, trusted = estimate["delay_cycles"], estimate["delay_confidence"] > self.confidence
        same = ca.fabs(newest - memory["pair_candidate"]) < 1.5
        stood = ca.if_else(trusted, ca.if_else(same, memory["pair_stood"] + 1, 0), memory["pair_stood"])
        candidate = ca.if_else(ca.logic_or(same, ca.logic_not(trusted)), memory["pair_candidate"], newest)
        adopt = ca.logic_and(trusted, stood > _PATIENCE)
        return stood, candidate, ca.if_else(adopt, newest, memory["pair_cycles"])


def examples(inner: Deformation) -> tuple[Deformation, ...]:
    """Values for the laws, around any map."""
    return (SelfPaired(inner, most=5), DelayWatched(inner, most=5))


_SIGNALS = {"dead_time_cycles": "delay_cycles", "dead_time_confidence": "delay_confidence"}


def _estimate_memory(elements: tuple[str, ...], most: int) -> Layout:
    """Running means, past requests, weights, and the estimate with its confidence."""
    past = tuple(f"{e}@{k}" for k in range(most + 1) for e in elements)
    means = Signal("delay_mean_request", elements), Signal("delay_mean_response", elements)
    weights = Signal("delay_weights", tuple(f"w{k}" for k in range(most + 1)), kinds=(Kind.ADAPTED,))
    results = scalar("delay_cycles"), scalar("delay_confidence")
    return Layout((*means, Signal("delay_past", past), weights, *results))


def _estimated(
    request: Expression, response: Expression, memory: Mapping[str, Expression], most: int
) -> dict[str, Expression]:
    """Return the memory one cycle later, which includes 'delay_cycles' and 'delay_confidence'.

    With r~ and f~ the deviations of request and response from their running means, normalised least mean squares estimates the
    impulse response w of the loop, and the dead time is the place of the largest |w|:

        e = f~_k - sum_j w_j r~_{k-1-j},      w_j <- w_j + mu g e' r~_{k-1-j} / |r~|^2,      j = 0 .. most.

    A smooth request correlates with its own neighbours, so changes are not correlated. g = min(1, R / 0.1) is small while the
    requests are too smooth, R = sum |r~_k - r~_{k-1}|^2 / sum |r~_k|^2 (2 for white noise, omega^2 for a sine). The confidence is g
    times the share of sum w^2 that lies within one cycle of the peak.
    """
    size = request.numel()
    mean_request = memory["delay_mean_request"] + _MEAN * (request - memory["delay_mean_request"])
    mean_response = memory["delay_mean_response"] + _MEAN * (response - memory["delay_mean_response"])
    past = ca.vertcat(request - mean_request, memory["delay_past"])[: size * (most + 1)]
    columns = ca.reshape(past, size, most + 1)
    error = response - mean_response - ca.mtimes(columns, memory["delay_weights"])
    size_of_all = ca.sumsqr(past) + _FLOOR * ca.sumsqr(mean_request)
    energy = size_of_all + (size_of_all <= 0)  # requests of zero have no changes either
    roughness = ca.fmin(1, ca.sumsqr(past[size:] - past[: size * most]) / energy / _ROUGH)
    weights = memory["delay_weights"] + _STEP * roughness / energy * ca.mtimes(columns.T, error)
    cycles, near = _peak(weights, most)
    squares = ca.sumsqr(weights)
    clean = ca.if_else(squares > 0, near / ca.if_else(squares > 0, squares, 1), 0)
    return {
        "delay_mean_request": mean_request,
        "delay_mean_response": mean_response,
        "delay_past": past,
        "delay_weights": weights,
        "delay_cycles": cycles,
        "delay_confidence": roughness * clean,
    }


def _estimate_held(request: Expression, memory: Mapping[str, Expression]) -> dict[str, Expression]:
    """Return what changes in a cycle whose request was held and whose response is not known: the past requests."""
    past = ca.vertcat(request - memory["delay_mean_request"], memory["delay_past"])
    return {"delay_past": past[: memory["delay_past"].numel()]}


def _peak(weights: Expression, most: int) -> tuple[Expression, Expression]:
    """Place of the largest weight by size, and the sum of squares within one cycle of it."""
    sizes: list[Expression] = [w * w for w in ca.vertsplit(weights)]
    place, largest, near = 0 * sizes[0], sizes[0], total(sizes[:2])
    for k in range(1, most + 1):
        above = sizes[k] > largest
        place = ca.if_else(above, k, place)
        near = ca.if_else(above, total(sizes[k - 1 : k + 2]), near)
        largest = ca.fmax(sizes[k], largest)
    return place, near
