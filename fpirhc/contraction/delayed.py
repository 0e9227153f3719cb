"""Whether an iteration converges whose response is late, smoothed or estimated: asked of the Jacobian of the map's own step.

The map runs on the responses to its own requests, f_k = sum_j w_j J r_{k-j}, about zero; it converges where the spectral radius of
what it carries from cycle to cycle is below one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import casadi as ca
import numpy as np

from fpirhc.contraction.spectrum import Array
from fpirhc.deformation.base import Deformation

_SETTLED = 5000  # cycles in which a memory comes to rest at most
_RANGE = 1e-3, 20.0  # of the gain times the largest eigenvalue that is searched
_STEPS, _HALVINGS = 60, 25
_SHARES = 0.15, 0.3, 0.45, 0.6, 0.75, 0.9  # of a gain that converge too
_SPARE, _SPARE_OF_TWO_POLES = 1.25, 1.5


def delayed(weights: Array, cycles: float) -> Array:
    """Return the weights of past requests after a dead time; a fraction of a cycle interpolates, as queues do."""
    whole = math.floor(cycles + 1e-9)
    share = max(cycles - whole, 0.0)
    return np.convolve(weights, np.append(np.zeros(whole), [1 - share, share] if share else [1.0]))


def radius(deformation: Deformation, jacobian: Array, weights: Sequence[Array]) -> float:
    """Return by which factor an error is multiplied per cycle in the long run, to first order.

    Args:
        deformation: the map, with its scale.
        jacobian: J of the response, shape (n, n).
        weights: w_1, w_2, ... of past requests in every response, dead time included; so late a model's response is too.
    """
    size, longest = len(jacobian), max(map(len, weights))
    seen = np.hstack([np.diag([w[j] if j < len(w) else 0.0 for w in weights]) for j in range(longest)])
    given = seen if deformation.form.modelled else np.eye(size, size * longest)
    on_request, on_response, on_memory = np.split(_slopes(deformation, size), [size, 2 * size], axis=1)
    now = on_request @ given + on_response @ seen @ np.kron(np.eye(longest), jacobian)
    kept = np.eye(size * (longest - 1), size * longest)
    moves = np.vstack(
        [
            np.hstack([now[:size], on_memory[:size]]),
            np.hstack([kept, np.zeros((len(kept), on_memory.shape[1]))]),
            np.hstack([now[size:], on_memory[size:]]),
        ]
    )
    acts = _acting(moves != 0, size)
    return float(np.abs(np.linalg.eigvals(moves[np.ix_(acts, acts)])).max())


def _slopes(deformation: Deformation, size: int) -> Array:
    """Slopes of (next request, next memory) by (request, response, memory) at rest, shape (n + m, 2 n + m)."""
    layout = deformation.memory(tuple(f"q{k}" for k in range(size)))
    z, desired = ca.SX.sym("z", 2 * size + layout.size), ca.SX.zeros(size)
    request, later = deformation.step(z[:size], z[size : 2 * size], desired, layout.split(z[2 * size :]))
    after = ca.densify(ca.vertcat(request, layout.join(later)))
    step, at = ca.Function("step", [z], [after]), np.zeros(z.numel())
    at[2 * size :] = layout.start()
    for _ in range(_SETTLED):
        memory = step(at).full()[size:, 0]
        if np.array_equal(memory, at[2 * size :]):
            break
        at[2 * size :] = memory
    return np.asarray(ca.Function("slopes", [z], [ca.densify(ca.jacobian(after, z))])(at).full())


def _acting(pattern: Array, size: int) -> Array:
    """Which entries act on the first ones, however many cycles later: a count of cycles does not."""
    found = np.arange(len(pattern)) < size
    while (more := found | pattern[found].any(axis=0)).sum() > found.sum():
        found = more
    return found


def converges(deformation: Deformation, jacobian: Array, weights: Sequence[Array]) -> bool:
    """Return whether its gain and smaller ones converge: a gain that does where half of it does not has no reserve."""
    gain = deformation.effective_gain()
    tried = (deformation.with_effective_gain(share * gain) for share in _SHARES)
    return radius(deformation, jacobian, weights) < 1 and all(radius(one, jacobian, weights) < 1 for one in tried)


def largest_gain(deformation: Deformation, jacobian: Array, weights: Sequence[Array]) -> float:
    """Return the effective gain, of the map's own sign, up to which every gain converges; 0 when none does.

    It is at most 20 over the largest eigenvalue. Arguments as in `radius`.
    """
    sign = math.copysign(1.0, deformation.effective_gain())

    def diverges(gain: float) -> bool:
        return radius(deformation.with_effective_gain(sign * gain), jacobian, weights) >= 1

    gains = np.geomspace(*_RANGE, _STEPS) / np.abs(np.linalg.eigvals(jacobian)).max()
    wrong = next((k for k, gain in enumerate(gains) if diverges(float(gain))), None)
    if wrong is None:
        return float(gains[-1])
    low, high = (float(gains[wrong - 1]) if wrong else 0.0), float(gains[wrong])
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if diverges(middle) else (middle, high)
    return low if wrong else 0.0


def step_for_basin(largest_error: float, poles: int, rate: float, period: float) -> float:
    """Return the step per cycle that a map needs to come back from an error of that size, with its spare factor.

    The plain form is stable around a tracking law with N poles at -Lambda, to first order in Lambda T, where
    a lambda / (T Lambda) > sin(theta)^N tan(theta), theta = (N - 1) pi / (2 N): 0, 1/2, 9/8, 1.759, 2.395 for N = 1 ... 5.

    Args:
        largest_error: |f - d|, in units of the response.
        poles: N of the tracking law: n + 1 for relative order n with the integral, n without it.
        rate: Lambda of the tracking law, 1/s.
        period: T of the control cycle, s.
    """
    angle = (poles - 1) * math.pi / (2 * poles)
    spare = _SPARE_OF_TWO_POLES if poles == 2 else _SPARE
    return spare * math.sin(angle) ** poles * math.tan(angle) * rate * period * largest_error
