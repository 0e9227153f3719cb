"""Chains of integrators whose inertia the model gets wrong by a factor, and their closed loops from any first request."""

from __future__ import annotations

import inspect
from typing import Any

import casadi as ca
import numpy as np

import fpirhc as fp
from fpirhc.controllers.check import checked
from fpirhc.review.grid import review_grid
from fpirhc.review.loops import loops_along, points_of
from fpirhc.simulation.linearise.linear_loop import LinearLoop
from fpirhc.simulation.loop import close_loop


def chain(order: int = 2, eigenvalue: float = 1.0, period: float = 1e-3, **settings) -> fp.Problem:
    """y^(order) = u at rest, with a model that takes y^(order) for u / eigenvalue: f = eigenvalue r."""

    def respond(*arguments):
        *_, u, p = arguments
        return {"y": u.u / p.m}

    kind = inspect.Parameter.POSITIONAL_ONLY
    names = [*(f"d{k}" for k in range(order)), "u", "p"]
    response: Any = respond
    response.__signature__ = inspect.Signature([inspect.Parameter(n, kind) for n in names])
    mass = fp.Parameter(approximate=eigenvalue, exact=1.0, unit="kg")
    plant = fp.Plant(coordinates={"y": "m"}, inputs={"u": "N"}, parameters={"m": mass}, response=response, order=order)
    reference = fp.Trajectory(lambda t: {"y": 0 * t})
    return fp.Problem(plant, reference, start={"y": 0.0}, period=period, duration=100 * period, **settings)


def coupled(period: float = 1e-3) -> fp.Problem:
    """Two masses at rest with a response Jacobian that is not symmetric, eigenvalues 2.29 and 0.46."""

    def response(q, v, u, p):
        return {"q1": p.a * u.u1 + p.b * u.u2, "q2": p.c * u.u1 + p.d * u.u2}

    values = {"a": 2.0, "b": 0.9, "c": 0.5, "d": 0.75}
    parameters = {n: fp.Parameter(float(n in "ad"), v, "1/kg") for n, v in values.items()}
    inputs, coordinates = {"u1": "N", "u2": "N"}, {"q1": "m", "q2": "m"}
    plant = fp.Plant(coordinates, inputs, parameters=parameters, response=response)
    reference = fp.Trajectory(lambda t: {"q1": 0 * t, "q2": 0 * t})
    start = {"q1": 0.0, "q2": 0.0}
    return fp.Problem(plant, reference, start=start, period=period, duration=100 * period)


def linear_loop(problem: fp.Problem, controller: fp.ComputedTorque) -> LinearLoop:
    """The closed loop per cycle, tracking law and deformation in it."""
    return loops_along(review_grid(problem, 0.0, 0), controller).loops[0]


def linear_pair(problem: fp.Problem, controller: fp.ComputedTorque, gains: tuple[float, float]) -> list[np.ndarray]:
    """The closed loops per cycle of two effective gains, in the same coordinates."""
    points = points_of(review_grid(problem, 0.0, 0), controller)
    return [one.dynamics for one in points.between(0, 0, gains, held=False)]


def errors_after_request(problem: fp.Problem, controller: fp.ComputedTorque, requests, cycles: int) -> np.ndarray:
    """Response errors f - d (cycles, n, starts) of a loop at rest whose last request was each of these."""
    ready = checked(problem, controller)
    loop = close_loop(problem, ready)
    run = loop.function.mapaccum("run", cycles)
    believed = (
        np.diag(1 / ready.plant_model(problem).parameters(problem.plant)[:1]) if len(requests[0]) == 1 else np.eye(2)
    )
    collected = []
    for request in requests:
        memory = loop.memory.split(ca.DM(loop.memory.start()))
        memory["_deformed_last"], memory["warm_up"] = ca.DM(request), ca.DM(1)
        memory["_acting_before"] = ca.DM(np.linalg.solve(believed, request))
        trace = run(loop.memory.join(memory))[1].full()
        collected.append((trace[loop.trace.slice("realised")] - trace[loop.trace.slice("desired")]).T)
    return np.stack(collected, axis=-1)
