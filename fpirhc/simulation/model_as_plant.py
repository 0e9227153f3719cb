"""The controller's model as the plant: there is nothing to adapt, so every change by adaptation is harm."""

from __future__ import annotations

import inspect
import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import fields, replace

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.deformation.base import Deformation, Form
from fpirhc.describe import identity
from fpirhc.plant.motion import with_exact_parameters
from fpirhc.plant.plant import Plant
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import Simulator, simulator
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.layout import Expression, Named
from fpirhc.task.dead_time import DeadTime
from fpirhc.task.exogenous import Exogenous, Known, signals_of
from fpirhc.task.problem import Problem
from fpirhc.task.reality import Reality

CYCLES = 2000  # measured cycles of a run at most


def with_believed_way(problem: Problem, deformation: Deformation) -> Problem:
    """Return the problem of a right model; itself where the deformation believes nothing beyond the problem.

    A lag or a dead time that a deformation believes is a part of its model, so a plant without it is no right model. A dead time
    that the problem states is a fact, and stays. A lag before a map is left out.
    """
    form = deformation.form
    lags = _each(form.lag, len(problem.plant.inputs))
    return _behind(_with_dead_time(problem, form), lags) if form.modelled else problem


def _with_dead_time(problem: Problem, form: Form) -> Problem:
    cycles = _each(form.cycles, len(problem.plant.inputs))
    stated = problem.dead_time.measurement or any(problem.dead_time.inputs.values())
    if stated or not (any(cycles) or form.measurement):
        return problem
    inputs = {name: c * problem.period for name, c in zip(problem.plant.inputs, cycles, strict=True)}
    return replace(problem, dead_time=DeadTime(inputs=inputs, measurement=form.measurement * problem.period))


def behind_stated_lag(problem: Problem) -> Problem:
    """Return the problem whose reality is the model behind the lags that an external plant states; itself where it states none."""
    lag = problem.moves.lag
    if not any(lag.values()):
        return problem
    return _behind(problem.of_model, tuple(lag.get(name, 0.0) for name in problem.plant.inputs))


def _behind(problem: Problem, lags: Sequence[float]) -> Problem:
    plant = problem.plant
    if not any(lags) or plant.step is not None:
        return problem
    finer = problem.integrator.finer(math.ceil(problem.period / min(t for t in lags if t)))
    before = zip(plant.inputs, lags, map(float, problem.inputs_before), strict=True)
    start = {_free(f"{name}_acting", plant): value for name, lag, value in before if lag > 0}  # at rest
    real = Reality(behind_actuators(plant, lags), integrator=finer or problem.integrator, start=start)
    return replace(problem, reality=real)


def _each(value: float | tuple[float, ...], count: int) -> tuple[float, ...]:
    return value if isinstance(value, tuple) else (value,) * count


def exactly(plant: Plant, values: np.ndarray) -> Plant:
    """Return the plant with these exact parameters; the same one for the same values, so that what is built of it is shared."""
    values = np.asarray(values, dtype=float)
    return _EXACT.of((plant,), (values.tobytes(),), lambda: with_exact_parameters(plant, values))


_EXACT: Latest[Plant] = Latest(8)


class ModelAsPlant:
    """Models of controllers as the plant of their loops, without disturbances; a loop does not run twice on a model."""

    def __init__(self, problem: Problem, *, seed: int) -> None:
        """Take the problem of the loops and the seed of the sensors' noise."""
        self._problem, self._seed = problem, seed
        self._models: dict[Hashable, Problem] = {}

    def of(self, controller: Controller) -> Problem:
        """Return the problem whose plant is the model of a resolved controller, behind the lag and the dead time that it believes.

        It is the same one for controllers that know the same. Signals are what the model believes of them.
        """
        known, form = controller.plant_model(self._problem), controller.deformation.form
        parameters = known.parameters(self._problem.plant)
        name = parameters.tobytes(), identity(known.signals), form
        if name not in self._models:
            self._models[name] = self._made(parameters, known.signals, controller.deformation)
        return self._models[name]

    def _made(self, parameters: np.ndarray, signals: Mapping[str, Exogenous], deformation: Deformation) -> Problem:
        own = self._problem.of_model
        plant, longest = exactly(own.plant, parameters), own.measure_from + CYCLES * own.period
        given, stated, duration = signals_of(own.plant, signals), own.plant.parameters, min(own.duration, longest)
        known = {n: one if one.told else Known(stated[n].approximate) for n, one in given.items()}  # all it believes
        return with_believed_way(replace(own, plant=plant, signals=known, duration=duration), deformation)

    def pair(self, loops: tuple[Simulator, Simulator]) -> tuple[Problem, tuple[Run, Run]]:
        """Return the problem of the second loop's model, and the runs of both loops on it."""
        model = self.of(loops[1].controller)
        return model, (self.run(loops[0], model), self.run(loops[1], model))

    def run(self, loop: Simulator, model: Problem) -> Run:
        """Return the run of a loop, of the problem, on one of the models."""
        own = self._behind(model, loop)
        # Random series of another length are others.
        length = () if not own.problem.sensing.drawn else (model.cycles,)
        longest = _RUNS.of((own, *_untimed(model)), (self._seed, *length), list)
        if not longest or (longest[0].cycles < model.cycles and longest[0].stop is None):
            longest[:] = [own.run(seed=self._seed, variant=model, disturbed=False)]
        return longest[0].first(model.cycles)

    def _behind(self, model: Problem, loop: Simulator) -> Simulator:
        """The loop itself where it moves a plant of the model's kind; else the one that does, whose plans are built already."""
        own = loop.problem
        told = identity(own.signals) == identity(model.signals)
        if own.reality is None and model.reality is None and told and model.dead_time is own.dead_time:
            return loop
        kept = model if model.reality is not None else replace(model, plant=own.plant)
        return loop_of(kept, loop.controller)


def loop_of(problem: Problem, controller: Controller) -> Simulator:
    """Return the closed loop for runs of any duration; it is the same one for problems that differ in their times alone."""
    build = lambda: simulator(problem, controller, compiled=False)  # noqa: E731
    return _LOOPS.of(_untimed(problem), (identity(controller),), build)


def _untimed(problem: Problem) -> tuple[object, ...]:
    values = [getattr(problem, field.name) for field in fields(Problem) if field.name not in _TIMES]
    return tuple(None if isinstance(value, Mapping) and not value else value for value in values)


_LOOPS: Latest[Simulator] = Latest(8)
_RUNS: Latest[list[Run]] = Latest(8)  # at most one each, from which shorter ones are taken
_TIMES = {"duration", "measure_from"}  # of a problem, which are no part of its loop


def shortened(problem: Problem, cycles: int) -> Problem:
    """Return the problem with at most so many cycles; where it is shortened, errors count from its middle on at the latest.

    It is the same one for the same problem, so that what is computed of it is shared.
    """
    if problem.cycles <= cycles:
        return problem
    duration = cycles * problem.period
    measured = min(problem.measure_from, 0.5 * duration)
    return _SHORTENED.of((problem,), (cycles,), lambda: replace(problem, duration=duration, measure_from=measured))


_SHORTENED: Latest[Problem] = Latest(8)


def behind_actuators(plant: Plant, lags: Sequence[float]) -> Plant:
    """Return the plant whose inputs act through lags.

    `lags`: time constant of every input's actuator, in the plant's unit of time; 0: the input acts at once.
    """
    taus = {name: tau for name, tau in zip(plant.inputs, lags, strict=True) if tau > 0}
    acting = {name: _free(f"{name}_acting", plant) for name in taus}

    def response(*arguments: Named) -> Mapping[str, Expression]:
        *derivatives, u, p = arguments
        arrived = ca.vertcat(*(derivatives[0][acting[name]] if name in acting else u[name] for name in plant.inputs))
        rates = {acting[name]: (u[name] - derivatives[0][acting[name]]) / tau for name, tau in taus.items()}
        return {**plant.response(*derivatives, Named(tuple(plant.inputs), arrived, "input"), p), **rates}

    vars(response)["__signature__"] = inspect.signature(plant.response)
    order = dict(zip(plant.names, plant.orders, strict=True)) | dict.fromkeys(acting.values(), 1)
    positions = {acting[name]: plant.inputs[name] for name in taus}
    # An input reaches the controlled quantities one derivative later, so they are those of the model and not its own.
    return replace(
        plant,
        coordinates={**plant.coordinates, **positions},
        response=response,
        order=order,
        controlled=None,
        inverse=None,
    )


def _free(name: str, plant: Plant) -> str:
    """The name, lengthened until nothing of the plant has it."""
    taken = {*plant.coordinates, *plant.inputs, *plant.parameters, *plant.chains}
    while name in taken:
        name += "_"
    return name
