"""Whether an iteration converges whose response is late, smoothed or estimated: asked of the Jacobian of the map's own step.

The map runs on the responses to its own requests, f_k = sum_j w_j J r_{k-j}, about zero; it converges where the spectral radius of
what it carries from cycle to cycle is below one. A loop is refused by the Jacobian at its start, before a run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import casadi as ca
import numpy as np

from fpirhc.contraction.spectrum import MEND, Array, jacobians_along, linear_limit
from fpirhc.deformation.base import Deformation, against_wrappers, own_gain, with_its_gain
from fpirhc.deformation.delayed import Paired
from fpirhc.errors import NotContractive
from fpirhc.summary import number, written_out
from fpirhc.symbolic.evaluate import Latest
from fpirhc.task.dead_time import Queue
from fpirhc.task.problem import Problem

_SETTLED = 5000  # cycles in which a memory comes to rest at most
_RANGE = 1e-3, 20.0  # of the gain times the largest eigenvalue that is searched
_STEPS, _HALVINGS = 60, 25
_SHARES = 0.15, 0.3, 0.45, 0.6, 0.75, 0.9  # of a gain that converge too
_SPARE, _SPARE_OF_TWO_POLES = 1.25, 1.5
_NOTHING = 1e-12  # gain, or largest eigenvalue of a Jacobian, that has no effect
_JACOBIANS: Latest[Array] = Latest(8)  # a search checks many gains at the same start


def delayed(weights: Array, cycles: float) -> Array:
    """Return the weights of past requests after a dead time."""
    return np.convolve(weights, Queue(cycles).weights)


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


def largest_behind_estimator(problem: Problem, deformation: Deformation) -> float:
    """Return the effective gain from which on a run is refused behind an estimator; infinite where none spreads the response."""
    jacobian = _JACOBIANS.of((problem,), (), lambda: _jacobian_at_start(problem.of_equations))
    seen, acts = _weights_of_estimators(problem), np.isfinite(jacobian).all() and np.abs(jacobian).max() > _NOTHING
    return (largest_gain(deformation, jacobian, seen) if seen and acts and deformation.form.steady else 0.0) or math.inf


def require_converging(problem: Problem, deformation: Deformation) -> None:
    """Raise if the deformation cannot converge from the start of the problem: no gain does, or not one of this sign or size.

    The limit of the size is that of the plant itself, or behind the delay of estimator and filter. The dead time of the problem is
    added where all inputs have the same; without an estimator it is not judged. A map that changes its gain on line begins where
    it likes. With a reality the response is that at the end of a cycle; nothing is judged where the command has not reached it.
    """
    gain = deformation.effective_gain()
    if abs(gain) <= _NOTHING:
        return
    jacobian = _JACOBIANS.of((problem,), (), lambda: _jacobian_at_start(problem.of_equations))
    weighted = deformation.form.weighted(jacobian)
    if not np.isfinite(jacobian).all() or np.abs(np.linalg.eigvals(weighted)).max() <= _NOTHING:
        return
    eigenvalues, steady = np.linalg.eigvals(weighted), deformation.form.steady
    limit, seen = sum(linear_limit(eigenvalues)), _weights_of_estimators(problem)
    weights, wrong = seen or [delayed(np.ones(1), deformation.form.late)] * len(jacobian), limit * gain <= 0
    if not wrong and (
        not steady or (seen is None and abs(gain) < abs(limit)) or converges(deformation, jacobian, weights)
    ):
        return
    what, (name, value), delay = with_its_gain(deformation), own_gain(deformation), problem.response_delay
    pairs = not any(against_wrappers(Paired(deformation, cycles=1.0)))  # whether it may be paired
    remembers = deformation.memory(problem.plant.controlled_names).size > 0
    right = deformation.with_effective_gain(-gain) if wrong else deformation
    judged = steady and (seen is not None or (remembers and not wrong))
    largest = largest_gain(right, jacobian, weights) if judged else abs(limit)
    interval = f"0 < |{name}| < {written_out(abs((largest or limit) / gain * value))}"
    # A window does not see requests that alternate; a fraction of a cycle in the pairing damps them.
    paired = (Paired(deformation, cycles=d) for d in (delay, delay + 0.5, delay - 0.5) if d >= 0 and pairs)
    usable = (one for one in paired if converges(one, jacobian, weights))
    if wrong:
        turned = [n for n, one in problem.plant.parameters.items() if one.approximate * one.exact < 0]
        why = f"{' and '.join(turned)} of the plant and of the model differ in sign: every cycle enlarges the error of {what}"
        why = why if turned else f"{what} has the wrong sign, so every cycle enlarges the error"
        remedy = "give the model the plant's sign, because a plan with the other one goes the wrong way"
        opposite = f"use a {'negative' if value > 0 else 'positive'} {name}, {interval}"
        remedy = remedy if turned else MEND if gain > 0 else opposite
        raise NotContractive(why, remedy, turned)
    if seen is None:
        top = max(eigenvalues, key=abs)
        raise NotContractive(
            f"{what} is too large",
            f"use {interval}, where the iteration alone converges: the input gain of the plant, over that of the model, is up to "
            f"{top.real if top.imag == 0 else top:.3g} at the start",
        )
    estimator, of_estimator = problem.sensing.estimator, problem.sensing.delay(problem.plant, problem.period)
    apart = f"dead time {number(delay - of_estimator)}, {estimator} {number(of_estimator)}"
    remedies = [*([interval] if largest else []), *[f"Paired(map, cycles={one.cycles:.4g})" for one in usable][:1]]
    # These remedies stay beside an advice on the gain, because all but the first change something else.
    raise NotContractive(
        f"{what}: the response comes {delay:.4g} cycles late ({estimator if delay == of_estimator else apart}), so the iteration "
        f"alone does not converge with this {name}; it does with: {', '.join([*remedies, 'a shorter window or time constant'])}"
    )


def _jacobian_at_start(problem: Problem) -> Array:
    plant, exact = problem.plant, problem.real_plant.exact[None, :]
    real, state = problem.real_start[None, :], problem.start_state[None, :]
    response = plant.equations.controlled_response(problem.start_state, problem.inputs_before, plant.approximate)
    return jacobians_along(problem, real, state, response.full().T, plant.approximate, exact)[0]


def _weights_of_estimators(problem: Problem) -> list[Array] | None:
    """Weights of past requests in every estimated response, dead time included; None where no estimator spreads them."""
    orders = problem.plant.response_orders.values()
    weights = [problem.sensing.estimator.weights(order, problem.period) for order in orders]
    dead_times = {problem.dead_time.inputs.get(name, 0.0) for name in problem.plant.inputs}
    if all(w.size == 1 for w in weights) or len(dead_times) > 1:
        return None
    dead_time = (dead_times.pop() + problem.dead_time.measurement) / problem.period
    return [delayed(w, dead_time) for w in weights]
