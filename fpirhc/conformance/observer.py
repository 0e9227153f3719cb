"""Laws that every observer keeps, tried in short closed loops."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from fpirhc.conformance.laws import frozen_value, hold, keep, within
from fpirhc.conformance.loops import two_masses
from fpirhc.controllers.computed_torque import ComputedTorque
from fpirhc.controllers.contract import Controller
from fpirhc.controllers.path import observed_model
from fpirhc.controllers.wrappers.exact_model import ExactModel
from fpirhc.plant.motion import with_exact_parameters
from fpirhc.sensing.base import Evidence, Measured, Model, StateObserver, unobservable, values_of
from fpirhc.sensing.sensing import Sensing
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import simulate
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.symbolic.layout import Layout
from fpirhc.task.problem import Problem
from fpirhc.tracking.linear_law import Exponential

Array = npt.NDArray[Any]

_CYCLES = 20
_SAME = 1e-9  # of the largest state
_OTHER = 1.01  # factor of exact parameters
_UNSEEN = 1e-6  # part of a direction that counts as none
_LONG, _WRONG = 400, 0.1  # samples, and first error beside the largest state
_LEFT, _OVERSHOOT = 0.25, 3.0  # shares of that error: later, and at any time


def check_observer(
    observer: StateObserver, *, seed: int, problem: Problem | None = None, controller: Controller | None = None
) -> None:
    """Check every law on an observer.

    Args:
        observer: the observer.
        seed: of noise and of all draws.
        problem: whose states are believed, with `Sensing(measured=...)`; its response must be linear in states and inputs.
            None: two masses whose positions a and b are measured.
        controller: of the problem; None: computed torque with the rate 4.

    Raises:
        AssertionError: the first law that does not hold, in one sentence.
        FpirhcError: the observer cannot serve the problem.
    """
    task = two_masses() if problem is None else problem
    sensing = Sensing({}, Measured(), measured=["a", "b"]) if problem is None else task.sensing
    believed = Sensing(sensing.sensors, sensing.estimator, measured=sensing.measured, observer=observer)
    short = replace(task, duration=_CYCLES * task.period, measure_from=0.0, sensing=believed)
    keep(observer, _Trial(observer, short, controller or ComputedTorque(Exponential(rate=4.0)), seed), LAWS, seed)


@dataclass(frozen=True, eq=False)
class Sample:
    """Numbers of a cycle's evidence."""

    measured: Array  # what the sensors show, in the order of the model's names
    command: Array  # that acted
    moves: float = 1.0  # 1, or 0 where the sample still shows the start
    counts: float = 1.0  # 1, or 0 for a sample from before the run


@dataclass(frozen=True, eq=False)
class _Trial:
    """An observer in short runs of a problem, and alone: (sample, memory) -> (estimated state, memory)."""

    observer: StateObserver
    problem: Problem
    controller: Controller
    seed: int

    def exact_run(self, problem: Problem) -> Run:
        """With the exact model."""
        return simulate(problem, ExactModel(self.controller), seed=self.seed, compiled=False)

    @cached_property
    def model(self) -> Model:
        """What the observer is built from."""
        return observed_model(self.problem)

    def step(self, sample: Sample, memory: Array | None = None, parameters: Array | None = None) -> tuple[Array, Array]:
        """Estimated state and next memory; from the start, and with the approximate parameters, where none are given."""
        before = self.layout.start() if memory is None else memory
        known = self.problem.plant.approximate if parameters is None else parameters
        numbers = self.evaluator(sample.measured, sample.command, known, sample.moves, sample.counts, before)
        return numbers[0].copy(), numbers[1].copy()

    def sample(self, generator: np.random.Generator, **changes: Any) -> Sample:
        """Any sample, near the start."""
        start, inputs = self.problem.start_state, self.problem.plant.input.size
        state = start + 0.1 * generator.normal(size=start.size)
        return replace(Sample(self.seen(state, np.zeros(inputs)) + 0.1, generator.normal(size=inputs)), **changes)

    def errors(self, places: list[int], size: float, cycles: int) -> Array:
        """Largest error of these states after every sample of a plant at rest that starts off by `size`; the model is exact."""
        plant, calm = self.problem.plant, np.zeros(len(self.problem.plant.names))
        state, memory, command = self.problem.start_state.copy(), self.layout.start(), np.zeros(plant.input.size)
        state[places] += size
        errors = [size]
        for k in range(cycles):
            if k:
                state = np.asarray(self.model.move(state, command, plant.exact, calm, 1.0).full())[:, 0]
            estimated, memory = self.step(Sample(self.seen(state, command), command, float(k > 0)), memory, plant.exact)
            errors.append(float(np.abs((estimated - state)[places]).max()))
        return np.array(errors)

    def seen(self, state: Array, command: Array) -> Array:
        """What the sensors show."""
        return np.asarray(self.shown(state, command, self.problem.plant.exact).full())[:, 0]

    @cached_property
    def layout(self) -> Layout:
        return self.observer.memory(self.model)

    @cached_property
    def shown(self) -> ca.Function:
        x, u, p = self.problem.plant.symbols()
        values = values_of(self.problem.plant, x, u, p)
        return ca.Function("shown", [x, u, p], [ca.vertcat(*(values[n] for n in self.model.measured))])

    @cached_property
    def evaluator(self) -> Evaluator:
        plant = self.problem.plant
        sizes = (len(self.model.measured), plant.input.size, plant.approximate.size, 1, 1, self.layout.size)
        symbols = [ca.SX.sym(f"s{k}", size) for k, size in enumerate(sizes)]
        measured, *rest, memory = symbols
        shown: dict[str, Any] = dict(zip(self.model.measured, ca.vertsplit(measured), strict=True))
        evidence, remembered = Evidence(shown, *rest), self.layout.split(memory)
        predicted = self.observer.predict(self.model)(evidence, remembered)
        estimated, after = self.observer.correct(self.model)(evidence, remembered, predicted)
        return Evaluator(
            ca.Function("estimated", symbols, [ca.densify(estimated), ca.densify(self.layout.join(after))])
        )


def facts_hold(trial: _Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """It uses what is measured."""
    measured = trial.problem.sensing.measures(trial.problem.plant)
    unseen = [n for n in trial.observer.uses(measured) if n not in measured]
    hold(not unseen, f"it uses {unseen}, which no sensor shows")


def right_model_believes_what_is(trial: _Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """With the exact model, the right start and no noise the believed state is the plant's."""
    run = trial.exact_run(trial.problem)
    error, size = np.abs(run["state"] - run["plant_state"]).max(), np.abs(run["plant_state"]).max()
    hold(within(error, _SAME * size), f"the estimated state is off by {error:.3g}, states are as large as {size:.3g}")


def exact_parameters_are_unknown(trial: _Trial, generator: np.random.Generator) -> None:
    """Prediction and correction do not depend on the exact parameters, which nobody knows of a real plant."""
    plant = trial.problem.plant
    problem = replace(trial.problem, plant=with_exact_parameters(plant, _OTHER * plant.exact))
    sample = trial.sample(generator)
    answers = (one.step(sample) for one in (trial, replace(trial, problem=problem)))
    same = all(np.array_equal(a, b, equal_nan=True) for a, b in zip(*answers, strict=True))
    hold(
        same,
        f"with exact parameters {_OTHER - 1:.0%} larger, and equal evidence, it estimates another state; use evidence.parameters",
    )


def old_samples_do_nothing(trial: _Trial, generator: np.random.Generator) -> None:
    """A sample from before the run, which a dead time shows again, corrects (`counts` = 0) and moves (`moves` = 0) nothing."""
    for fact, what, cure in (
        ("counts", "measured", "select with if_else"),
        ("moves", "command", "move by evidence.moves"),
    ):
        sample = trial.sample(generator, **{fact: 0.0})
        other = replace(sample, **{what: getattr(sample, what) + 1.0})
        change = float(np.abs(trial.step(sample)[0] - trial.step(other)[0]).max())
        words = f"with {fact} = 0 a {what} that is larger by 1 changes the estimated state by {change:.3g}; {cure}"
        hold(change == 0, words)


def wrong_start_is_corrected(trial: _Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """Started wrong in what is measured, with the exact model and no noise, it comes to believe what is measured."""
    plant, used = trial.problem.plant, trial.observer.uses(trial.problem.sensing.measures(trial.problem.plant))
    places = [plant.state.elements.index(n) for n in used if n in plant.state.elements]
    every = np.eye(plant.state.size)
    free = unobservable([every], [every[places]]) if places else np.zeros((0, 0))
    seen = [k for k in places if not free.size or np.abs(free[k]).max() < _UNSEEN]
    if not seen:
        return  # it corrects nothing that is measured, and says so
    size = _WRONG * (1 + float(np.abs(trial.problem.start_state).max()))
    errors = trial.errors(seen, size, _LONG)
    most, late = float(errors.max()), float(errors[_LONG // 2 :].max())
    hold(
        within(most, _OVERSHOOT * size) and within(late, _LEFT * size),
        f"started wrong by {size:.3g} in what is measured it is wrong by up to {most:.3g} in {_LONG} samples without noise, and by "
        f"{late:.3g} in the later half of them: it does not converge to the plant; look at its gains and at what it remembers",
    )


LAWS = (
    frozen_value,
    facts_hold,
    exact_parameters_are_unknown,
    old_samples_do_nothing,
    wrong_start_is_corrected,
    right_model_believes_what_is,
)
