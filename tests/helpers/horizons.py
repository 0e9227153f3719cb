"""Optimal control problems that are posed by hand, and plans rolled out stage by stage."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

import fpirhc as fp
from fpirhc.conformance import posed
from helpers.plants import pendulum


def horizon_of(
    plant: fp.Plant, reference: Any, horizon: fp.Horizon, cost: Any, limits: fp.Limits | None = None, **others: Any
) -> tuple[Any, np.ndarray]:
    """The optimal control problem of these parts, and the data of its stages; `time`, `parameters` and `start` may be given."""
    start = others.pop("start", dict.fromkeys(plant.names, 0.0))
    problem = fp.Problem(
        plant, reference, start, horizon.step, horizon.step, limits=limits or fp.Limits(), horizon=horizon, cost=cost
    )
    ocp, _, data = posed(problem, **others)
    return ocp, data


@dataclass(frozen=True, eq=False)
class Rolled:
    """States (ns, N + 1), cost, and the cost of each term, of inputs from a first state: a loop of its own."""

    states: np.ndarray
    cost: float
    terms: np.ndarray


def rolled(ocp: Any, first: Any, inputs: Any, data: Any) -> Rolled:
    """The stages one after the other."""
    states, cost, terms = [np.ravel(first)], 0.0, 0.0
    for i, u in enumerate(np.asarray(inputs).T):
        value, parts = ocp.stage_cost(states[-1], u, data[:, i])
        cost, terms = cost + float(value), terms + parts.full().ravel()
        states.append(ocp.dynamics(states[-1], u, data[:, i]).full().ravel())
    cost += float(ocp.terminal_cost(states[-1], data[:, -1]))
    return Rolled(np.array(states).T, cost, np.asarray(terms))


def called(function: Any, *arguments: Any) -> list[np.ndarray]:
    """What a Function gives, as arrays: of an optimiser's step the plan, its five numbers, and the memory."""
    return [np.asarray(v.full()) for v in function(*arguments)]


def repeated(optimiser: Any, ocp: Any, data: Any, first: Any, calls: int, plan: Any = None) -> Iterator[Any]:
    """Plan and five numbers of calls with the memory of the one before, from rest or from a remembered plan."""
    step, layout = optimiser.step(ocp), optimiser.memory(ocp)
    memory = layout.start()
    if plan is not None:
        memory[layout.slice("plan_inputs")] = np.ravel(plan, order="F")
    for _ in range(calls):
        inputs, numbers, memory = called(step, first, data, ocp.input_lower, ocp.input_upper, memory)
        yield [inputs, numbers.ravel()]


PENDULUM, SWINGING = pendulum(), fp.Trajectory(lambda t: {"angle": ca.sin(2 * t)})
HORIZON = fp.Horizon(stages=12, step=0.05)
COST = fp.Quadratic(states={"angle": 10.0, "angle'": 0.1}, effort={"torque": 0.05})
SWING = fp.Quadratic(states={"angle": 0.1}, effort={"torque": 1e-3}, terminal={"angle": 10.0, "angle'": 1.0})


def pendulum_problem(
    cost: Any = COST, limits: fp.Limits | None = None, horizon: fp.Horizon = HORIZON
) -> tuple[Any, np.ndarray]:
    """A horizon of the pendulum with a wrong mass, along a sine."""
    return horizon_of(PENDULUM, SWINGING, horizon, cost, limits)


def linear_problem() -> tuple[Any, np.ndarray, np.ndarray]:
    """Ten stages of y'' = u - y, with a first state."""
    plant = fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        order=2,
        response=lambda q, v, u, p: {"y": -q.y + u.u * p.gain},
        parameters={"gain": fp.Parameter(1.0, 1.0, "1")},
    )
    cost = fp.Quadratic(states={"y": 3.0, "y'": 0.5}, effort={"u": 0.2})
    sine = fp.Trajectory(lambda t: {"y": ca.sin(t)})
    return *horizon_of(plant, sine, fp.Horizon(stages=10, step=0.1), cost), np.array([1.0, -2.0])
