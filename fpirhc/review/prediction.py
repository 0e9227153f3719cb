"""The effect of adaptation on the response, predicted along the run of a right model, and that run itself.

This run has no disturbances and no noise, so that every change by adaptation is harm. Theory: docs/theory-questions.md.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar, cast

import numpy as np

from fpirhc.controllers.base import Controller, closing_blocks, like
from fpirhc.controllers.contract import refuse, resolved, tracking_law, without_deformation
from fpirhc.controllers.model_inputs import with_measured_state
from fpirhc.deformation.base import Deformation, Identity
from fpirhc.describe import identity
from fpirhc.errors import FpirhcError, NoAnswer
from fpirhc.plant.maps import response_age
from fpirhc.plant.motion import known_exactly
from fpirhc.plant.plant import Plant
from fpirhc.review.grid import each, inner_places
from fpirhc.sensing.sensing import Sensing
from fpirhc.simulation.model_as_plant import ModelAsPlant, exactly, loop_of, shortened
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import Simulator, simulate
from fpirhc.simulation.trials import ErrorPair, Trials, errors_of
from fpirhc.symbolic.block import Block, Composite, Delay, compose
from fpirhc.symbolic.evaluate import Evaluator, Latest
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.task.exogenous import as_known
from fpirhc.task.problem import Problem

_CALL = 25  # cycles of the recursion in one call


@dataclass(frozen=True, eq=False)
class NominalRun:
    """The run of a right model, along which responses are predicted; build it with `nominal_run`."""

    problem: Problem
    controller: Controller  # the controller, with its deformation
    states: np.ndarray  # states of the run, shape (cycles + 1, nx)
    desired: np.ndarray  # desired responses, shape (cycles, n)
    believed: np.ndarray  # parameters of the model, shape (np,)
    of_model: tuple[np.ndarray, np.ndarray] | None = None  # the same where the model is the plant; None: those above

    @property
    def cycles(self) -> int:
        """Cycles of the run."""
        return len(self.desired)

    @cached_property
    def plant(self) -> Plant:
        """What moved, with its own parameters as the exact ones."""
        plant = self.problem.plant
        return exactly(plant, self.believed) if self.of_model is None else known_exactly(plant)

    @cached_property
    def null(self) -> NominalRun:
        """The run along which the model is the plant."""
        states, desired = self.of_model or (self.states, self.desired)
        return replace(self, states=states, desired=desired, of_model=None)

    @cached_property
    def right(self) -> Problem:
        """The problem in which the model may be what moved."""
        same = np.array_equal(self.plant.approximate, self.problem.plant.approximate)
        return self.problem if same else replace(self.problem, plant=self.plant)

    @cached_property
    def motion(self) -> np.ndarray:
        """Outputs of the run and their derivatives, shape (cycles + 1, ny); without outputs the states."""
        plant, count = self.plant, len(self.states)
        rows = (
            np.zeros((count, len(plant.inputs))),
            np.tile(plant.exact, (count, 1)),
            np.zeros((count, len(plant.names))),
        )
        return each(plant.equations.output, self.states, *rows)


@dataclass(frozen=True, eq=False)
class ResponseErrors:
    """Predictions of the recursion along a nominal run, in units of the response."""

    error: np.ndarray  # response errors e_k just after each update, shape (cycles, n)
    force: np.ndarray  # w_k, which acts on the deviation over each cycle, shape (cycles, n)
    command: np.ndarray  # u_k, shape (cycles, nu)


def nominal_run(problem: Problem, controller: Controller, *, compiled: bool = True) -> NominalRun:
    """Return the run of the controller without its deformation and with a right model, without disturbances and noise.

    Where states move by themselves, or outputs are controlled, the plant runs under the controller that knows it: a wrong model
    has them elsewhere. Else a right model moves alike, whichever it is, and the model runs as its own plant.

    Raises:
        NotSupported: a reality, dead time, estimated responses, a controller that does not track or plan with one model.
        NoAnswer: a run that ends early.
        FpirhcError: every error that the controller raises about the problem.
    """

    def run(own: Plant) -> Run:
        model = replace(problem, plant=own, disturbances={}, sensing=Sensing())
        return simulate(model, without_deformation(resolved(problem, controller)), seed=0, compiled=compiled)

    return nominal_of(problem, controller, run)


def nominal_of(problem: Problem, controller: Controller, run: Callable[[Plant], Run]) -> NominalRun:
    """Return the nominal run from runs of the controller on plants that it knows, made where there is a prediction."""
    check_prediction(problem, controller)
    ready = resolved(problem, controller)
    ready.check(problem)
    believed = ready.plant_model(problem).parameters(problem.plant)
    of_model = _moved("the model's own run", run(exactly(problem.plant, believed)))
    if not inner_places(problem):
        return NominalRun(problem, ready, *of_model, believed)
    own = _moved("the run with the right model", run(known_exactly(problem.plant)))
    return NominalRun(problem, ready, *own, believed, of_model)


def _moved(which: str, run: Run) -> tuple[np.ndarray, np.ndarray]:
    """States and desired responses of a run."""
    if run.stop is not None or run.cycles < 2:
        raise NoAnswer(f"no prediction: {which} ended early: {run.stop}")
    return run["state"], run["desired"][:-1]


def response_errors(
    nominal: NominalRun, *, deformation: Deformation | None = None, exact: np.ndarray | None = None
) -> ResponseErrors:
    """Return the response errors that the recursion predicts.

    Args:
        deformation: the deformation; None: the controller's; Identity() is no adaptation.
        exact: exact parameters, shape (np,); None: the plant's.
    """
    map_ = nominal.controller.deformation if deformation is None else deformation
    parameters = nominal.problem.plant.exact if exact is None else np.asarray(exact, dtype=float)
    made = identity(map_), parameters.tobytes(), nominal.problem.period
    return _ERRORS.of((nominal.states, nominal.problem.plant), made, lambda: _errors(nominal, map_, parameters))


_ERRORS: Latest[ResponseErrors] = Latest(8)  # several questions ask for the same ones


def _errors(nominal: NominalRun, deformation: Deformation, exact: np.ndarray) -> ResponseErrors:
    made = identity(deformation), nominal.believed.tobytes()
    step, run = _RECURSIONS.of((nominal.problem,), made, lambda: _recursion(nominal, deformation))
    reads, start = (nominal.states[:-1], nominal.desired, nominal.states[1:]), step.memory.start()
    if exact.size:  # an empty signal has one entry
        start[step.memory.slice("_exact")] = exact
    log = np.empty((-(-nominal.cycles // _CALL) * _CALL, step.trace.size))
    run.arguments[0][:] = start
    for at in range(0, nominal.cycles, _CALL):
        for argument, rows in zip(run.arguments[1:], reads, strict=True):
            some = rows[at : at + _CALL]
            argument.reshape(_CALL, -1)[: len(some)] = some
        run.redirect(1, log[at : at + _CALL])
        run.evaluate()
        run.arguments[0][:] = run.results[0].reshape(_CALL, -1)[-1]
    columns = ("response_error", "response_force", "command")
    return ResponseErrors(*(log[: nominal.cycles, step.trace.slice(name)] for name in columns))


def errors_without_adaptation(nominal: NominalRun) -> ResponseErrors:
    """Return the response errors of the controller without its deformation."""
    return response_errors(nominal, deformation=Identity())


def null_errors(nominal: NominalRun) -> ResponseErrors:
    """Return what adaptation adds to the response errors where the model is the plant, along its own run.

    Without adaptation there are none, but at a limit of the commands.
    """
    one, right = nominal.null, nominal.believed
    with_it, without = (response_errors(one, deformation=map_, exact=right) for map_ in (None, Identity()))
    return replace(with_it, error=with_it.error - without.error, force=with_it.force - without.force)


def _recursion(nominal: NominalRun, deformation: Deformation) -> tuple[Composite, Evaluator]:
    """One cycle, (memory, state, desired, next state) -> (memory, trace), and `_CALL` of them."""
    plant = nominal.problem.plant
    closing, delays = closing_blocks(nominal.problem, deformation)
    reads = Layout((plant.state, plant.response_signal("desired"), like(plant.state, "_state_after")))
    held = [
        Delay(
            Signal("parameters", plant.parameter.elements, plant.parameter.units, tuple(nominal.believed)), "parameters"
        ),
        Delay(Signal("_exact", plant.parameter.elements, plant.parameter.units), "_exact"),
    ]
    blocks = with_measured_state(plant, [_answer_block(plant), *closing, _judge_block(plant)])
    step = compose("prediction", reads, blocks, [*delays, *held])
    return step, Evaluator(step.function.mapaccum(f"{step.function.name()}_run", _CALL, {"base": 5}))


# With the exact parameters and with those of a right model.
_RECURSIONS: Latest[tuple[Composite, Evaluator]] = Latest(8)


def _answer_block(plant: Plant) -> Block:
    """Block (state, command before, exact parameters) -> realised; that of a map begins at the state before."""
    reads = (plant.state, like(plant.input, "_command_before"), like(plant.parameter, "_exact"))
    before = (like(plant.state, "state_answered"),) * response_age(plant)

    def step(s: Any) -> dict[str, Expression]:
        at = s.state_answered if before else s.state
        realised = plant.equations.controlled_response(at, s._command_before, s._exact)
        return {"realised": realised, **({"state_answered_next": s.state} if before else {})}

    return Block("answer", Layout(reads), Layout((plant.response_signal("realised"),)), step, Layout(before))


def _judge_block(plant: Plant) -> Block:
    """Block (states, command, desired, both parameter sets) -> response error and what acts on the deviation."""
    respond, inverse = plant.equations.controlled_response, plant.equations.inverse
    reads = (
        plant.state,
        like(plant.state, "_state_after"),
        plant.input,
        plant.response_signal("desired"),
        plant.parameter,
        like(plant.parameter, "_exact"),
    )
    writes = plant.response_signal("response_error"), plant.response_signal("response_force")

    def step(s: Any) -> dict[str, Expression]:
        first, last = (respond(x, s.command, s._exact) for x in (s.state, s._state_after))
        if response_age(plant):  # a map has one response over the whole cycle
            return {"response_error": first - s.desired, "response_force": first - s.desired}
        own = inverse(s.state, s.desired, s.parameters)
        of_model = 0.5 * (s.desired + respond(s._state_after, own, s.parameters))
        return {"response_error": first - s.desired, "response_force": 0.5 * (first + last) - of_model}

    return Block("judge_response", Layout(reads), Layout(writes), step, opaque=plant.equations.inverse_opaque)


def check_prediction(problem: Problem, controller: Controller, what: str = "prediction") -> None:
    """Raise where the response does not belong to the last request of one model and one map."""
    refuse(_against(problem, controller, what))


def _against(problem: Problem, controller: Controller, what: str) -> Iterator[str]:
    """Reasons against it."""
    follows = tracking_law(controller) is not None or controller.planner is not None
    if controller.learns or controller.feeds or controller.deforms != "response" or not follows:
        yield (
            f"no {what} for {type(controller).__name__}: it needs a controller that tracks or plans with one model and one "
            "map, and is given the measured state"
        )
    if problem.reality is not None:
        yield (
            f"no {what} beside a reality, whose response may not see the command at once; that of the model alone is that of "
            "problem.of_model"
        )
    if problem.signals:
        yield f"no {what} with signals from outside, which change along the run; simulate it"
    late = problem.dead_time.measurement or any(problem.dead_time.inputs.values())
    if late or problem.sensing.delay(problem.plant, problem.period):
        lateness = "dead time" if late else "an estimated response"
        yield f"no {what} with {lateness}: the response must belong to the last request"


CYCLES = 2000  # of a run
TRIED = 1000  # cycles of a run that tries a form or a gain

Kept = TypeVar("Kept")


@dataclass(frozen=True, eq=False)
class NominalRuns:
    """Runs of a problem's models without adaptation, each made when it is first asked for.

    Controllers that differ in their deformation alone share one.
    """

    problem: Problem  # the problem; its runs are shortened to at most `CYCLES` cycles
    _known: dict[Hashable, object] = field(default_factory=dict, init=False)

    def of(self, controller: Controller) -> NominalRun | str:
        """Return the nominal run with the controller's deformation, or the reason why there is none."""
        try:
            bare = without_deformation(resolved(self.problem, controller))
        except FpirhcError as error:
            return str(error)
        run = self._once(("nominal", identity(bare)), lambda: self._nominal(controller))
        return run if isinstance(run, str) else replace(run, controller=controller)

    @cached_property
    def model(self) -> ModelAsPlant:
        """The models as plants, without disturbances and noise."""
        return ModelAsPlant(_quiet(shortened(self.problem, CYCLES)), seed=0)

    def bare(self, controller: Controller) -> Run:
        """Return the run of the controller without its deformation on its model."""
        bare = without_deformation(resolved(self.problem, controller))
        return self.model.run(self._loop(bare), self.model.of(bare))

    def null(self, controller: Controller) -> ErrorPair:
        """Return the errors of the controller on its own model, with and without adaptation, over at most `CYCLES` cycles.

        Where commands stand at a limit in them, the run goes on for as many cycles in which errors count.
        """
        ready = resolved(self.problem, controller)
        loops = self._loop(without_deformation(ready)), self._loop(ready)
        pair = errors_of(*self.model.pair(loops))
        return errors_of(*self._later.pair(loops)) if pair.stuck and self._later is not None else pair

    @cached_property
    def _later(self) -> ModelAsPlant | None:
        """The models as plants for as long as it takes until errors have counted for `CYCLES` cycles; None: they do before."""
        end = min(self.problem.duration, self.problem.measure_from + CYCLES * self.problem.period)
        if end <= CYCLES * self.problem.period:
            return None
        return ModelAsPlant(_quiet(replace(self.problem, duration=end)), seed=0)

    def _loop(self, controller: Controller) -> Simulator:
        name = "loop", identity(controller)
        return self._once(name, lambda: loop_of(_quiet(self.problem), controller))

    def trials(self, problem: Problem, controller: Controller) -> Trials:
        """Return runs of deformations beside the controller without its own, of at most `TRIED` cycles each."""
        bare = without_deformation(controller)
        return self._once(("trials", identity(bare)), lambda: Trials(problem, bare, cycles=TRIED, goes_on=True))

    def _once(self, name: Hashable, make: Callable[[], Kept]) -> Kept:
        """Return what `make` returns, made when this name is first asked for."""
        if name not in self._known:
            self._known[name] = make()
        return cast("Kept", self._known[name])

    def _nominal(self, controller: Controller) -> NominalRun | str:
        problem = shortened(self.problem, CYCLES)
        try:
            if inner_places(problem) or not replace(problem.sensing, sensors={}).ideal:
                return nominal_run(problem, controller, compiled=False)
            return nominal_of(problem, controller, lambda _: self.bare(controller))
        except FpirhcError as error:
            return str(error)


def _quiet(problem: Problem) -> Problem:
    """The problem of the model without noise; the same one for the same problem, so that runs share what is built.

    It keeps disturbances, which runs on the model leave out, and so the loops of runs on the plant are those on the model.
    """
    return _QUIET.of((problem,), (), lambda: _without_noise(problem.of_model))


_QUIET: Latest[Problem] = Latest(4)


def _without_noise(problem: Problem) -> Problem:
    sensing = replace(problem.sensing, sensors={}) if problem.sensing.sensors else problem.sensing
    signals = as_known(problem.plant, problem.signals) if problem.signals else problem.signals
    same = sensing is problem.sensing and signals is problem.signals
    return problem if same else replace(problem, sensing=sensing, signals=signals)
