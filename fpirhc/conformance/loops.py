"""Short closed loops in which the laws of controllers and observers are tried."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from fpirhc.conformance.laws import Array
from fpirhc.controllers.base import Controller
from fpirhc.controllers.built import build, compose_controller
from fpirhc.horizon.cost import Quadratic
from fpirhc.horizon.horizon import Horizon
from fpirhc.plant.plant import Output, Parameter, Plant
from fpirhc.simulation.run import Run
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.task.limits import Limits
from fpirhc.task.problem import Problem
from fpirhc.task.reference import Trajectory

Cycle: TypeAlias = dict[str, Array]  # what a controller says in one cycle, and its `memory` before the next one

REPLAYED = 400  # cycles of a run, at most, that are given to a controller again
_INPUTS = {"Fa": "N", "Fb": "N"}


def two_masses() -> Problem:
    """Return two masses between springs with a model that is wrong in mass and stiffness, for 2 s."""
    plant = Plant(
        coordinates={"a": "m", "b": "m"},
        inputs=_INPUTS,
        parameters=_parameters(mass=1.4, stiffness=2.0),
        response=lambda q, v, u, p: dict(zip("ab", _pushed(q.a, q.b, v.a, v.b, u, p), strict=True)),
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


def _parameters(mass: float, stiffness: float) -> dict[str, Parameter]:
    return {"m": Parameter(mass, 1.0, "kg"), "k": Parameter(stiffness, 3.0, "N/m")}


def _pushed(a: Any, b: Any, va: Any, vb: Any, u: Any, p: Any) -> tuple[Any, Any]:
    return (u.Fa - p.k * (2 * a - b) - 0.2 * va) / p.m, (u.Fb - p.k * (2 * b - a) - 0.2 * vb) / p.m


def by_states() -> Problem:
    """Return the two masses, exactly known, by states in another order and sign, with a and b as outputs; nothing is planned."""

    def rates(x: Any, u: Any, p: Any) -> dict[str, Any]:
        of_a, of_b = _pushed(-x.a3, -x.b1, -x.a2, -x.b0, u, p)
        return {"b0": -of_b, "b1": x.b0, "a2": -of_a, "a3": x.a2}

    plant = Plant.of_states(
        states={"b0": "m/s", "b1": "m", "a2": "m/s", "a3": "m"},
        inputs=_INPUTS,
        parameters=_parameters(mass=1.0, stiffness=3.0),
        rates=rates,
        outputs={"a": Output("m", lambda x, _: -x.a3), "b": Output("m", lambda x, _: -x.b1)},
    )
    return replace(
        two_masses(), plant=plant, start={"b0": 0.0, "b1": 0.1, "a2": 0.0, "a3": -0.4}, horizon=None, cost=None
    )


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


@dataclass(frozen=True, eq=False)
class Replay:
    """A controller, without a gate before it, that is given the motion of a recorded run."""

    problem: Problem  # that the controller is composed for
    controller: Controller
    run: Run  # whose motion it is given

    @cached_property
    def cycles(self) -> list[Cycle]:
        """The first cycles of the run, each from the memory of the one before."""
        cycles, memory = [], self._composite.memory.start()
        for k in range(min(self.run.cycles, REPLAYED)):
            cycles.append(self.cycle(k, memory))
            memory = cycles[-1]["memory"]
        return cycles

    @property
    def commands(self) -> Array:
        """The commands of the first cycles, a row each."""
        return np.array([cycle["command"] for cycle in self.cycles])

    def cycle(self, k: int, memory: Array, **instead: Array) -> Cycle:
        """The cycle k of the run from a memory, with other values of what is read where they are given by name."""
        model = self.controller.plant_model(self.problem)
        seen = {"time": self.run.time[k], "parameters": model.parameters(model.plant), **instead}
        read = [seen[n] if n in seen else self.run[n][k] for n in self._composite.reads.names]
        after, trace, _ = self._evaluator(memory, *read)
        said = self._composite.trace
        return {"memory": after.copy()} | {name: trace[said.slice(name)].copy() for name in said.names}

    @cached_property
    def _composite(self) -> Composite:
        return compose_controller(build(self.problem, self.controller))

    @cached_property
    def _evaluator(self) -> Evaluator:
        return Evaluator(self._composite.function)
