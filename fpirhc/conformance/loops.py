"""Short closed loops in which the laws of controllers and observers are tried."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from fpirhc.controllers.base import Controller
from fpirhc.controllers.built import build, checked
from fpirhc.controllers.composed import compose_controller
from fpirhc.horizon.cost import Quadratic
from fpirhc.horizon.horizon import Horizon
from fpirhc.plant.plant import Output, Parameter, Plant
from fpirhc.sensing.sensing import Sensing
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import simulate
from fpirhc.simulation.stepper import Stepper
from fpirhc.simulation.trials import without_warning
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.task.exogenous import really_known
from fpirhc.task.limits import Limits
from fpirhc.task.problem import Problem
from fpirhc.task.reference import Trajectory

Array = npt.NDArray[Any]

REPLAYED = 400  # cycles of a run, at most, that are given to a controller again


def two_masses() -> Problem:
    """Return two masses between springs with a model that is wrong in mass and stiffness, for 2 s."""
    plant = Plant(
        coordinates={"a": "m", "b": "m"},
        inputs={"Fa": "N", "Fb": "N"},
        parameters={
            "m": Parameter(approximate=1.4, exact=1.0, unit="kg"),
            "k": Parameter(approximate=2.0, exact=3.0, unit="N/m"),
        },
        response=lambda q, v, u, p: {
            "a": (u.Fa - p.k * (2 * q.a - q.b) - 0.2 * v.a) / p.m,
            "b": (u.Fb - p.k * (2 * q.b - q.a) - 0.2 * v.b) / p.m,
        },
    )
    weights = {"a": 1e2, "b": 1e2, "a'": 1.0, "b'": 1.0}
    return Problem(
        plant=plant,
        reference=Trajectory(lambda t: {"a": 0.3 * ca.sin(2 * t), "b": 0.2 * ca.cos(t)}),
        start={"a": 0.4, "b": -0.1},
        period=5e-3,
        duration=2.0,
        limits=Limits(inputs={"Fa": (-30.0, 30.0), "Fb": (-30.0, 30.0)}),
        horizon=Horizon(stages=12, step=2e-2),
        cost=Quadratic(states=weights, deviation={"Fa": 1e-3, "Fb": 1e-3}),
    )


@dataclass(frozen=True, eq=False)
class Trial:
    """A controller on a problem."""

    controller: Controller
    problem: Problem
    seed: int  # of the noise
    left: float  # share of the first error that may be left with the exact model
    compiled: bool  # whether compiled C is compared too

    @cached_property
    def run(self) -> Run:
        """The closed loop with the wrong model, in CasADi's virtual machine."""
        return self.simulated(self.problem)

    @cached_property
    def replay(self) -> Replay:
        """The controller, given the motion of `run`."""
        return Replay(self.problem, self.controller, self.run)

    @cached_property
    def exact(self) -> Problem:
        """The problem with an exact model, ideal sensors and no disturbance."""
        plant, signals = self.problem.plant, really_known(self.problem.signals)
        exact = {name: replace(p, approximate=p.exact) for name, p in plant.parameters.items()}
        known = replace(plant, parameters=exact)
        return replace(self.problem, plant=known, disturbances={}, sensing=Sensing(), signals=signals)

    def simulated(self, problem: Problem) -> Run:
        """A run of the controller, in CasADi's virtual machine."""
        return simulate(problem, self.controller, seed=self.seed, compiled=False)

    @cached_property
    @without_warning()
    def stepper(self) -> Stepper:
        """The controller alone, in CasADi's virtual machine."""
        return Stepper(self.problem, checked(self.problem, self.controller), compiled=False, bounded=False)


@dataclass(frozen=True, eq=False)
class Cycle:
    """What a controller says in one cycle: its signals by name, and the memory before the next one."""

    signals: dict[str, Array]
    memory: Array

    def __getitem__(self, name: str) -> Array:
        return self.signals[name]


@dataclass(frozen=True, eq=False)
class Replay:
    """A controller, without a gate before it, that is given the motion of a recorded run."""

    problem: Problem  # that the controller is composed for
    controller: Controller
    run: Run  # whose motion it is given

    def cycles(self) -> Iterator[Cycle]:
        """Yield the first cycles of the run, each from the memory of the one before."""
        memory = self.memory
        for k in range(min(self.run.cycles, REPLAYED)):
            cycle = self.cycle(k, memory)
            memory = cycle.memory
            yield cycle

    @property
    def memory(self) -> Array:
        """Before the first cycle."""
        return self._composite.memory.start()

    @cached_property
    def commands(self) -> Array:
        """The commands of the first cycles, a row each."""
        return np.array([cycle["command"] for cycle in self.cycles()])

    def cycle(self, k: int, memory: Array, **instead: Array) -> Cycle:
        """The cycle k of the run from a memory, with other values of what is read where they are given by name."""
        model = self.controller.plant_model(self.problem)
        seen = {"time": self.run.time[k], "parameters": model.parameters(model.plant), **instead}
        read = [seen[n] if n in seen else self.run[n][k] for n in self._composite.reads.names]
        after, trace, _ = self._evaluator(memory, *read)
        said = self._composite.trace
        return Cycle({name: trace[said.slice(name)].copy() for name in said.names}, after.copy())

    @cached_property
    def _composite(self) -> Composite:
        return compose_controller(build(self.problem, self.controller))

    @cached_property
    def _evaluator(self) -> Evaluator:
        return Evaluator(self._composite.function)


def spelled_by_states(problem: Problem) -> Problem | None:
    """Return a problem with an exact model whose plant is given by states in another order and sign, with outputs in their place.

    Horizon and cost are left out. None for a plant that has outputs, moves in steps, or has limits of its states.
    """
    plant = problem.plant
    own = bool(problem.limits.states) or problem.signals or problem.reality is not None
    if plant.outputs or plant.step is not None or own:
        return None
    elements, (x, u, p) = plant.state.elements, plant.symbols()
    names = {e: f"z{k}" for k, e in enumerate(reversed(elements))}
    units = dict(zip(elements, plant.state.units, strict=True))
    rates = ca.Function("rates", [x, u, p], [plant.equations.forced_rate(x, u, p, ca.DM.zeros(len(plant.names)))])

    def moved(z: Any, inputs: Any, values: Any) -> dict[str, Any]:
        numbers = (
            ca.vertcat(*(one[n] for n in some)) for one, some in ((inputs, plant.inputs), (values, plant.parameters))
        )
        slopes = rates(ca.vertcat(*(-z[names[e]] for e in elements)), *numbers)
        return {names[e]: -slopes[k] for k, e in enumerate(elements)}

    other = Plant.of_states(
        states={names[e]: units[e] for e in reversed(elements)},
        inputs=plant.inputs,
        parameters={n: replace(q, approximate=q.exact) for n, q in plant.parameters.items()},
        rates=moved,
        outputs={n: Output(units[n], lambda z, _, n=n: -z[names[n]]) for n in plant.names},
        controlled=plant.controlled,
        time_unit=plant.time_unit,
    )
    start = {names[e]: -float(v) for e, v in zip(elements, problem.start_state, strict=True)}
    return replace(problem, plant=other, start=start, horizon=None, cost=None, sensing=Sensing(), disturbances={})


def coarse_steps() -> Problem:
    """Return two stocks that are filled once in 100 s, exactly known: a map in whose steps a law for derivatives diverges."""
    step = 100.0
    plant = Plant.discrete(
        states={"a": "m", "b": "m"},
        inputs={"Fa": "m/s", "Fb": "m/s"},
        parameters={"k": Parameter(approximate=0.9, exact=0.9, unit="1")},
        next=lambda x, u, p: {"a": x.a + step * p.k * u.Fa, "b": x.b + step * p.k * (u.Fb - 0.1 * u.Fa)},
        step=step,
    )
    return Problem(
        plant=plant,
        reference=Trajectory(lambda t: {"a": 0 * t, "b": 0 * t}),
        start={"a": 0.4, "b": -0.1},
        period=step,
        duration=40 * step,
        horizon=Horizon(stages=12, step=step),
        cost=Quadratic(states={"a": 1.0, "b": 1.0}, deviation={"Fa": 1.0, "Fb": 1.0}),
    )
