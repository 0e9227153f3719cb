"""The block of believed states: from raw measurements and the own commands to 'state' and 'realised'.

    model predicts -> what no sensor shows is taken from the prediction -> estimator -> observer corrects

The state has each entry from where it is known best: believed entries from the observer, the others from the estimator.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import cast

import casadi as ca
import numpy as np

from fpirhc.controllers.contract import Controller, refuse
from fpirhc.controllers.model_inputs import CommandPath
from fpirhc.controllers.reference_states import nominal_motion
from fpirhc.errors import NoAnswer
from fpirhc.horizon.nominal import nominal_run, reference_state
from fpirhc.plant.chain import measured_signals
from fpirhc.plant.integrators import Integrator, RungeKutta4
from fpirhc.plant.maps import growth_of
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import Evidence, Model, StateObserver, members, slowest, unobservable, values_of
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.task.dead_time import Queue
from fpirhc.task.problem import Problem, nominal_start


@dataclass(frozen=True, eq=False)
class Believing:
    """The block that believes, and what it remembers."""

    problem: Problem  # whose sensing has an observer
    raw: Signal  # signal of the raw measurements
    shown: np.ndarray  # first state, or outputs, that the sensors see; the estimator begins there

    @property
    def block(self) -> Block:
        """Block (raw measurements, parameters, last command) -> (state, [output], realised)."""
        plant = self.problem.plant
        reads = Layout((self.raw, *self._path.reads))
        writes = Layout((*measured_signals(plant), plant.response_signal("realised")))
        own = Layout((*self._path.memory, *self.observer.memory(self.model).signals)) + self._estimator.memory
        return Block("believe", reads, writes, self._step, own)

    @property
    def delay(self) -> Delay:
        """The last command, carried to the next cycle."""
        return Delay(self._path.last, self.problem.plant.input.name)

    @property
    def observer(self) -> StateObserver:
        """How states that no sensor shows are believed."""
        observer = self.problem.sensing.observer
        assert observer is not None
        return observer

    @cached_property
    def model(self) -> Model:
        """What the observer is built from."""
        problem = self.problem
        move = moving(problem.plant, believed_integrator(problem), problem.period, fraction=bool(self._path.fraction))
        return Model(problem.plant, move, problem.start_state, problem.sensing.measures(problem.plant))

    @cached_property
    def _path(self) -> CommandPath:
        return sample_path(self.problem)

    @cached_property
    def _estimator(self) -> Block:
        plant, sensing = self.problem.plant, self.problem.sensing
        completed = Signal("_completed", sensing.estimator.measures(plant))
        return sensing.estimator.block(plant, self.problem.period, self.shown, completed)

    def _step(self, s: Signals) -> dict[str, Expression]:
        plant = self.problem.plant
        shown_now = dict(zip(self.raw.elements, ca.vertsplit(getattr(s, self.raw.name)), strict=True))
        evidence, results = self._evidence(s, shown_now)
        memory = {m: getattr(s, m) for m in self.observer.memory(self.model).names}
        predicted = self.observer.predict(self.model)(evidence, memory)
        expected = values_of(plant, predicted, evidence.command, evidence.parameters)
        motion, realised, *remembered = self._estimates(s, {**expected, **evidence.measured})
        state, next_memory = self.observer.correct(self.model)(evidence, memory, predicted)
        results |= {plant.output.name: motion, "state": state, "realised": realised}
        results |= {f"{m}_next": v for m, v in next_memory.items()}
        return results | {f"{m.name}_next": v for m, v in zip(self._estimator.memory.signals, remembered, strict=True)}

    def _evidence(self, s: Signals, shown: Mapping[str, Expression]) -> tuple[Evidence, dict[str, Expression]]:
        """What the observer is told, with no state known yet, and what is remembered for the next cycle."""
        path = self._path
        (command, _, commands), (parameters, signals), cycles = path.acted(s), path.parameters(s), path.cycles(s)
        moves: Expression = cycles > path.late + 0.5  # share of a cycle by which the sample is later than the last one
        if path.fraction:
            whole = cycles > path.late + 1.5
            mean = (1 - path.fraction) * command + path.fraction * path.acted_before(s)
            command, moves = ca.if_else(whole, mean, command), ca.if_else(whole, 1, (1 - path.fraction) * moves)
            mixed = (1 - path.fraction) * parameters + path.fraction * path.parameters_before(s)
            parameters = ca.if_else(whole, mixed, parameters) if signals else parameters
        evidence = Evidence(shown, command, parameters, moves, cycles > path.late - 0.5)
        return evidence, {**commands, **signals}

    def _estimates(self, s: Signals, seen: Mapping[str, Expression]) -> tuple[Expression, ...]:
        """State or outputs, response, and memory of the estimator."""
        names = self.problem.sensing.estimator.measures(self.problem.plant)
        completed = ca.vertcat(*(seen[n] for n in names))
        results = self._estimator.function(completed, *(getattr(s, m) for m in self._estimator.memory.names))
        return tuple(results)


def moving(plant: Plant, integrator: Integrator, period: float, *, fraction: bool) -> ca.Function:
    """Return Function (state, input, parameters, forcing, share) -> state after that share of a cycle.

    `fraction`: whether the share may lie between 0 and 1; a sample in between is interpolated.
    """
    (x, u, p), w, share = plant.symbols(), ca.SX.sym("w", len(plant.names)), ca.SX.sym("share")
    after = integrator.step(plant, period)(x, u, p, w)
    state_next = x + share * (after - x) if fraction else after
    return ca.Function("fpirhc_move", [x, u, p, w, share], [ca.if_else(share, state_next, x)])


def believed_integrator(problem: Problem) -> Integrator:
    """Return the integrator of the model: the problem's, or a Runge-Kutta step where that is a call without Jacobian."""
    return RungeKutta4() if problem.integrator.opaque else problem.integrator


def sample_path(problem: Problem) -> CommandPath:
    """Return what acted until a sample was taken, with the dead times that the problem states.

    Behind a measurement that is late by d + phi cycles, 0 <= phi < 1, a sample is interpolated,

        z_k = (1 - phi) x_{k-d} + phi x_{k-d-1},

    and moves as the plant does with the mean of the commands that acted, (1 - phi) u_{k-d-1} + phi u_{k-d-2}, and
    of the signals from outside. For a linear plant this is exact; else the error is of second order in the cycle, as that of the
    interpolation. The first sample that moves is a mean with the start, so it moves by 1 - phi of a cycle.
    """
    inputs, period = problem.plant.input, problem.period
    last = Signal("_commanded", inputs.elements, inputs.units, tuple(map(float, problem.inputs_before)))
    cycles = tuple(cast(float, problem.dead_time.wait(name, period).cycles) for name in inputs.elements)
    late = problem.dead_time.measurement / period
    return CommandPath(problem, "observer", last, Queue(cycles), late)


_INSTANTS = 25
_STAYS = 1e-9  # share of the fastest pole below which an error counts as staying


@dataclass(frozen=True)
class UnobservableErrors:
    """Errors of believed states that no measurement corrects."""

    states: tuple[str, ...]  # names of the states that have a part in them
    pole: float  # largest real part of their poles along the reference, 1 / unit of time; negative: all decay
    decays: bool  # whether they decay by themselves


@lru_cache(maxsize=8)  # several controllers are checked on one problem
def unobservable_errors(problem: Problem) -> UnobservableErrors:
    """Return the errors of the believed states that no measurement corrects; of a problem without an observer there are none."""
    plant, observer = problem.plant, problem.sensing.observer
    if observer is None:
        return UnobservableErrors((), -np.inf, decays=True)
    names = observer.uses(problem.sensing.measures(plant))
    states, slopes, shown = _linearised(problem, names)
    size = np.maximum(np.abs(states).max(axis=0), np.abs(problem.start_state))
    size[size == 0] = 1.0
    scaled = [a * size / size[:, None] for a in slopes]
    basis = unobservable(scaled, [c * size for c in shown])
    pole = slowest(scaled, basis, growth_of(plant))
    fastest = max(float(np.abs(np.linalg.eigvals(a)).max()) for a in slopes)
    return UnobservableErrors(
        tuple(plant.state.elements[k] for k in members(basis)), pole, decays=pole < -_STAYS * fastest
    )


def check_observed(problem: Problem) -> None:
    """Raise if errors are neither observed nor decay."""
    observer = problem.sensing.observer
    if observer is None:
        return
    free = unobservable_errors(problem)
    if not free.decays:
        measured = ", ".join(observer.uses(problem.sensing.measures(problem.plant)))
        raise NoAnswer(
            f"{type(observer).__name__}: {' and '.join(free.states)} cannot be observed along the reference from {measured}, and "
            f"an error of what is believed does not decay (pole {free.pole:.3g} {problem.rate_unit}); measure {free.states[0]}, or "
            "another quantity that depends on it"
        )


def check_believed(problem: Problem, controller: Controller) -> None:
    """Raise if a controller cannot be given believed states, or the observer cannot be right."""
    if problem.sensing.observer is not None:
        refuse(_against(problem, controller))
        check_observed(problem)


def _against(problem: Problem, controller: Controller) -> Iterator[str]:
    """Reasons against believed states."""
    sensing, plant = problem.sensing, problem.plant
    lost = sensing.believed_response(plant)
    if lost and controller.deformation.adapts:
        yield (
            f"the response that {type(controller.deformation).__name__} compares needs {', '.join(lost)}, which no sensor shows: "
            "the model's own response is the request, from which nothing can be learned. Measure it, or choose an estimator of "
            f"what is measured ({', '.join(sensing.measures(plant))})"
        )
    model = controller.plant_model(problem).plant
    if model.parameter.elements != plant.parameter.elements:
        yield (
            f"{type(controller).__name__} has a model with other parameters than the problem's, and states are believed by the "
            "problem's; leave the observer out, or give both the same parameters"
        )


def _linearised(problem: Problem, names: tuple[str, ...]) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """States of the reference, shape (instants, nx), and there dx'/dx and the Jacobian of the measured quantities."""
    plant = problem.plant
    x, u, p = plant.symbols()
    values = values_of(plant, x, u, p)
    shown = ca.vertcat(*(values[n] for n in names))
    rate = plant.equations.rate(x, u, p)
    jacobians = ca.Function("fpirhc_observed", [x, u, p], [ca.jacobian(rate, x), ca.jacobian(shown, x)])
    states, slopes, seen = [], [], []
    for state, needed in _points(problem):
        slope, part = (np.asarray(m.full()) for m in jacobians(state, needed, plant.approximate))
        if np.isfinite(slope).all() and np.isfinite(part).all():
            states.append(state)
            slopes.append(slope)
            seen.append(part)
    if not slopes:
        raise NoAnswer("believed states: the model has no finite Jacobian along the reference")
    return np.array(states), slopes, seen


def _points(problem: Problem) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """States and inputs of the model along the reference, or of a simulation where it does not give the states."""
    plant = problem.plant
    if plant.equations.known_on_reference:
        reference, needed = nominal_motion(problem), problem.inputs_before
        for t in np.linspace(0.0, problem.duration, _INSTANTS):
            outputs, response = reference(t)
            state = reference_state(plant, outputs)
            if len(plant.controlled_names) == len(plant.inputs):
                needed = np.asarray(plant.equations.inverse(state, response, plant.approximate).full())
            yield np.asarray(state.full()).ravel(), needed.ravel()
        return
    states, inputs = nominal_run(problem.plant, problem.reference, *nominal_start(problem))
    for k in np.unique(np.linspace(0, states.shape[1] - 1, _INSTANTS).astype(int)):
        yield states[:, k], inputs[:, k]
