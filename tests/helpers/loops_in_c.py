"""Horizons on which the loops in C are compared with what the virtual machine runs, call by call and number by number."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

import fpirhc as fp
from fpirhc.conformance import compiled
from helpers.horizons import horizon_of

REST = fp.Trajectory(lambda t: {"a": 0.3 * ca.sin(t), "b": 0 * t})


@dataclass(frozen=True, eq=False)
class Pair:
    """A step as the virtual machine runs it, and the same Function as compiled loops."""

    ocp: Any
    data: np.ndarray
    graph: ca.Function
    loops: ca.Function

    @property
    def size(self) -> int:
        return int(self.graph.size1_in(4))

    def both(self, *arguments) -> Iterator[list[np.ndarray]]:
        """Plan, diagnostics and memory in the virtual machine, and by the loops."""
        for function in (self.graph, self.loops):
            yield [np.asarray(v.full()) for v in function(*arguments)]


def coupled_plant() -> fp.Plant:
    """A pendulum and a lagging disc with two motors that both feel both: three states, and nothing symmetric or zero."""
    return fp.Plant(
        coordinates={"a": "rad", "b": "rad"},
        inputs={"Ma": "N m", "Mb": "N m"},
        order={"a": 2, "b": 1},
        parameters={"k": fp.Parameter(1.3, 1.3, "1/s^2")},
        response=lambda q, v, u, p: {
            "a": u.Ma - 0.003 * u.Mb + 2.0 * ca.sin(q.a) - p.k * (q.a - q.b) - 0.1 * v.a,
            "b": 0.008 * u.Mb + 0.2 * u.Ma * ca.cos(q.b) + 0.6 * q.b**2 + p.k * (q.a - q.b) + 0.4 * v.a,
        },
    )


def _terms(v):
    error = v.state.a - v.reference.a
    return {
        "error": 60.0 * error**2 + 2.0 * v.state.b**2 + 6.0 * v.state["a'"] ** 2 + 4.0 * error**4,
        "effort": 1.5 * (v.input.Ma - v.feedforward.Ma) ** 2 + 4e-4 * v.input.Mb**2 + 0.2 * v.input.Ma**4,
        "both": 0.02 * v.input.Ma * v.input.Mb + 0.3 * v.state.b * v.input.Ma,
    }


def _terminal(v):
    return 90.0 * (v.state.a - v.reference.a) ** 2 + 40.0 * v.state.b**2 + 9.0 * v.state["a'"] ** 2


@cache
def coupled(limits: fp.Limits | None = None, stages: int = 4) -> tuple[Any, np.ndarray]:
    """The horizon of these two with a cost whose curvature changes with states and inputs, and couples them."""
    cost = fp.CustomCost(terms=_terms, terminal=_terminal)
    horizon, plant = fp.Horizon(stages=stages, step=0.15), coupled_plant()
    return horizon_of(plant, REST, horizon, cost, limits, time=0.3)


RING = [f"x{k}" for k in range(13)]  # rows of a matrix in a block of eight, one of four, and one more


@cache
def ring(limits: fp.Limits | None = None, stages: int = 3) -> tuple[Any, np.ndarray]:
    """The horizon of a ring of thirteen states, each driven by two of three inputs, whose cost is small in its unit."""

    def response(q, u, p):
        x, v = [getattr(q, name) for name in RING], [u.u0, 0.05 * u.u1, 3.0 * u.u2]
        pairs = enumerate(zip(x, x[1:] + x[:1], strict=True))
        return {
            RING[k]: p.k * ca.sin(after) - 0.3 * (k % 4) * one + 0.4 * one * after + v[k % 3] - 0.1 * k * v[(k + 1) % 3]
            for k, (one, after) in pairs
        }

    def terms(v):
        x, (a, b, c) = [v.state[name] for name in RING], (v.input.u0, 0.05 * v.input.u1, 3.0 * v.input.u2)
        error = sum((1 + k % 3) * (one - 0.1) ** 2 + 0.3 * one * x[k - 1] + 0.2 * one**4 for k, one in enumerate(x))
        return {
            "all": 1e-3 * (error + 0.4 * a * a + 0.3 * b * b + 0.6 * c * c + 0.2 * a * b - 0.1 * b * c + 0.1 * a * x[3])
        }

    inputs, gain = dict.fromkeys(("u0", "u1", "u2"), "N"), {"k": fp.Parameter(1.3, 1.3, "1/s")}
    plant = fp.Plant(dict.fromkeys(RING, "m"), inputs, gain, response, order=1, controlled=RING[:3])
    rest, cost = fp.Trajectory(lambda t: dict.fromkeys(RING, 0 * t)), fp.CustomCost(terms=terms)
    return horizon_of(plant, rest, fp.Horizon(stages=stages, step=0.15), cost, limits, time=0.3)


@cache
def pair(
    kind: str, optimiser: fp.FixedPointSolver, limits: fp.Limits | None = None, stages: int = 4, of: Any = coupled
) -> Pair:
    """Graph and loops of `step` or `converging`."""
    ocp, data = of(limits, stages)
    graph = getattr(optimiser, kind)(ocp)
    return Pair(ocp, data, graph, compiled(graph))


def within_its_arrays(pair_of: Pair, calls: Iterator[tuple[np.ndarray, ...]]) -> bool:
    """Whether the loops stay inside their arrays: compiled so that they end their process where they do not."""
    flags = ("-fsanitize=bounds", "-fsanitize-undefined-trap-on-error")
    function = compiled(pair_of.graph, flags)
    child = os.fork()
    if not child:
        for arguments in calls:
            function(*arguments)
        os._exit(0)
    return os.waitpid(child, 0)[1] == 0
