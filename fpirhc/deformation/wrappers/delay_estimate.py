"""The dead time between request and response, estimated on line from how changes of one appear in the other.

With r~ and f~ the deviations of request and response from their running means, normalised least mean squares estimates the
impulse response w of the loop,

    e = f~_k - sum_j w_j r~_{k-1-j},      w_j <- w_j + mu g e' r~_{k-1-j} / |r~|^2,      j = 0 .. most,

and the dead time is the place of the largest |w|. A least mean squares fit is used instead of the correlation of changes, because a
smooth request correlates with its own neighbours, and differences of a noisy response correlate with the request that this noise
caused. g = min(1, R / 0.1) is small while the requests are too smooth to distinguish one cycle from the next. R =
sum |r~_k - r~_{k-1}|^2 / sum |r~_k|^2 is their roughness (2 for white noise, omega^2 for a sine). The confidence is g times the
share of sum w^2 that lies within one cycle of the peak: near one for a clean delay.
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from fpirhc.symbolic.expression import total
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar

_MEAN = 0.05  # share of a new value in the running means
_STEP = 0.2  # mu
_ROUGH = 0.1  # R from which requests are rough enough to distinguish a cycle from the next
_FLOOR = 1e-12  # of |r~|^2 relative to the running mean's square
SIGNALS = {"dead_time_cycles": "delay_cycles", "dead_time_confidence": "delay_confidence"}


def estimate_memory(elements: tuple[str, ...], most: int) -> Layout:
    """Running means, past requests, weights, and the estimate with its confidence."""
    past = tuple(f"{e}@{k}" for k in range(most + 1) for e in elements)
    means = Signal("delay_mean_request", elements), Signal("delay_mean_response", elements)
    weights = Signal("delay_weights", tuple(f"w{k}" for k in range(most + 1)))
    results = scalar("delay_cycles"), scalar("delay_confidence")
    return Layout((*means, Signal("delay_past", past), weights, *results))


def estimated(
    request: Expression, response: Expression, memory: Mapping[str, Expression], most: int
) -> dict[str, Expression]:
    """Return the memory one cycle later, which includes 'delay_cycles' and 'delay_confidence'."""
    size = request.numel()
    mean_request = memory["delay_mean_request"] + _MEAN * (request - memory["delay_mean_request"])
    mean_response = memory["delay_mean_response"] + _MEAN * (response - memory["delay_mean_response"])
    past = ca.vertcat(request - mean_request, memory["delay_past"])[: size * (most + 1)]
    columns = ca.reshape(past, size, most + 1)
    error = response - mean_response - ca.mtimes(columns, memory["delay_weights"])
    energy = ca.sumsqr(past) + _FLOOR * (1 + ca.sumsqr(mean_request))
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


def estimate_held(request: Expression, memory: Mapping[str, Expression]) -> dict[str, Expression]:
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
