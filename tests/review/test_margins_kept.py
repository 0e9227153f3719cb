"""Whether a loop keeps its margins is answered without their sizes, and the answers agree."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from fpirhc.review.questions.margins import (
    _DECADES,
    _STEPS,
    LEAST_GAIN,
    LEAST_PHASE,
    _first,
    _turning,
    keeps_margins,
    margins,
)
from fpirhc.simulation.linearise.linear_loop import LinearCycle, LinearLoop


def loop(seed: int, cycles: int) -> LinearLoop:
    """A random loop that converges: two states of the plant, four of the controller, one input."""
    random = np.random.default_rng(seed)
    parts = [
        LinearCycle(random.normal(size=(6, 6)), random.normal(size=(6, 1)), random.normal(size=(1, 6)), np.eye(2, 6))
        for _ in range(cycles)
    ]
    whole = LinearLoop(tuple(parts), np.eye(6), np.eye(6, 2), 0.1)
    share = random.uniform(0.3, 0.95) / whole.radius
    parts = [
        LinearCycle(share * one.dynamics, share * one.entry, random.uniform(0.02, 3.0) * one.arriving, one.state)
        for one in parts
    ]
    return LinearLoop(tuple(parts), np.eye(6), np.eye(6, 2), 0.1)


@pytest.mark.parametrize("cycles", [1, 3])
def test_the_short_answer_is_that_of_the_sizes(cycles):
    answers = set()
    for seed in range(60):
        one = loop(seed, cycles)
        assert one.radius < 1
        gain, phase, _ = margins(one, 0)
        answers.add(keeps_margins(one, 0))
        assert keeps_margins(one, 0) == (gain >= LEAST_GAIN and phase >= LEAST_PHASE), seed
    assert answers == {True, False}  # the loops are of both kinds


@pytest.mark.parametrize("factor", [1.0, 0.3, 2.5, np.exp(-0.7j)])
def test_a_multiplied_command_has_the_poles_of_the_product_of_its_cycles(factor):
    one = loop(4, 3)
    product = np.eye(6)
    for part in one.cycles:
        product = (part.dynamics + (factor - 1) * part.entry @ part.arriving) @ product
    [poles] = _turning(one, 0)(np.array([factor]))
    np.testing.assert_allclose(np.poly(poles), np.poly(np.linalg.eigvals(product)), rtol=1e-9, atol=1e-12)


def test_margins_are_sought_no_farther_than_to_the_first_pole_outside(monkeypatch):
    """A loop that leaves the unit circle at a small factor has the poles of few factors computed."""
    sizes, original = [], np.linalg.eigvals

    def counted(matrices):
        sizes.append(len(matrices) if np.ndim(matrices) == 3 else 1)
        return original(matrices)

    monkeypatch.setattr(np.linalg, "eigvals", counted)
    one = next(loop(seed, 3) for seed in range(60) if margins(loop(seed, 3), 0)[0] < 1.1)
    sizes.clear()
    assert not keeps_margins(one, 0)
    assert sum(sizes) <= 3  # its own poles, those of no change and of the first step


def test_a_smaller_command_is_tried_no_farther_than_a_larger_one_and_the_margin_is_the_smaller_of_both():
    """Whichever way the margin is, it is that of two whole searches."""
    ways = set()
    for seed in range(30):
        one = loop(seed, 3)
        poles = _turning(one, 0)
        up, (down, _) = _first(partial(scaled, poles, 1), _DECADES), searched(poles, np.inf)
        shorter, farthest = searched(poles, up)
        assert min(up, down) == min(up, shorter)
        assert margins(one, 0)[0] == pytest.approx(
            np.exp(min(up, down)), rel=1e-15
        )  # two libraries' exp differ by a bit
        assert farthest <= min(up, _DECADES) + _DECADES / _STEPS
        ways.add(up < down)
    assert ways == {True, False}


def test_a_pole_that_leaves_just_before_the_end_of_a_search_is_found():
    assert _first(lambda x: x[:, None] / 2.02, 3.0, 2.03) == pytest.approx(2.02)


def scaled(poles, sign, x):
    """The poles with a command that is multiplied by exp(sign x)."""
    return poles(np.exp(sign * x))


def searched(poles, enough):
    """The logarithm of the factor downwards, and the largest one that was tried."""
    tried = [0.0]

    def noted(x):
        tried.extend(x)
        return scaled(poles, -1, x)

    return _first(noted, _DECADES, enough), max(tried)
