"""A stepper and its plant in a loop whose samples are lost, or whose cycles the caller misses."""

from collections.abc import Callable, Collection
from typing import Any

import casadi as ca
import numpy as np

import fpirhc as fp
from fpirhc.contracts import Controller, values_of


class Lossy:
    """A loop without noise; commands wait for the dead time of the inputs, samples for that of the measurement, in whole cycles."""

    def __init__(self, problem: fp.Problem, controller: Controller, **settings: Any) -> None:
        self.problem, plant = problem, problem.plant
        self.stepper = fp.Stepper(problem, controller, **({"compiled": False} | settings))
        self._advance = problem.integrator.step(plant, problem.period)
        self._shows = self._seen if self.stepper.estimates else self._measured
        x, u, p = plant.symbols()
        values = values_of(plant, x, u, p)
        self._values = tuple(values), ca.Function("values", [x, u, p], [ca.densify(ca.vertcat(*values.values()))])
        self._waits = (
            [round(problem.dead_time.inputs.get(name, 0.0) / problem.period) for name in plant.inputs],
            round(problem.dead_time.measurement / problem.period),
        )
        self.trace: list[dict[str, np.ndarray]] = []  # of every step
        self.states: list[np.ndarray] = []  # of the plant, in every cycle

    def run(
        self,
        cycles: int,
        lost: Collection[int] = (),
        how: str = "lost",
        shown: Callable[[int, np.ndarray], np.ndarray] = lambda _, row: row,
    ) -> np.ndarray:
        """Return the commands in force in every cycle, shape (cycles, inputs)."""
        problem, period = self.problem, self.problem.period
        memory, x = self.stepper.start(), np.array(problem.start_state, dtype=float)
        before = np.array(problem.inputs_before, dtype=float)
        command, sent, samples = before, [before] * (max(self._waits[0], default=0) + 1), list[np.ndarray]()
        commands, waiting = [], list[int]()
        self.trace, self.states = [], []
        for k in range(cycles):
            acting = np.array([sent[-1 - wait][j] for j, wait in enumerate(self._waits[0])])
            samples.append(self._shows(x, acting))
            sample = samples[max(k - self._waits[1], 0)]
            if k in lost and how != "lost":
                waiting.append(k)
            else:
                for i, j in enumerate(waiting if how == "interpolated" else ()):
                    last = samples[max(waiting[0] - 1 - self._waits[1], 0)]
                    between = last + (sample - last) * (i + 1) / (len(waiting) + 1)
                    _, memory = self.stepper.step_measured(j * period, between, memory)
                waiting = []
                row = np.full(sample.size, np.nan) if k in lost else shown(k, sample.copy())
                command, memory = self.stepper.step_measured(k * period, row, memory)
            commands.append(command)
            sent.append(command)
            self.states.append(x)
            self.trace.append(self.stepper.trace())
            acts = np.array([sent[-1 - wait][j] for j, wait in enumerate(self._waits[0])])
            x = np.asarray(
                self._advance(x, acts, problem.plant.exact, np.zeros(len(problem.plant.names))).full()
            ).ravel()
        return np.array(commands)

    def statuses(self) -> list[fp.Status]:
        return [fp.Status(int(row["status"][0])) for row in self.trace]

    def _measured(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        plant = self.problem.plant
        realised = plant.equations.controlled_response(x, u, plant.exact)
        return np.concatenate([x, np.asarray(realised.full()).ravel()])

    def _seen(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        names, function = self._values
        values = dict(zip(names, np.asarray(function(x, u, self.problem.plant.exact).full()).ravel(), strict=True))
        return np.array([values[n] for n in self.stepper.measures])
