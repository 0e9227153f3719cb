"""A mass whose model is too heavy, and the answers of its review by question."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any

import casadi as ca
import numpy as np

import fpirhc as fp
from fpirhc.controllers.contract import resolved
from fpirhc.review import (
    chatter,
    commands,
    convergence,
    discretisation,
    gain,
    horizon,
    margins,
    null_test,
    pays,
    questions,
    rates,
    review,
    slew,
    speed,
    two_cycles,
    well_posed,
    zero_dynamics,
)
from fpirhc.review.gain_advice import gain_advice
from fpirhc.review.grid import review_grid
from fpirhc.review.loops import loops_along
from fpirhc.review.maps import largest_product
from fpirhc.review.neighbourhood import spectrum_near
from fpirhc.review.nominal_runs import NominalRuns
from fpirhc.review.planned import is_planned
from fpirhc.review.question import Case, ProblemQuestion
from fpirhc.simulation.linearise.linear_loop import LinearCycle, LinearLoop

PERIOD = 1e-3  # s


def mass(**settings) -> fp.Problem:
    """M q'' = u - k q, the model's mass 1.5 times too large."""
    plant = fp.Plant(
        coordinates={"q": "m"},
        inputs={"u": "N"},
        parameters={"m": fp.Parameter(1.5, 1.0, "kg"), "k": fp.Parameter(6.0, 10.0, "N/m")},
        response=lambda q, v, u, p: {"q": (u.u - p.k * q.q) / p.m},
    )
    settings_in_use: dict[str, Any] = {
        "reference": fp.Trajectory(lambda t: {"q": 0.5 * ca.sin(3 * t)}),
        "start": {"q": 0.0},
        "period": PERIOD,
        "duration": 4.0,
    }
    return fp.Problem(**({"plant": plant} | settings_in_use | settings))


def torque(gain: float = -0.5, rate: float = 6.0, scale: float = 20.0) -> fp.ComputedTorque:
    return fp.ComputedTorque(fp.Exponential(rate=rate), fp.Sigmoid(gain=gain, scale=scale))


def answers(problem: fp.Problem, controller=None, mismatch: float = 0.0) -> dict[str, fp.Answer]:
    """All answers by question."""
    controllers = {"it": torque() if controller is None else controller}
    return {a.question: a for a in fp.review(problem, controllers, mismatch=mismatch, seed=0).answers}


def about(result: dict[str, fp.Answer], words: str) -> fp.Answer:
    [question] = [q for q in result if words in q]
    return result[question]


class _Later:
    """A value that is built when its first attribute is read."""

    def __init__(self, build: Callable[[], Any]) -> None:
        self._build = cache(build)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._build(), name)


def case(problem: fp.Problem, controller: Any, mismatch: float = 0.0) -> Case:
    """What one question of a review is asked with; the linear loops are built if it reads them."""
    grid = review_grid(problem, mismatch, 0)
    ready = resolved(grid.problem, controller)
    loops: Any = _Later(lambda: loops_along(grid, ready))
    return Case(grid, ready, loops, NominalRuns(grid.problem))


def answer(problem: fp.Problem, controller: Any, words: str, mismatch: float = 0.0) -> Any:
    """The answer to the question with these words, the others not asked; None where it is not asked of the controller."""
    every = {**OF_PROBLEMS, **OF_CONTROLLERS}
    [text] = [text for text in every if words in text]
    subject: Any = review_grid(problem, mismatch, 0) if text in OF_PROBLEMS else case(problem, controller, mismatch)
    return next((one for one in (ask(subject) for ask in every[text]) if one is not None), None)


def _own(one: Case) -> Any:
    return spectrum_near(one.grid, one.believed, one.grid.draws[:1], near=False)


def _admissible(one: Case) -> fp.Answer:
    deformation, own = one.controller.deformation, _own(one)
    boxed = spectrum_near(one.grid, one.believed, one.grid.draws, near=False)
    limit = largest_product(one.problem, deformation, own.eigenvalues)
    advice = gain_advice(one, boxed, null_test.leaves_right_model_alone(one))
    return gain.gain_admissible(deformation, own, boxed, limit, advice)


def _ideal(one: Case) -> Any:
    return one.loops.ideal if is_planned(one.controller) else None


def _adaptive(ask: Callable[[Case], Any], of_targets: bool = False) -> Callable[[Case], Any]:
    """The question where there is a deformation that it is about."""

    def asked(one: Case) -> Any:
        adapts = one.controller.deformation.adapts and (of_targets or one.controller.deforms != "target")
        return ask(one) if adapts else None

    return asked


OF_PROBLEMS: dict[str, list[Callable[[Any], Any]]] = {
    well_posed.QUESTION: [well_posed.well_posed],
    commands.QUESTION: [commands.commands_inside],
    discretisation.QUESTION: [discretisation.discretisation_follows],
    horizon.QUESTION: [horizon.horizon_long_enough],
}
OF_CONTROLLERS: dict[str, list[Callable[[Case], Any]]] = {
    convergence.QUESTION: [lambda one: review.predict(one.grid.real or one.problem, one.controller)],
    margins.QUESTION: [review._margins],
    rates.QUESTION: [review._rates],
    zero_dynamics.QUESTION: [review._zero_dynamics],
    null_test.QUESTION_TEXT: [_adaptive(null_test.leaves_right_model_alone, of_targets=True)],
    pays.QUESTION: [_adaptive(pays.pays)],
    two_cycles.QUESTION: [_adaptive(two_cycles.free_of_two_cycles)],
    gain.QUESTION: [_adaptive(_admissible)],
    speed.FAST: [_adaptive(lambda one: speed.fast_enough(one, _own(one)))],
    speed.LAG: [_adaptive(lambda one: speed.bears_lag(one.grid, one.controller, _own(one)))],
    slew.QUESTION: [
        _adaptive(lambda one: slew.slew_enough(one.grid, one.controller.deformation, one.believed, _ideal(one)))
    ],
    slew.RANGE: [_adaptive(lambda one: slew.range_enough(one.grid, one.controller.deformation, one.believed))],
    chatter.QUESTION: [_adaptive(lambda one: chatter.chatter_small(one.grid, one.controller))],
}
for _module in [import_module(f"{questions.__name__}.{m.name}") for m in pkgutil.iter_modules(questions.__path__)]:
    _text, _question = getattr(_module, "TEXT", getattr(_module, "FAST", "")), _module.QUESTION
    if isinstance(_question, ProblemQuestion):
        OF_PROBLEMS.setdefault(_text, []).append(_question.ask)
    else:
        _ask = _adaptive(_question.ask, _question.of_targets) if _question.adaptive else _question.ask
        OF_CONTROLLERS.setdefault(_text, []).append(_ask)


def linear(dynamics: Any, entry: Any, arriving: Any, state: Any, period: float) -> LinearLoop:
    """A linear loop of one cycle by its matrices, with the numbers of the plant's states among its entries; every mode counts."""
    shown = np.eye(len(dynamics))[list(state)]
    cycle = LinearCycle(np.asarray(dynamics), np.asarray(entry), np.asarray(arriving), shown)
    return LinearLoop((cycle,), np.zeros((0, len(dynamics))), shown.T, period)
