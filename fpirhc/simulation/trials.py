"""Errors of a controller without adaptation and with it, from short runs on the plant and on its own model, and a warning of harm.

The controller's model as the plant has nothing to adapt, so every change by adaptation is harm. A controller is warned of where
adaptation makes the first errors larger by far, or where it makes one on the model that is larger than that of the wrong model
without adaptation. A plant outside is not run for that.
"""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.believed import plant_model
from fpirhc.controllers.contract import name_in_task, without_deformation
from fpirhc.deformation.base import Deformation
from fpirhc.describe import identity
from fpirhc.errors import FpirhcError, HarmfulAdaptation
from fpirhc.fields.user_code import users_level
from fpirhc.plant.motion import derivative_unit, with_exact_parameters, with_space
from fpirhc.plant.plant import Plant
from fpirhc.simulation.metrics import by_name
from fpirhc.simulation.metrics.shipped import at_limit, rms_error, total_variation
from fpirhc.simulation.run import Run, judged_motion
from fpirhc.simulation.simulate import Simulator, simulator
from fpirhc.summary import written_out
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.layout import Expression, Named
from fpirhc.task.dead_time import DeadTime
from fpirhc.task.exogenous import Exogenous, Known, signals_of
from fpirhc.task.problem import Problem
from fpirhc.task.reality import Reality

_LONGEST = 2000  # measured cycles of a run on a model


def with_believed_way(problem: Problem, deformation: Deformation) -> Problem:
    """Return the problem of a right model; itself where the deformation believes nothing beyond the problem.

    A lag or a dead time that a deformation believes is a part of its model, so a plant without it is no right model. A dead time
    that the problem states is a fact, and stays.
    """
    form, stated = deformation.form, problem.dead_time
    if not form.modelled:
        return problem
    lags, cycles = (_each(one, len(problem.plant.inputs)) for one in (form.lag, form.cycles))
    if not (stated.measurement or any(stated.inputs.values())) and (any(cycles) or form.measurement):
        inputs = {name: c * problem.period for name, c in zip(problem.plant.inputs, cycles, strict=True)}
        late = DeadTime(inputs=inputs, measurement=form.measurement * problem.period)
        problem = replace(problem, dead_time=late)
    return _behind(problem, lags)


def behind_stated_lag(problem: Problem) -> Problem:
    """Return the problem whose reality is the model behind the lags that an external plant states; itself where it states none."""
    lag = problem.moves.lag
    if not any(lag.values()):
        return problem
    return _behind(problem.of_model, tuple(lag.get(name, 0.0) for name in problem.plant.inputs))


def _behind(problem: Problem, lags: Sequence[float]) -> Problem:
    plant = problem.plant
    if not any(lags):
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
        known, form = plant_model(self._problem, controller), controller.deformation.form
        parameters = known.parameters(self._problem.plant)
        name = parameters.tobytes(), identity(known.signals), form
        if name not in self._models:
            self._models[name] = self._made(parameters, known.signals, controller.deformation)
        return self._models[name]

    def _made(self, parameters: np.ndarray, signals: Mapping[str, Exogenous], deformation: Deformation) -> Problem:
        own = self._problem.of_model
        plant, longest = exactly(own.plant, parameters), own.measure_from + _LONGEST * own.period
        given, stated, duration = signals_of(own.plant, signals), own.plant.parameters, min(own.duration, longest)
        known = {n: one if one.told else Known(stated[n].approximate) for n, one in given.items()}  # all it believes
        return with_believed_way(replace(own, plant=plant, signals=known, duration=duration), deformation)

    def pair(self, loops: tuple[Simulator, Simulator]) -> tuple[Problem, tuple[Run, Run]]:
        """Return the problem of the second loop's model, and the runs of both loops on it."""
        model = self.of(loops[1].controller)
        return model, (self.run(loops[0], model), self.run(loops[1], model))

    def run(self, loop: Simulator, model: Problem) -> Run:
        """Return the run of a loop, of the problem, on one of the models."""
        own, made = self._behind(model, loop), (self._seed, model.cycles)
        return _RUNS.of((own, *_untimed(model)), made, lambda: own.run(seed=self._seed, variant=model, disturbed=False))

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
_RUNS: Latest[Run] = Latest(8)
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
    every = {**plant.coordinates, **{acting[name]: plant.inputs[name] for name in taus}}
    # An input reaches the controlled quantities one derivative later, so they are those of the model and not its own.
    return replace(plant, coordinates=every, response=response, order=order, controlled=None, inverse=None)


def _free(name: str, plant: Plant) -> str:
    """The name, lengthened until nothing of the plant has it."""
    taken = {*plant.coordinates, *plant.inputs, *plant.parameters, *plant.chains}
    while name in taken:
        name += "_"
    return name


_ROUNDING = 1e-9  # share of the coordinate's range
MOSTLY = 0.5  # share of the cycles at a limit, from which a run shows nothing


def spoils(ratio: float, added: float, error: float, cured: float) -> bool:
    """Whether adaptation harms: it makes an error twice as large, and adds a hundredth of the range, or ten times and a thousandth.

    On a right model it does so only where the error is above the one that it `cured`: that without adaptation on the plant itself.
    """
    much = not (ratio <= 2.0 or added <= 1e-2) or not (ratio <= 10.0 or added <= 1e-3)
    return much and error > cured


@dataclass(frozen=True, eq=False)
class ErrorPair:
    """Errors of two runs on the same plant."""

    # rms tracking error by judged coordinate without adaptation, in the unit of the coordinate; infinite where the run
    # ended early
    without: Mapping[str, float]
    adapted: Mapping[str, float]  # the same with the deformation
    # range of the reference, or the largest error of the run without adaptation where that is larger, by coordinate
    ranges: Mapping[str, float]
    units: Mapping[str, str]  # of the coordinates
    # share of the cycles in which a command stands at a limit, of the run where it is smaller; NaN where one ended before
    # errors count
    at_limit: float = 0.0
    movement: str = ""  # total variation of every command without adaptation and with it, in words

    @property
    def worst(self) -> str:
        """The coordinate to which adaptation adds the largest share of its range."""
        return max(self.without, key=self.added)

    def added(self, name: str) -> float:
        """The error that adaptation adds, as a share of the range of the coordinate."""
        return (self.adapted[name] - self.without[name]) / max(self.ranges[name], 1e-300)

    def ratio(self, name: str) -> float:
        """The error with adaptation over the error without."""
        return self.adapted[name] / max(self.without[name], 1e-300)

    @property
    def sentence(self) -> str:
        """Both errors of the worst coordinate, where a run may have ended early."""
        unit = with_space(self.units[self.worst])
        before, after = self.without[self.worst], self.adapted[self.worst]
        if not math.isfinite(before):
            other = f"with it the rms error of {self.worst} is {written_out(after)}{unit}"
            return f"the run without adaptation ends early, and {other if math.isfinite(after) else 'so does the one with it'}"
        rest = f"{written_out(after)}{unit} with it" if math.isfinite(after) else "a run that ends early with it"
        return f"the rms error of {self.worst} is {written_out(before)}{unit} without adaptation, {rest}"

    @property
    def stuck(self) -> bool:
        """Whether the pair shows nothing: commands stand at a limit in both runs, where no adaptation can act."""
        return self.at_limit >= MOSTLY  # NaN is informative

    def fails(self, cured: Mapping[str, float] | None = None) -> bool:
        """Whether it `spoils` a coordinate; where the run without adaptation ends early there is nothing that it makes worse."""
        known, least = all(map(math.isfinite, self.without.values())), cured or dict.fromkeys(self.without, 0.0)
        return known and any(spoils(self.ratio(n), self.added(n), self.adapted[n], least[n]) for n in self.without)


def errors_of(problem: Problem, runs: Sequence[Run], names: frozenset[str] | None = None) -> ErrorPair:
    """Return the errors of two runs, without adaptation and with it, from `measure_from` on; of some coordinates, or of all."""
    every = ({n: v for n, v in rms_error(problem, run).items() if names is None or n in names} for run in runs)
    before, after = ({n: v if math.isfinite(v) else math.inf for n, v in one.items()} for one in every)
    stuck = float(np.min([at_limit(problem, run) for run in runs]))  # NaN where one of them is
    moved = [total_variation(problem, run) for run in runs]
    each = (
        f"{n} {' -> '.join(written_out(m[n]) for m in moved)}{with_space(derivative_unit(unit, 1, problem.time_unit))}"
        for n, unit in problem.plant.inputs.items()
    )
    movement = f"total variation: {', '.join(each)}"
    return ErrorPair(before, after, _ranges(problem, runs[0]), problem.plant.followed, stuck, movement)


def _ranges(problem: Problem, run: Run) -> dict[str, float]:
    """Range of the reference, or the largest error of the whole run where that is larger; its size where both are rounding."""
    errors, motion = run["true_error"], run[judged_motion(run.layout)]
    places = [problem.plant.output.elements.index(name) for name in problem.judged_names]
    if not run.cycles:
        return dict.fromkeys(problem.judged_names, 0.0)
    reference = errors + motion[:, places]
    sizes = np.fmax(np.ptp(reference, axis=0), np.abs(errors).max(axis=0))
    largest = np.abs(reference).max(axis=0)
    sizes = np.where(sizes > _ROUNDING * largest, sizes, largest)
    return by_name(problem.judged_names, np.where(np.isfinite(sizes), sizes, 0.0))


def weighed(problem: Problem, controller: Controller) -> frozenset[str] | None:
    """Return the judged coordinates whose errors, or whose derivatives' errors, the plan's cost weighs.

    None stands for all of them: the controller does not plan, the cost does not say, or it weighs no judged coordinate.
    """
    planner = controller.planner
    cost = (planner.cost or problem.cost) if planner else None
    weights = None if cost is None else cost.tracked
    if weights is None:
        return None
    names = {state.rstrip("'") for state in weights}
    return frozenset(n for n in problem.judged_names if n in names) or None


def harm(problem: Problem, controller: Controller, cycles: int) -> str:
    """Return what runs of so many cycles, without adaptation and with it, on the plant and on the model, show against adaptation.

    They are judged by the coordinates that its cost weighs. A plant outside is not run. Empty: no harm, or no such run.
    """
    if not controller.deformation.adapts:
        return ""
    short = shortened(problem, cycles)
    try:
        loops = loop_of(short, without_deformation(controller)), loop_of(short, controller)
        names = weighed(short, loops[1].controller)
        null = errors_of(*ModelAsPlant(short, seed=0).pair(loops), names)
        runs = [loop.run(seed=0, variant=short) for loop in loops] if short.moves.simulated else []
    except FpirhcError:  # what the runs cannot do says nothing about the controller
        return ""
    real = errors_of(short, runs, names) if runs else None
    reasons = [f"on the plant {real.sentence}"] if real and real.fails() else []
    if null.fails(real.without if real else None):
        reasons.append(f"on its own model, with nothing to adapt {null.sentence}")
    return "; ".join(reasons)


CYCLES = 300  # of a run
_FOUND: Latest[str] = Latest(8)  # the same values run alike
_REMEDY = (
    "Use ModelReferenced(map), which leaves an exact model alone, or ask fpirhc review. To silence this, and spare the runs: "
    'warnings.simplefilter("ignore", fpirhc.HarmfulAdaptation)'
)


def warn_of_harm(problem: Problem, controller: Controller) -> None:
    """Warn once where adaptation does harm; nothing is run where the warning is ignored, or nothing adapts a fixed model."""
    if controller.learns or _ignored():
        return
    if found := _FOUND.of((problem, controller), (), lambda: harm(problem, controller, CYCLES)):
        what = ", ".join(part for part in (problem.name, name_in_task(controller)) if part)
        text = f"{what}: adaptation does harm, by runs of {CYCLES} cycles: {found}. {_REMEDY}"
        warnings.warn(text, HarmfulAdaptation, stacklevel=users_level())


@contextmanager
def without_warning() -> Iterator[None]:
    """Ignore the warning, for steppers of controllers that are judged anyway."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HarmfulAdaptation)
        yield


def _ignored() -> bool:
    """Whether the first filter for the warning ignores it, whatever its text and place."""
    for action, message, category, module, _ in warnings.filters:
        if issubclass(HarmfulAdaptation, category) and message is None and module is None:
            return action == "ignore"
    return False
