"""Every form of a problem: one thing to be moved, y follows 0.5 sin 2t, and its mass is believed 15 % too large."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

import fpirhc as fp

CYCLE, CYCLES = 5e-3, 480
PARAMETERS = {"m": fp.Parameter(1.15, 1.0, "kg"), "k": fp.Parameter(2.0, 3.0, "N/m")}


def chain(order: int) -> fp.Plant:
    responses: dict[int, Any] = {
        1: lambda q, u, p: {"y": (u.F - p.k * q.y) / p.m},
        2: lambda q, v, u, p: {"y": (u.F - p.k * ca.sin(q.y)) / p.m},
        3: lambda q, v, a, u, p: {"y": (u.F - p.k * q.y - 3 * v.y - 2 * a.y) / p.m},
    }
    return fp.Plant({"y": "m"}, {"F": "N"}, PARAMETERS, responses[order], order=order)


def of_states(states: Mapping[str, str], rates: Callable[..., Any], y: Callable[..., Any]) -> fp.Plant:
    outputs = {"y": fp.Output("m", y)}
    return fp.Plant.of_states(states=states, inputs={"F": "N"}, parameters=PARAMETERS, rates=rates, outputs=outputs)


MASS = of_states(
    {"a": "m", "w": "m/s"}, lambda x, u, p: {"a": x.w, "w": (u.F - p.k * ca.sin(x.a)) / p.m}, lambda x, p: x.a
)
CURVE = of_states({"x": "m"}, lambda x, u, p: {"x": (u.F - p.k * x.x) / p.m}, lambda x, p: p.m * x.x + 0.1 * x.x**3)
AT_ONCE = of_states({"x": "N"}, lambda x, u, p: {"x": 20 * (u.F - x.x)}, lambda x, u, p: p.m * u.F + 0.3 * x.x)
STEPS = fp.Plant.discrete(
    states={"x": "m", "z": "m/s"},
    inputs={"F": "N"},
    parameters=PARAMETERS,
    next=lambda x, u, p: {"x": x.x + CYCLE * x.z, "z": x.z + CYCLE * (u.F - p.k * x.x) / p.m},
    step=CYCLE,
    outputs={"y": fp.Output("m", lambda x, p: x.x)},
)


class Body:
    """The mass, integrated by hand."""

    def reset(self, seed: int) -> Any:
        del seed
        self.state = np.array([0.1, 0.0])
        return self._seen(0.0)

    def step(self, time: float, command: Any) -> Any:
        del time
        for _ in range(10):
            self.state[1] += CYCLE / 10 * (command[0] - 3 * np.sin(self.state[0]))
            self.state[0] += CYCLE / 10 * self.state[1]
        return self._seen(command[0])

    def _seen(self, force: float) -> Any:
        return np.array([*self.state, force - 3 * np.sin(self.state[0])])


def moved(plant: fp.Plant, order: int, /, **settings: Any) -> tuple[fp.Problem, int]:
    """A problem of the plant, and the order of y."""
    of = "outputs" if plant.outputs else "states"
    start = {n: 0.1 if k == 0 else 0.0 for k, n in enumerate(plant.state.elements)}
    usual: dict[str, Any] = {
        "horizon": fp.Horizon(stages=6, step=10 * CYCLE),
        "cost": fp.Quadratic(**{of: {"y": 100.0}}, effort={"F": 1e-3}),
        "limits": fp.Limits(inputs={"F": (-60.0, 60.0)}),
    }
    sine = fp.Trajectory(lambda t: {"y": 0.5 * ca.sin(2 * t)})
    return fp.Problem(
        plant, sine, start, period=CYCLE, duration=CYCLES * CYCLE, measure_from=0.0, **usual | settings
    ), order


def filtered(speed: str) -> fp.KalmanFilter:
    """What believes a speed from y."""
    return fp.KalmanFilter(measured={"y": 1e-3}, noise={speed: 5.0})


LATE: dict[str, Any] = {"dead_time": fp.DeadTime(inputs={"F": CYCLE}, measurement=CYCLE)}
ENCODER: dict[str, Any] = {"sensors": {"y": fp.Sensor()}, "estimator": fp.PositionDifference()}
SEEN = {"y": "m", "y'": "m/s", "y''": "m/s^2"}
FORMS = {
    "order 1": moved(chain(1), 1),
    "order 2": moved(chain(2), 2),
    "order 3": moved(chain(3), 3),
    "states": moved(MASS, 2),
    "curve": moved(CURVE, 1),
    "at once": moved(AT_ONCE, 0),
    "map": moved(STEPS, 2),
    "late": moved(chain(2), 2, **LATE),
    "late curve": moved(CURVE, 1, **LATE),
    "encoder": moved(chain(2), 2, sensing=fp.Sensing(**ENCODER)),
    "believed": moved(MASS, 2, sensing=fp.Sensing(**ENCODER, measured=("y",), observer=filtered("w"))),
    "believed map": moved(STEPS, 2, sensing=fp.Sensing(measured=("y",), observer=filtered("z"))),
    "reality": moved(chain(2), 2, reality=fp.Reality(MASS, start={"a": 0.1, "w": 0.0})),
    "outside": moved(chain(2), 2, reality=fp.ExternalPlant(Body(), measures=SEEN)),
}


def with_arguments(function: Any, names: Sequence[str]) -> Any:
    """The function, which says that it takes these arguments."""
    kind = inspect.Parameter.POSITIONAL_ONLY
    vars(function)["__signature__"] = inspect.Signature([inspect.Parameter(n, kind) for n in names])
    return function


def named_again(problem: fp.Problem) -> fp.Problem:
    """The problem with its coordinates as outputs."""
    names = [f"d{k}" for k in range(max(problem.plant.orders))] + ["p"]

    def of(coordinate: str) -> Any:
        return with_arguments(lambda q, *rest: q[coordinate], names)

    plant = replace(problem.plant, outputs={n: fp.Output(unit, of(n)) for n, unit in problem.plant.coordinates.items()})
    cost = problem.cost
    cost = replace(cost, states={}, outputs=cost.states) if isinstance(cost, fp.Quadratic) else cost
    return replace(problem, plant=plant, cost=cost, reality=problem.reality and fp.Reality(plant))
