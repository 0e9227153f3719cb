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
from fpirhc.task.dead_time import DeadTime
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
class _Trial:
    """An observer in short runs of a problem."""

    observer: StateObserver
    problem: Problem
    controller: Controller
    seed: int

    @cached_property
    def cycle(self) -> Cycle:
        return Cycle(self.observer, self.problem)

    def exact_run(self, problem: Problem) -> Run:
        """With the exact model."""
        return simulate(problem, ExactModel(self.controller), seed=self.seed, compiled=False)


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


def lives_in_the_time_of_the_samples(trial: _Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """Behind a measurement that is late by two cycles it is the state of that time."""
    late = replace(trial.problem, dead_time=DeadTime(measurement=2 * trial.problem.period))
    run = trial.exact_run(late)
    true, believed = run["plant_state"], run["state"]
    hold(np.array_equal(believed[:3], true[[0, 0, 0]]), "before the first late sample it is not the start")
    error = np.abs(believed[3:] - true[1:-2]).max()
    hold(within(error, _SAME * np.abs(true).max()), f"behind a late measurement it is off by {error:.3g}")


def exact_parameters_are_unknown(trial: _Trial, generator: np.random.Generator) -> None:
    """Prediction and correction do not depend on the exact parameters, which nobody knows of a real plant."""
    plant = trial.problem.plant
    other = replace(trial.problem, plant=with_exact_parameters(plant, _OTHER * plant.exact))
    one, two = Cycle(trial.observer, trial.problem), Cycle(trial.observer, other)
    sample = one.sample(generator)
    same = all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one(sample), two(sample), strict=True))
    hold(
        same,
        f"with exact parameters {_OTHER - 1:.0%} larger, and equal evidence, it estimates another state; use evidence.parameters",
    )


def old_samples_do_nothing(trial: _Trial, generator: np.random.Generator) -> None:
    """A sample from before the run, which a dead time shows again, corrects (`counts` = 0) and moves (`moves` = 0) nothing."""
    cycle, sample = trial.cycle, replace(trial.cycle.sample(generator), counts=0.0)
    change = float(np.abs(cycle(sample)[0] - cycle(replace(sample, measured=sample.measured + 1.0))[0]).max())
    hold(
        change == 0,
        f"with counts = 0 a measurement that is larger by 1 changes the estimated state by {change:.3g}; select with if_else",
    )
    still = replace(cycle.sample(generator), moves=0.0)
    change = float(np.abs(cycle(still)[0] - cycle(replace(still, command=still.command + 1.0))[0]).max())
    hold(
        change == 0,
        f"with moves = 0 a command that is larger by 1 changes the estimated state by {change:.3g}; move by evidence.moves",
    )


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
    errors = Cycle(trial.observer, trial.problem).errors(seen, size, _LONG)
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
    lives_in_the_time_of_the_samples,
)


@dataclass(frozen=True, eq=False)
class Sample:
    """Numbers of a cycle's evidence."""

    measured: Array  # what the sensors show, in the order of the model's names
    command: Array  # that acted
    moves: float = 1.0  # 1, or 0 where the sample still shows the start
    counts: float = 1.0  # 1, or 0 for a sample from before the run


@dataclass(frozen=True, eq=False)
class Cycle:
    """An observer of a problem, whose plant is the model: (sample, memory) -> (believed state, memory)."""

    observer: StateObserver
    problem: Problem

    @cached_property
    def model(self) -> Model:
        """What the observer is built from."""
        return observed_model(self.problem)

    def __call__(self, sample: Sample, memory: Array | None = None) -> tuple[Array, Array]:
        """Believed state and next memory, with the model's approximate parameters; from the start where no memory is given."""
        return self._step(sample, self._layout.start() if memory is None else memory, self.problem.plant.approximate)

    def sample(self, generator: np.random.Generator) -> Sample:
        """Any sample, near the start."""
        start, inputs = self.problem.start_state, self.problem.plant.input.size
        state = start + 0.1 * generator.normal(size=start.size)
        return Sample(self._shown(state, np.zeros(inputs)) + 0.1, generator.normal(size=inputs))

    def errors(self, places: list[int], size: float, cycles: int) -> Array:
        """Largest error of these states after every sample, the first one before them, of a plant that starts elsewhere by `size`.

        The model is exact, nothing is commanded and there is no noise.
        """
        plant, calm = self.problem.plant, np.zeros(len(self.problem.plant.names))
        state, memory, command = self.problem.start_state.copy(), self._layout.start(), np.zeros(plant.input.size)
        state[places] += size
        errors = [float(np.abs((state - self.problem.start_state)[places]).max())]
        for k in range(cycles):
            if k:
                state = np.asarray(self.model.move(state, command, plant.exact, calm, 1.0).full())[:, 0]
            sample = Sample(self._shown(state, command), command, moves=float(k > 0))
            believed, memory = self._step(sample, memory, plant.exact)
            errors.append(float(np.abs((believed - state)[places]).max()))
        return np.array(errors)

    def _shown(self, state: Array, command: Array) -> Array:
        return np.asarray(self._shown_function(state, command, self.problem.plant.exact).full())[:, 0]

    def _step(self, sample: Sample, memory: Array, parameters: Array) -> tuple[Array, Array]:
        numbers = (sample.measured, sample.command, parameters, sample.moves, sample.counts, memory)
        believed, after = self._evaluator(*numbers)
        return believed.copy(), after.copy()

    @cached_property
    def _layout(self) -> Layout:
        return self.observer.memory(self.model)

    @cached_property
    def _shown_function(self) -> ca.Function:
        x, u, p = self.problem.plant.symbols()
        values = values_of(self.problem.plant, x, u, p)
        return ca.Function("shown", [x, u, p], [ca.vertcat(*(values[n] for n in self.model.measured))])

    @cached_property
    def _evaluator(self) -> Evaluator:
        plant = self.problem.plant
        sizes = (len(self.model.measured), plant.input.size, plant.approximate.size, 1, 1)
        symbols = [ca.SX.sym(f"s{k}", size) for k, size in enumerate((*sizes, self._layout.size))]
        measured, command, parameters, moves, counts, memory = symbols
        shown: dict[str, Any] = dict(zip(self.model.measured, ca.vertsplit(measured), strict=True))
        evidence = Evidence(shown, command, parameters, moves, counts)
        remembered = self._layout.split(memory)
        predicted = self.observer.predict(self.model)(evidence, remembered)
        believed, after = self.observer.correct(self.model)(evidence, remembered, predicted)
        results = [ca.densify(believed), ca.densify(self._layout.join(after))]
        return Evaluator(ca.Function("believed", symbols, results))
