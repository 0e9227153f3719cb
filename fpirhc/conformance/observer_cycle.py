"""One cycle of an observer as numbers, without sensors and controller around it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from fpirhc.controllers.observed_state import believed_integrator, moving
from fpirhc.sensing.base import values_of
from fpirhc.sensing.state_observer import Evidence, Model, StateObserver
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.symbolic.layout import Layout
from fpirhc.task.problem import Problem

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class Sample:
    """Numbers of a cycle's evidence.

    Args:
        measured: what the sensors show, in the order of the model's names.
        state: true state, of which the observer is given what it calls known.
        command: that acted.
        moves: 1, or 0 where the sample still shows the start.
        counts: 1, or 0 for a sample from before the run.
    """

    measured: Array
    state: Array
    command: Array
    moves: float = 1.0
    counts: float = 1.0


@dataclass(frozen=True, eq=False)
class Cycle:
    """An observer for a problem: (memory, sample) -> (believed state, memory).

    Args:
        observer: the observer.
        problem: whose plant is the model; its start is where the observer begins.
    """

    observer: StateObserver
    problem: Problem

    @cached_property
    def model(self) -> Model:
        """What the observer is built from."""
        problem = self.problem
        move = moving(problem.plant, believed_integrator(problem), problem.period, fraction=False)
        return Model(problem.plant, move, problem.start_state, problem.sensing.measures(problem.plant))

    def __call__(self, sample: Sample, memory: Array | None = None) -> tuple[Array, Array]:
        """Believed state and next memory, with the model's approximate parameters; from the start where no memory is given."""
        return self._step(sample, self._layout.start() if memory is None else memory, self.problem.plant.approximate)

    def sample(self, generator: np.random.Generator) -> Sample:
        """Any sample, near the start."""
        start, inputs = self.problem.start_state, self.problem.plant.input.size
        state = start + 0.1 * generator.normal(size=start.size)
        return Sample(self._shown(state, np.zeros(inputs)) + 0.1, state, generator.normal(size=inputs))

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
            sample = Sample(self._shown(state, command), state, command, moves=float(k > 0))
            believed, memory = self._step(sample, memory, plant.exact)
            errors.append(float(np.abs((believed - state)[places]).max()))
        return np.array(errors)

    def _shown(self, state: Array, command: Array) -> Array:
        return np.asarray(self._shown_function(state, command, self.problem.plant.exact).full())[:, 0]

    def _step(self, sample: Sample, memory: Array, parameters: Array) -> tuple[Array, Array]:
        numbers = (sample.measured, sample.state, sample.command, parameters, sample.moves, sample.counts, memory)
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
        kind: Any = ca.MX if self.observer.opaque else ca.SX
        sizes = (len(self.model.measured), plant.state.size, plant.input.size, plant.approximate.size, 1, 1)
        symbols = [kind.sym(f"s{k}", size) for k, size in enumerate((*sizes, self._layout.size))]
        measured, state, command, parameters, moves, counts, memory = symbols
        shown: dict[str, Any] = dict(zip(self.model.measured, ca.vertsplit(measured), strict=True))
        true: dict[str, Any] = dict(zip(plant.state.elements, ca.vertsplit(state), strict=True))
        evidence = Evidence(shown, {}, command, parameters, moves, counts)
        remembered = self._layout.split(memory)
        predicted = self.observer.predict(self.model)(evidence, remembered)
        known = {e: true[e] for e in self.problem.sensing.known(plant)}
        believed, after = self.observer.correct(self.model)(replace(evidence, known=known), remembered, predicted)
        results = [ca.densify(believed), ca.densify(self._layout.join(after))]
        return Evaluator(ca.Function("believed", symbols, results))
