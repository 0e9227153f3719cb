"""Laws that every observer keeps, tried on evidence of a plant that is simulated beside it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from fpirhc.conformance.laws import Array, Broken, Draw, keep, two_masses, within
from fpirhc.controllers.believed import observed_model
from fpirhc.plant.motion import with_exact_parameters
from fpirhc.sensing.base import Evidence, Measured, Model, StateObserver, unobservable, values_of
from fpirhc.sensing.sensing import Sensing
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.task.problem import Problem

_SAME = 1e-9  # of the largest state
_OTHER = 1.01  # factor of exact parameters
_UNSEEN = 1e-6  # part of a direction that counts as none
_LONG, _WRONG = 400, 0.1  # samples, and first error beside the largest state
_LEFT, _OVERSHOOT = 0.25, 3.0  # shares of that error: later, and at any time


def check_observer(observer: StateObserver, *, seed: int, problem: Problem | None = None) -> None:
    """Check every law on an observer.

    Args:
        problem: whose states are believed, with `Sensing(measured=...)`; its response must be linear in states and inputs.
            None: two masses whose positions a and b are measured.
    """
    task, sensing = problem or two_masses(), Sensing({}, Measured(), measured=["a", "b"])
    sensing = sensing if problem is None else problem.sensing
    believed = Sensing(sensing.sensors, sensing.estimator, measured=sensing.measured, observer=observer)
    keep(_Trial(observer, replace(task, sensing=believed)), seed)


@dataclass(frozen=True, eq=False)
class _Trial:
    """An observer on a problem, as (sample, memory) -> (estimated state, memory)."""

    observer: StateObserver
    problem: Problem

    @cached_property
    def model(self) -> Model:
        """What the observer is built from."""
        return observed_model(self.problem)

    def step(self, measured: Array, command: Array, memory: Array | None = None, **given: Any) -> tuple[Array, Array]:
        """Estimated state and next memory, from the start where no memory is given; `given`: parameters, moves, counts."""
        before = self.observer.memory(self.model).start() if memory is None else memory
        known: dict[str, Any] = {"parameters": self.problem.plant.approximate, "moves": 1.0, "counts": 1.0} | given
        numbers = self.evaluator(measured, command, *known.values(), before)
        return numbers[0].copy(), numbers[1].copy()

    def sample(self, draw: Draw) -> dict[str, Array]:
        """What is measured, near the start, and a command."""
        start, inputs = self.problem.start_state, self.problem.plant.input.size
        state = start + 0.1 * draw.normal(size=start.size)
        return {"measured": self.seen(state, np.zeros(inputs)) + 0.1, "command": draw.normal(size=inputs)}

    def errors(self, places: list[int], size: float) -> Array:
        """Largest error of these states after every sample of a free motion that starts off by `size`; the model is exact."""
        plant, calm = self.problem.plant, np.zeros(len(self.problem.plant.names))
        state, memory, command, errors = self.problem.start_state.copy(), None, np.zeros(plant.input.size), [size]
        state[places] += size
        for k in range(_LONG):
            if k:
                state = np.asarray(self.model.move(state, command, plant.exact, calm, 1.0).full())[:, 0]
            seen, exact = self.seen(state, command), dict[str, Any](parameters=plant.exact, moves=float(k > 0))
            estimated, memory = self.step(seen, command, memory, **exact)
            errors.append(float(np.abs((estimated - state)[places]).max()))
        return np.array(errors)

    def seen(self, state: Array, command: Array) -> Array:
        """What the sensors show."""
        return np.asarray(self.shown(state, command, self.problem.plant.exact).full())[:, 0]

    @cached_property
    def shown(self) -> ca.Function:
        x, u, p = self.problem.plant.symbols()
        values = values_of(self.problem.plant, x, u, p)
        return ca.Function("shown", [x, u, p], [ca.vertcat(*(values[n] for n in self.model.measured))])

    @cached_property
    def evaluator(self) -> Evaluator:
        plant, layout = self.problem.plant, self.observer.memory(self.model)
        sizes = (len(self.model.measured), plant.input.size, plant.approximate.size, 1, 1, layout.size)
        symbols = [ca.SX.sym(f"s{k}", size) for k, size in enumerate(sizes)]
        measured, *rest, memory = symbols
        shown: dict[str, Any] = dict(zip(self.model.measured, ca.vertsplit(measured), strict=True))
        evidence, remembered = Evidence(shown, *rest), layout.split(memory)
        predicted = self.observer.predict(self.model)(evidence, remembered)
        estimated, after = self.observer.correct(self.model)(evidence, remembered, predicted)
        return Evaluator(ca.Function("estimated", symbols, [ca.densify(estimated), ca.densify(layout.join(after))]))


def exact_parameters_are_unknown(trial: _Trial, draw: Draw) -> Broken:
    """Prediction and correction do not depend on the exact parameters, which nobody knows of a real plant."""
    plant = trial.problem.plant
    problem = replace(trial.problem, plant=with_exact_parameters(plant, _OTHER * plant.exact))
    sample = trial.sample(draw)
    answers = (one.step(**sample) for one in (trial, replace(trial, problem=problem)))
    if not all(np.array_equal(a, b, equal_nan=True) for a, b in zip(*answers, strict=True)):
        yield f"with exact parameters {_OTHER - 1:.0%} larger, and equal evidence, the estimate differs; use evidence.parameters"


def old_samples_do_nothing(trial: _Trial, draw: Draw) -> Broken:
    """A sample from before the run, which a dead time shows again, corrects (`counts` = 0) and moves (`moves` = 0) nothing."""
    cures = ("counts", "measured", "select with if_else"), ("moves", "command", "move by evidence.moves")
    for fact, what, cure in cures:
        sample, old = trial.sample(draw), dict[str, Any]({fact: 0.0})
        other = sample | {what: sample[what] + 1.0}
        change = float(np.abs(trial.step(**sample, **old)[0] - trial.step(**other, **old)[0]).max())
        if change != 0:
            yield f"with {fact} = 0 a {what} that is larger by 1 changes the estimated state by {change:.3g}; {cure}"


def right_model_believes_what_is(trial: _Trial, draw: Draw) -> Broken:
    """With the exact model, the right start and no noise the believed state is the plant's."""
    error = float(trial.errors(list(range(trial.problem.plant.state.size)), 0.0).max())
    if not within(error, _SAME * (1 + np.abs(trial.problem.start_state).max())):
        yield f"the estimated state is off by {error:.3g}, although model and start are right"


def wrong_start_is_corrected(trial: _Trial, draw: Draw) -> Broken:
    """Started wrong in what is measured, with the exact model and no noise, it comes to believe what is measured."""
    plant, measured = trial.problem.plant, trial.problem.sensing.measures(trial.problem.plant)
    used = trial.observer.uses(measured)
    if not {*used} <= {*measured}:
        yield f"it uses {used}, and the sensors show {measured}"
    places = [plant.state.elements.index(n) for n in used if n in plant.state.elements]
    every = np.eye(plant.state.size)
    free = unobservable([every], [every[places]]) if places else np.zeros((0, 0))
    seen = [k for k in places if not free.size or np.abs(free[k]).max() < _UNSEEN]
    if not seen:
        return  # it corrects nothing that is measured, and says so
    size = _WRONG * (1 + float(np.abs(trial.problem.start_state).max()))
    errors = trial.errors(seen, size)
    most, late = float(errors.max()), float(errors[_LONG // 2 :].max())
    if not (within(most, _OVERSHOOT * size) and within(late, _LEFT * size)):
        yield (
            f"started wrong by {size:.3g} in what is measured it is wrong by up to {most:.3g} in {_LONG} samples "
            f"without noise, and by {late:.3g} in the later half: it does not converge; look at its gains and its memory"
        )
