"""Controllers as units of FMI 2.0: valid by FMPy, equal to the stepper and to a run, and strict about what a master may do."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.exports import COMPILERS, Exported, exported
from helpers.replay import samples

import fpirhc as fp

REASON = "FMPy is not installed: pip install 'fpirhc[fmu]'"
fmpy: Any = pytest.importorskip("fmpy", reason=REASON)
fmi1 = pytest.importorskip("fmpy.fmi1", reason=REASON)
validation = pytest.importorskip("fmpy.validation", reason=REASON)
needs_compiler = pytest.mark.skipif(not COMPILERS, reason="no C compiler")
CASES = {
    "torque": ("two_mass", "CTC+FPI (eq 6)", ("deformation.gain", "limits.inputs.Q1.0", "limits.inputs.Q1.1")),
    "plan": ("two_mass", "RHC+FPI", ()),
    "outputs": ("anaesthesia", "RHC+FPI", ()),
    "map": ("fishery", "RHC+FPI", ()),
}


def of_case(name: str, folder: Path) -> tuple[Exported, Path]:
    of, title, live = CASES[name]
    return exported(folder / "unit", of, title, "fmu2", live=live, name="unit"), folder / "unit" / "unit.fmu"


class Master:
    """A unit that is called by names."""

    def __init__(self, path: Path) -> None:
        described = fmpy.read_model_description(str(path))
        self.unit: Any = fmpy.instantiate_fmu(fmpy.extract(str(path)), described, fmi_type="CoSimulation")
        self.variables = {v.name: v for v in described.modelVariables}
        self.inputs, self.outputs = (
            [n for n, v in self.variables.items() if v.causality == causality and v.type == "Real"]
            for causality in ("input", "output")
        )
        self.begin()

    def begin(self, time: float = 0.0) -> None:
        self.unit.setupExperiment(startTime=time)
        self.unit.enterInitializationMode()
        self.unit.exitInitializationMode()

    def set(self, names: list[str], values: np.ndarray) -> None:
        self.unit.setReal(self._references(names), np.asarray(values, dtype=float).tolist())

    def get(self, names: list[str]) -> list[float]:
        return list(self.unit.getReal(self._references(names)))

    def status(self) -> int:
        return int(self.unit.getInteger(self._references(["status"]))[0])

    def step(self, time: float, period: float) -> None:
        self.unit.doStep(currentCommunicationPoint=time, communicationStepSize=period)

    def _references(self, names: list[str]) -> list[int]:
        return [self.variables[n].valueReference for n in names]


@contextmanager
def master(path: Path) -> Iterator[Master]:
    one = Master(path)
    try:
        yield one
    finally:
        one.unit.terminate()
        one.unit.freeInstance()


def samples_of(device: Exported) -> np.ndarray:
    """What the step is given in the first 300 cycles of a run, without the time."""
    short = replace(device.problem, duration=300 * device.problem.period, measure_from=0.0)
    return samples(fp.simulate(short, device.controller, seed=0, compiled=False))


@needs_compiler
@pytest.mark.parametrize("name", CASES)
def test_a_unit_is_valid_and_its_commands_are_those_of_the_stepper_bit_by_bit(name, tmp_path):
    """FMPy finds nothing wrong, and 300 samples of a run give the commands and statuses that the stepper gives."""
    device, path = of_case(name, tmp_path)
    assert validation.validate_fmu(str(path)) == []
    period, samples, memory = device.problem.period, samples_of(device), device.stepper.start()
    with master(path) as unit:
        for k, row in enumerate(samples[:300]):
            unit.set(unit.inputs, row)
            command, memory = device.stepper.step_measured(k * period, row, memory)
            assert unit.get(unit.outputs) == command.tolist(), k
            assert unit.get(["trace.status"])[0] == unit.status() == device.stepper.trace()["status"]
            unit.step(k * period, period)


@needs_compiler
def test_what_a_master_may_not_do(tmp_path):
    """Wrong settings, other steps, steps that begin elsewhere, numbers that are computed: refused, and the unit stays as it was."""
    device, path = of_case("torque", tmp_path)
    period, gain = device.problem.period, "settings.deformation.gain"
    with master(path) as unit:
        start = unit.get([gain])[0]
        assert (unit.variables[gain].min, unit.variables[gain].max) == tuple(
            None if np.isinf(e) else repr(e) for e in device.bounds["deformation.gain"]
        )
        for wrong in (np.nan, np.inf, 3.0):
            with pytest.raises(fmi1.FMICallException):
                unit.set([gain], np.array([wrong]))
            assert unit.get([gain])[0] == start
        unit.set([gain], np.array([start / 2]))
        assert unit.get([gain])[0] == start / 2
        for name in ("command.Q1", "trace.clipped", "time"):
            with pytest.raises(fmi1.FMICallException):
                unit.set([name], np.zeros(1))
        for point, step in ((0.0, 2 * period), (0.0, 0.5 * period), (0.0, np.nan), (period, period), (np.nan, period)):
            with pytest.raises(fmi1.FMICallException):
                unit.step(point, step)
        assert unit.get(["time"])[0] == 0.0
        for k in range(3):
            unit.step(k * period, period)
        with pytest.raises(fmi1.FMICallException):
            unit.step(0.0, period)  # again
        assert unit.get(["time"])[0] == 3 * period


@needs_compiler
def test_a_reset_begins_anew(tmp_path):
    """The same samples after it give the same commands; another unit beside it does not notice."""
    device, path = of_case("plan", tmp_path)
    period, samples, said = device.problem.period, samples_of(device), []
    with master(path) as unit, master(path) as other:
        for _ in range(2):
            for k in range(20):
                unit.set(unit.inputs, samples[k])
                said.append(unit.get(unit.outputs))
                unit.step(k * period, period)
            unit.unit.reset()
            unit.begin()
        other.set(other.inputs, samples[0])
        assert other.get(other.outputs) == said[0]
    assert said[20:] == said[:20]


def test_the_same_controller_gives_the_same_archive(tmp_path):
    first, second = (of_case("torque", tmp_path / name)[1].read_bytes() for name in "ab")
    assert first == second
