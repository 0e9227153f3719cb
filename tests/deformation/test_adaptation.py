"""Tuning and guarding of a deformation on line: the gain finds its place, and a loop that left its basin comes back."""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.errors import InvalidValue
from fpirhc.symbolic.evaluate import Evaluator


@cache
def stepping(deformation, size=1):
    """Function (request, response, desired, memory) -> (request, memory) and the memory's layout."""
    layout = deformation.memory(tuple(f"q{k}" for k in range(size)))
    symbols = [ca.SX.sym(n, size) for n in ("r", "f", "d")] + [ca.SX.sym("m", layout.size)]
    request, next_memory = deformation.step(*symbols[:3], layout.split(symbols[3]))
    return ca.Function("step", symbols, [ca.densify(request), ca.densify(layout.join(next_memory))]), layout


class Scalar:
    """A map of one coordinate with its memory, through buffers: thousands of cycles take no time."""

    def __init__(self, deformation):
        function, self.layout = stepping(deformation)
        self._step = Evaluator(function)
        self._step.arguments[3][:] = self.layout.start()

    def __call__(self, *values):
        """The next request, from request, response and desired response."""
        for argument, value in zip(self._step.arguments, values, strict=False):
            argument[0] = value
        self._step.evaluate()
        self._step.arguments[3][:] = self._step.results[1]
        return float(self._step.results[0][0])

    @property
    def memory(self):
        return self._step.results[1].copy()


def run(deformation, plant, desired, noise=None):
    """Requests, true response errors and memories of the scalar loop f = plant(k, r)."""
    step, request = Scalar(deformation), float(desired[0])
    errors, requests, memories = [], [], []
    for k in range(1, len(desired)):
        response = plant(k, request)
        errors.append(response - desired[k])
        request = step(request, response + (noise[k] if noise is not None else 0.0), desired[k])
        requests.append(request)
        memories.append(step.memory)
    return np.array(requests), np.array(errors), np.array(memories), step.layout


CYCLES = 4500
SMOOTH = np.sin(0.01 * np.arange(CYCLES))


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_tuner_follows_a_plant_whose_gain_jumps(noise):
    """1.2 -> 15 -> 0.3: the rms response error stays below 0.14 in each regime; a fixed gain cycles in the second."""
    gains = np.repeat([1.2, 15.0, 0.3], CYCLES // 3)
    white = noise * np.random.default_rng(0).standard_normal(CYCLES)
    sigmoid = fp.Sigmoid(gain=-0.5, scale=10.0)
    tuned = fp.Tuned(sigmoid, largest_gain=1.69 * sigmoid.slope)
    results = {}
    for deformation in (sigmoid, tuned):
        _, errors, _, _ = run(deformation, lambda k, r: gains[k] * r, SMOOTH, white)
        results[deformation] = [np.sqrt(np.mean(part[500:] ** 2)) for part in np.split(errors[: CYCLES - 3], 3)]
    assert max(results[tuned]) < 0.14
    assert results[sigmoid][1] > 10


def test_tuner_never_exceeds_its_cap():
    """Where the plant answers weakly, the factor ends at the cap and not beyond."""
    tuned = fp.Tuned(fp.Affine(gain=-0.5), largest_gain=0.8)
    _, _, memories, layout = run(tuned, lambda k, r: 0.05 * r, SMOOTH)
    factor = memories[:, layout.slice("tuner_factor")].ravel()
    assert factor.max() == pytest.approx(0.8 / 0.25)


def test_tuner_recovers_from_a_number_that_is_none():
    step, layout = stepping(fp.Tuned(fp.Affine(gain=-0.5), largest_gain=0.8))
    memory = layout.start()
    for response in (1.0, np.nan, 1.0, 1.0, 1.0):
        _, memory = step(0.0, response, 0.5, memory)
    assert np.isfinite(memory.full()).all()


@pytest.mark.parametrize("largest", [0.1, -1.0, float("inf"), float("nan")])
def test_tuner_needs_a_bound(largest):
    """A tuner without a bound is refused, and told where one comes from."""
    with pytest.raises(InvalidValue, match=r"sector_limit gives one|expected a number, got nan"):
        fp.Tuned(fp.Affine(gain=-0.5), largest_gain=largest)
