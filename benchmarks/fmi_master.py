"""A master for exported units, by FMPy: one that lets inputs pass through, and one that exchanges after each step alone."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

import fpirhc as fp
from fpirhc.controllers.contract import Controller


class Master:
    """A unit that is called by names, whatever its version."""

    def __init__(self, path: Path) -> None:
        import fmpy

        described = fmpy.read_model_description(str(path))
        self.folder = fmpy.extract(str(path))
        self.unit: Any = fmpy.instantiate_fmu(self.folder, described, fmi_type="CoSimulation")
        self.new = described.fmiVersion.startswith("3")
        self.references = {v.name: v.valueReference for v in described.modelVariables}
        self.variables = {v.name: v for v in described.modelVariables}
        self.begin()

    def begin(self, time: float = 0.0) -> None:
        """Begin at a time."""
        if not self.new:
            self.unit.setupExperiment(startTime=time)
        self.unit.enterInitializationMode(**({"startTime": time} if self.new else {}))
        self.unit.exitInitializationMode()

    def set(self, names: list[str], values: np.ndarray) -> None:
        """Write numbers by their names."""
        call = self.unit.setFloat64 if self.new else self.unit.setReal
        call([self.references[n] for n in names], np.asarray(values, dtype=float).tolist())

    def get(self, names: list[str]) -> np.ndarray:
        """Read numbers by their names."""
        call = self.unit.getFloat64 if self.new else self.unit.getReal
        return np.array(call([self.references[n] for n in names]))

    def status(self) -> int:
        """Return the status of the cycle."""
        call = self.unit.getInt32 if self.new else self.unit.getInteger
        return int(call([self.references["status"]])[0])

    def step(self, time: float, period: float) -> None:
        """Take a communication step."""
        self.unit.doStep(currentCommunicationPoint=time, communicationStepSize=period)

    def names(self, causality: str, kind: tuple[str, ...] = ("Float64", "Real")) -> list[str]:
        """Return the names of the numbers of a causality, in the order of their references."""
        return [n for n, v in self.variables.items() if v.causality == causality and v.type in kind]


@contextmanager
def master(path: Path) -> Iterator[Master]:
    one = Master(path)
    try:
        yield one
    finally:
        one.unit.terminate()
        one.unit.freeInstance()


def apart_from_a_run(
    problem: fp.Problem, controller: Controller, path: Path, cycles: int, *, late: bool = False
) -> tuple[float, float]:
    """Return how far states and commands of unit and plant are from those of `simulate`, at most.

    Args:
        problem: with a plant that is measured without sensors.
        controller: of the unit.
        path: of the unit.
        cycles: from the start.
        late: the plant has the command of the cycle before, as with a master that exchanges values after each step alone.
    """
    plant, run = problem.plant, fp.simulate(problem, controller, seed=0)
    advance = problem.integrator.step(plant, problem.period)
    state, realised, worst = run["state"][0], run["realised"][0], np.zeros(2)
    held = np.asarray(problem.inputs_before, dtype=float)
    with master(path) as unit:
        inputs, outputs = unit.names("input"), unit.names("output")
        for k in range(cycles):
            unit.set(inputs, np.concatenate([state, realised]))
            new = unit.get(outputs)
            command, held = (held, new) if late else (new, new)
            now = [np.abs(state - run["state"][k]).max(), np.abs(command - run["command"][k]).max()]
            worst = np.maximum(worst, now)
            unit.step(k * problem.period, problem.period)
            state = advance(state, command, plant.exact, np.zeros(advance.numel_in(3))).full().ravel()
            realised = plant.equations.response(state, command, plant.exact).full().ravel()
    return float(worst[0]), float(worst[1])


def with_samples_of_a_run(run: fp.Run, columns: list[str], path: Path, cycles: int) -> tuple[float, np.ndarray, float]:
    """Return what a unit does with the samples of a run: how far its commands are from those of the run, at most, the commands,
    and the median of the times of a cycle, s.

    Args:
        run: a log.
        columns: names of the signals of a sample, without the time.
        path: of the unit.
        cycles: from the start, at most.
    """
    rows, period = np.hstack([run[name].reshape(len(run.time), -1) for name in columns]), run.period
    commands, times = [], []
    with master(path) as unit:
        inputs, outputs = unit.names("input"), unit.names("output")
        for k, row in enumerate(rows[:cycles]):
            began = perf_counter()
            unit.set(inputs, row)
            commands.append(unit.get(outputs))
            unit.step(k * period, period)
            times.append(perf_counter() - began)
    made = np.array(commands)
    return float(np.abs(made - run["command"][: len(made)]).max()), made, float(np.median(times))
