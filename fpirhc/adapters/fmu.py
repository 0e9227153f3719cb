"""A functional mock-up unit (FMI 2 or 3, co-simulation) as the reality of a problem, by FMPy.

problem = fp.Problem(plant=model, reality=fmu_body("tank.fmu", model, period=1.0, measures={"h": "level"}), ...)
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from shutil import rmtree
from typing import Any

from fpirhc.adapters import adapter, counterparts, require
from fpirhc.errors import Mistakes, package
from fpirhc.plant.chain import quantities
from fpirhc.plant.plant import Plant
from fpirhc.task.external_plant import ExternalPlant


@adapter
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
        measures: quantity of the model ("q1", "q1'") -> variable of the FMU, of the type Real or Float64.
        inputs: input of the model -> variable of the FMU, where the names differ.
        parameters: variable of the FMU -> its value from the start on.

    Raises:
        NotSupported: FMPy is not installed.
        InvalidProblem: a name that the FMU or the model does not have, a variable of another type, or an FMU without co-simulation.
    """
    fmpy = package("fmpy", "outside")
    described = fmpy.read_model_description(str(path))
    units, mistakes, fixed = quantities(model), Mistakes("fmu_body"), parameters or {}
    require(bool(described.coSimulation), "fmu_body: the FMU is for model exchange alone; export it for co-simulation")
    known = {v.name: v for v in described.modelVariables}
    mistakes.unknown("measures: quantity", measures, units)
    mistakes.unknown("variable", measures.values(), known)
    mistakes.unknown("parameters: variable", fixed, known)
    sent = counterparts(mistakes, "input", model.inputs, inputs or {}, known)
    for one in filter(None, map(known.get, (*measures.values(), *sent.values()))):
        if one.type not in ("Real", "Float64"):
            mistakes.add(f"variable '{one.name}' is of the type {one.type}; expected Real or Float64")
    mistakes.raise_if_any()
    folder = fmpy.extract(str(path))

    def made() -> Any:
        unit = fmpy.instantiate_fmu(folder, described, fmi_type="CoSimulation")
        fmpy.simulation.apply_start_values(unit, described, fixed)
        return unit

    places = ([known[name].valueReference for name in names] for names in (sent.values(), measures.values()))
    body = _Body(made, described.fmiVersion[0] == "3", period, *places)
    weakref.finalize(body, rmtree, folder, ignore_errors=True)
    return ExternalPlant(body, measures={name: units[name] for name in measures}, period=period)


class _Body:
    """An instance of the FMU, made anew for every run. `third`: whether it is of FMI 3."""

    def __init__(self, made: Callable[[], Any], third: bool, period: float, sent: list[int], read: list[int]) -> None:
        self._made, self._third, self._period, self._sent, self._read = made, third, period, sent, read
        self._unit: Any = None

    def reset(self, _seed: int) -> list[float]:
        """Begin anew at time 0."""
        if self._unit is not None:
            self._unit.terminate()
            self._unit.freeInstance()
        unit = self._unit = self._made()
        self._set, self._get = (unit.setFloat64, unit.getFloat64) if self._third else (unit.setReal, unit.getReal)
        if not self._third:
            unit.setupExperiment(startTime=0.0)
        unit.enterInitializationMode()
        unit.exitInitializationMode()
        return list(self._get(self._read))

    def step(self, time: float, command: Iterable[float]) -> list[float]:
        """Hold the command for a communication step."""
        self._set(self._sent, list(map(float, command)))
        self._unit.doStep(currentCommunicationPoint=time, communicationStepSize=self._period)
        return list(self._get(self._read))
