"""Small plants that several tests share."""

from typing import Any

import casadi as ca

import fpirhc as fp
from fpirhc.contracts import Controller


def linear(gain: float, believed: float) -> fp.Plant:
    """Y'' = gain u with a wrong gain: the response Jacobian is gain / believed."""
    return fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        parameters={"b": fp.Parameter(approximate=believed, exact=gain, unit="1/kg")},
        response=lambda q, v, u, p: {"y": p.b * u.u},
    )


def sine_of_three(gain: float = 1.6) -> fp.Problem:
    """A mass along sin 3 t for 3 s, by a model of gain 1."""
    sine = fp.Trajectory(lambda t: {"y": ca.sin(3 * t)})
    start = {"y": 0.0, "y'": 3.0}
    return fp.Problem(linear(gain, 1.0), sine, start, period=1e-3, duration=3.0, measure_from=1.0)


def heavy(
    believed: float, exact: float, spring: tuple[float, float] | None = None, *, q: str = "q", u: str = "u"
) -> fp.Plant:
    """M q'' = u - k q, on a spring or without one, with a wrong mass and stiffness."""
    parameters = {"m": fp.Parameter(believed, exact, "kg")} | ({"k": fp.Parameter(*spring, "N/m")} if spring else {})
    return fp.Plant(
        {q: "m"}, {u: "N"}, parameters, lambda x, v, f, p: {q: (f[u] - (p.k * x[q] if spring else 0)) / p.m}
    )


def pendulum(mass: float = 1.0, believed: float = 1.4) -> fp.Plant:
    """A pendulum with a torque, q measured from hanging down."""
    return fp.Plant(
        coordinates={"angle": "rad"},
        inputs={"torque": "N m"},
        parameters={
            "m": fp.Parameter(approximate=believed, exact=mass, unit="kg"),
            "l": fp.Parameter(approximate=0.5, exact=0.6, unit="m"),
        },
        response=lambda q, v, u, p: {
            "angle": (u.torque - 0.1 * v.angle) / (p.m * p.l**2) - 9.81 / p.l * ca.sin(q.angle)
        },
    )


def swing(plant: fp.Plant | None = None, /, **settings: Any) -> fp.Problem:
    """The pendulum along a sine for 3 s."""
    usual: dict[str, Any] = {"start": {"angle": 0.0}, "period": 1e-3, "duration": 3.0, "measure_from": 1.0}
    sine = fp.Trajectory(lambda t: {"angle": 0.5 * ca.sin(2 * t)})
    return fp.Problem(**({"plant": plant or pendulum(), "reference": sine} | usual | settings))


def chain(order: int) -> fp.Plant:
    """A chain of integrators of any order: y^(order) = u / m."""
    responses: dict[int, Any] = {
        1: lambda q, u, p: {"y": u.u / p.m},
        2: lambda q, v, u, p: {"y": u.u / p.m},
        3: lambda q, v, a, u, p: {"y": u.u / p.m},
        4: lambda q, v, a, j, u, p: {"y": u.u / p.m},
    }
    return fp.Plant({"y": "m"}, {"u": "N"}, {"m": fp.Parameter(1.0, 1.0, "kg")}, responses[order], order=order)


def known(number: float | None) -> float:
    """A number of a plan that is finite."""
    assert number is not None
    return number


def simulated(problem: fp.Problem, controller: Controller, seed: int = 0) -> fp.Run:
    """A run in the virtual machine: most runs of tests are shorter than their compilation."""
    return fp.simulate(problem, controller, seed=seed, compiled=False)
