"""A functional mock-up unit (FMI 2 or 3, co-simulation) as the reality of a problem, by FMPy.

problem = fp.Problem(plant=model, reality=fmu_body("tank.fmu", model, period=1.0, measures={"h": "level"}), ...)
"""

from __future__ import annotations

import shutil
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fpirhc.adapters.names import counterparts
from fpirhc.errors import InvalidProblem, Mistakes, package
from fpirhc.plant.plant import Plant
from fpirhc.task.external_plant import ExternalPlant, quantities


def fmu_body(
    path: str | Path,
    model: Plant,
    *,
    period: float,
    measures: Mapping[str, str],
    inputs: Mapping[str, str] | None = None,
    parameters: Mapping[str, float] | None = None,
) -> ExternalPlant:
    """Return a functional mock-up unit as a reality.

    Args:
        path: of the FMU.
        model: the controller's model; the variables of the FMU have its units.
        period: of the problem, in the model's unit of time; one communication step.
        measures: quantity of the model ("q1", "q1'") -> variable of the FMU.
        inputs: input of the model -> variable of the FMU, where the names differ.
        parameters: variable of the FMU -> its value from the start on.

    Raises:
        NotSupported: FMPy is not installed.
        InvalidProblem: a name that the FMU or the model does not have, or an FMU without co-simulation.
    """
    fmpy = package("fmpy", "outside")
    described = fmpy.read_model_description(str(path))
    if described.coSimulation is None:
        raise InvalidProblem(
            f"fmu_body: {Path(path).name} is made for model exchange alone; export it for co-simulation"
        )
    units, mistakes = quantities(model), Mistakes("fmu_body")
    references = {v.name: v.valueReference for v in described.modelVariables if v.type in ("Real", "Float64")}
    mistakes.unknown("measures: quantity", measures, units)
    mistakes.unknown("variable", measures.values(), references)
    mistakes.unknown("parameters: variable", parameters or {}, references)
    sent = counterparts(mistakes, "input", model.inputs, inputs or {}, references)
    mistakes.raise_if_any()
    names = (list(parameters or {}), list(sent.values()), list(measures.values()))
    fixed, commands, answers = ([references[n] for n in some] for some in names)
    body = _Body(fmpy, str(path), described, period, (fixed, list((parameters or {}).values())), commands, answers)
    return ExternalPlant(body, measures={name: units[name] for name in measures})


class _Body:
    """An instance of the FMU, made anew for every run.

    Args:
        fmpy: the package.
        path: of the FMU.
        described: its description.
        period: of a step.
        fixed: references of the parameters, and their values.
        commands: references of the inputs.
        answers: references of what is measured.
    """

    def __init__(
        self,
        fmpy: Any,
        path: str,
        described: Any,
        period: float,
        fixed: tuple[list[int], list[float]],
        commands: list[int],
        answers: list[int],
    ) -> None:
        self._fmpy, self._described, self._folder = fmpy, described, fmpy.extract(path)
        self._period, self._fixed, self._commands, self._answers = period, fixed, commands, answers
        self._instance: Any = None
        weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)

    def reset(self, seed: int) -> np.ndarray:
        """Begin anew at time 0."""
        del seed
        self._end()
        self._instance = self._fmpy.instantiate_fmu(self._folder, self._described, fmi_type="CoSimulation")
        new = self._described.fmiVersion.startswith("3")
        if not new:
            self._instance.setupExperiment(startTime=0.0)
        self._set, self._get = (
            (self._instance.setFloat64, self._instance.getFloat64)
            if new
            else (self._instance.setReal, self._instance.getReal)
        )
        self._instance.enterInitializationMode()
        self._set(*self._fixed)
        self._instance.exitInitializationMode()
        return np.array(self._get(self._answers))

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        """Hold the command for a communication step."""
        self._set(self._commands, list(map(float, command)))
        self._instance.doStep(currentCommunicationPoint=time, communicationStepSize=self._period)
        return np.array(self._get(self._answers))

    def _end(self) -> None:
        if self._instance is not None:
            self._instance.terminate()
            self._instance.freeInstance()
            self._instance = None
