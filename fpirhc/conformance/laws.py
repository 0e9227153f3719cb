"""What a law is, how laws are tried, the law of every value, and short closed loops in which laws are tried.

A law is a function of a trial, which has the member and what it is tried in, and of a generator of random numbers: it yields a
sentence for everything that breaks it. Its name and the first line of its docstring say what it asks for.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass, is_dataclass, replace
from functools import cached_property
from inspect import isfunction
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
import numpy.typing as npt

from fpirhc.controllers.base import Controller
from fpirhc.controllers.believed import plant_model
from fpirhc.controllers.built import build, compose_controller
from fpirhc.deformation.base import with_inner
from fpirhc.describe import describe
from fpirhc.errors import FpirhcError
from fpirhc.horizon.cost import Horizon, Quadratic
from fpirhc.members import FAMILIES as FAMILIES
from fpirhc.members import Example as Example
from fpirhc.members import examples as examples
from fpirhc.members import member_classes as member_classes
from fpirhc.plant.plant import Output, Parameter, Plant
from fpirhc.simulation.run import Run
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.task.limits import Limits
from fpirhc.task.problem import Problem
from fpirhc.task.reference import Trajectory

Array: TypeAlias = npt.NDArray[Any]
Draw: TypeAlias = np.random.Generator
Broken: TypeAlias = Iterator[str]
Law: TypeAlias = Callable[[Any, Draw], Broken]


def laws_of(module: str) -> tuple[Law, ...]:
    """The laws of a family's module, in the order in which they stand there: every function that yields what breaks it."""
    own = (value for value in vars(sys.modules[module]).values() if isfunction(value) and value.__module__ == module)
    return tuple(one for one in own if one.__annotations__.get("return") == "Broken" and one.__name__[0] != "_")


def keep(trial: Any, seed: int) -> None:
    """Try the laws beside the class of a trial, each with a generator of its own; AssertionError: what breaks the first one."""
    subject = type(_member(trial)).__name__
    for law in (frozen_value, *laws_of(type(trial).__module__)):
        name = law.__name__.replace("_", " ")
        try:
            broken = next(law(trial, np.random.default_rng(seed)), "")
        except FpirhcError:
            raise
        except Exception as error:
            error.add_note(f"raised by {subject} while its law '{name}' was tried")
            raise
        if broken:
            text = (law.__doc__ or name).strip().splitlines()[0]
            raise AssertionError(f"{subject} breaks the law '{name}': {broken}. The law: {text}")


def _member(trial: Any) -> object:
    """The first field of every trial."""
    return next(iter(vars(trial).values()))


def within(value: Any, bound: float) -> bool:
    """Return whether every entry is at most `bound` in size; NaN is not."""
    return bool(np.all(np.abs(np.asarray(value, dtype=float)) <= bound))


def frozen_value(trial: Any, draw: Draw) -> Broken:
    """A member is a frozen dataclass that can be hashed, copied, built around its own inner one, and described as plain data."""
    subject = _member(trial)
    if not (is_dataclass(subject) and getattr(subject, "__dataclass_params__").frozen):  # noqa: B009
        yield "its settings can be changed after a loop was built from them; write @dataclass(frozen=True)"
    try:
        hash(subject)
    except TypeError as error:
        yield f"it cannot be hashed ({error}); use tuples for its settings, or @dataclass(frozen=True, eq=False)"
    described = describe(subject)
    if describe(deepcopy(subject)) != described:
        yield "a copy of it has another description"
    inner = getattr(subject, "inner", None)
    if inner is not None and describe(with_inner(subject, inner)) != described:
        yield "around its own inner one it has another description"
    try:
        json.dumps(described)
    except (TypeError, ValueError) as error:
        yield f"its description is no plain data ({error})"


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
        model = plant_model(self.problem, self.controller)
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
