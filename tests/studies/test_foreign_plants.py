"""Comparisons of plants of others beside an integration that shares no line with the library's loop.

Each is written as a user would write it, from its source. `by_hand` runs the same loop without the library: scipy integrates the
user's own equations, a root finder inverts them, and the tracking law and the model-referenced affine map are a few lines:

    d_k     = y^(r),N + sum_s C(r, s) rate^(r-s) (y^(s),N - y^(s))
    delta_k = delta_{k-1} + A_c / 2 (f_k - f^_k + delta_{k-1})
    u_k     = inverse of the model at d_k + delta_k, clipped

`chain` gives the derivatives of an output, differentiated by hand. The equations are the sources'; the wrong parameters and the
tasks are ours.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import comb
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import root

import fpirhc as fp

State = Mapping[str, float]
Chain = Callable[[State, Any, Any], dict[str, tuple[float, ...]]]


@dataclass(frozen=True, eq=False)
class ForeignPlant:
    """A plant with its task, the rate of the tracking law, the gain of the map, and the chains of its outputs."""

    problem: fp.Problem
    rate: float
    gain: float = -1.0
    chain: Chain | None = None  # (state, inputs, parameters) -> outputs with their derivatives; None: coordinates


def known(**values: tuple[float, float, str]) -> dict[str, fp.Parameter]:
    """Parameters from (approximate, exact, unit)."""
    return {name: fp.Parameter(*value) for name, value in values.items()}


def magnet() -> ForeignPlant:
    """A ball below an electromagnet, by its current i, squared (H. K. Khalil, Nonlinear Systems, 3rd ed. 2002, exercise 1.18)."""

    def response(q, v, u, p):
        force = p.inductance * u.current**2 / (2 * 0.05 * (1 + q.gap / 0.05) ** 2)
        return {"gap": 9.81 - (0.001 * v.gap + force) / p.mass}

    parameters = known(mass=(0.1, 0.12, "kg"), inductance=(0.01, 0.009, "H"))
    motion = fp.Trajectory(lambda t: {"gap": 0.05 + 0.01 * ca.sin(4 * t)})
    more = {"limits": fp.Limits(inputs={"current": (0.5, 12.0)}), "input_before": {"current": 6.3}}
    plant, start = fp.Plant({"gap": "m"}, {"current": "A"}, parameters, response), {"gap": 0.05, "gap'": 0.04}
    task = fp.Problem(plant, motion, start, period=2e-3, duration=1.0, measure_from=0.5, **more)
    return ForeignPlant(task, rate=15.0, gain=-0.6)


def stocking() -> ForeignPlant:
    """Adult and young fish, caught and set out: a map (Beverton and Holt 1957; stages as in H. Caswell 2001)."""

    def following(x, u, p):
        return {
            "adults": p.s * x.adults + p.m * x.young - p.q * x.adults * u.effort,
            "young": p.b * x.adults / (1 + x.adults / p.K) + u.stocked,
        }

    def chain(x, u, p):
        adults = p.s * x["adults"] + p.m * x["young"] - p.q * x["adults"] * u.effort
        young = p.b * x["adults"] / (1 + x["adults"] / p.K) + u.stocked
        return {"adults": (x["adults"], adults - x["adults"]), "young": (x["young"], young - x["young"])}

    plant = fp.Plant.discrete(
        states={"adults": "kt", "young": "kt"},
        inputs={"effort": "kd", "stocked": "kt"},
        parameters=known(
            s=(0.7, 0.8, "1"), m=(0.6, 0.5, "1"), q=(0.3, 0.4, "1/kd"), b=(0.8, 1.0, "1"), K=(60.0, 50.0, "kt")
        ),
        next=following,
        step=1.0,
        outputs={"adults": fp.Output("kt", lambda x, p: x.adults), "young": fp.Output("kt", lambda x, p: x.young)},
        time_unit="year",
    )
    motion = fp.Trajectory(lambda t: {"adults": 60.0 + 8.0 * ca.sin(0.2 * t), "young": 40.0 + 4.0 * ca.sin(0.3 * t)})
    limits, start = fp.Limits(inputs={"effort": (0.0, 3.0), "stocked": (0.0, 100.0)}), {"adults": 55.0, "young": 38.0}
    task = fp.Problem(plant, motion, start, period=1.0, duration=80.0, measure_from=20.0, limits=limits)
    return ForeignPlant(task, rate=0.5, chain=chain)


# --- The independent loop ---------------------------------------------------------------------------------------------


def by_hand(one: ForeignPlant, *, adaptive: bool) -> dict[str, np.ndarray]:
    """Return the errors of the controlled quantities at the beginning of every cycle, by name."""
    problem, plant = one.problem, one.problem.plant
    model, exact = (_parameters(plant, which) for which in ("approximate", "exact"))
    low, high = (np.array(ends) for ends in zip(*(problem.limits.inputs[name] for name in plant.inputs), strict=True))
    x, u = np.array([problem.start.get(e, 0.0) for e in plant.state.elements]), problem.inputs_before
    delta: np.ndarray | None = None
    seen, errors = None, []
    for cycle in range(problem.cycles):
        measured = _chain(one, x, u, exact)
        desired, error = _desired(one, measured, cycle * problem.period)
        errors.append(error)
        if plant.step is None and cycle:
            seen = (_last(measured), _last(_chain(one, x, u, model)))
        delta = _delta(one.gain, delta, seen) if adaptive else None
        wanted = desired + (0.0 if delta is None else delta)
        u = root(lambda v, x=x, wanted=wanted: _last(_chain(one, x, v, model)) - wanted, u, tol=1e-13).x
        u = np.clip(u, low, high)
        if plant.step is not None:  # a map's response is known when its step is done
            seen = (_last(_chain(one, x, u, exact)), _last(_chain(one, x, u, model)))
        x = _moved(one, x, u, exact)
    return {name: np.array([e[name] for e in errors]) for name in errors[0]}


def _delta(gain: float, before: np.ndarray | None, seen: tuple[np.ndarray, np.ndarray] | None) -> np.ndarray | None:
    """The next deformation; None before anything was seen."""
    if seen is None:
        return None
    before = np.zeros_like(seen[0]) if before is None else before
    return before + 0.5 * gain * (seen[0] - seen[1] + before)


def _desired(
    one: ForeignPlant, measured: Mapping[str, tuple[float, ...]], t: float
) -> tuple[np.ndarray, dict[str, float]]:
    """The tracking law's response and the errors."""
    responses, errors = [], {}
    for name, values in measured.items():
        order = len(values) - 1
        nominal = _nominal(one.problem, name, order, t)
        gains = [comb(order, s) * one.rate ** (order - s) for s in range(order)]
        responses.append(nominal[order] + sum(k * (nominal[s] - values[s]) for s, k in enumerate(gains)))
        errors[name] = nominal[0] - values[0]
    return np.array(responses), errors


def _nominal(problem: fp.Problem, name: str, order: int, t: float) -> list[float]:
    """The reference and its derivatives, or its differences on a map, by differentiating the user's own expression."""
    symbol = ca.SX.sym("t")
    motion = problem.reference.motion  # type: ignore[attr-defined]  # every reference here is a Trajectory
    value = motion(symbol)[name]
    if problem.plant.step is not None:
        ahead = [float(ca.evalf(ca.substitute(value, symbol, t + k * problem.plant.step))) for k in (0, 1)]
        return [ahead[0], (ahead[1] - ahead[0]) / problem.plant.step]
    values = []
    for _ in range(order + 1):
        values.append(float(ca.evalf(ca.substitute(value, symbol, t))))
        value = ca.gradient(value, symbol)
    return values


def _parameters(plant: fp.Plant, which: str) -> SimpleNamespace:
    return SimpleNamespace(**{name: getattr(one, which) for name, one in plant.parameters.items()})


def _named(names: Mapping[str, str], values: np.ndarray) -> SimpleNamespace:
    return SimpleNamespace(**dict(zip(names, map(float, values), strict=True)))


def _rates(plant: fp.Plant, x: np.ndarray, u: np.ndarray, p: SimpleNamespace) -> dict[str, float]:
    """The user's own function, in numbers; of a map the next state."""
    count = len(plant.coordinates)
    lower = [_named(plant.coordinates, x[k : k + count]) for k in range(0, len(x), count)]
    return {name: float(value) for name, value in plant.response(*lower, _named(plant.inputs, u), p).items()}


def _chain(one: ForeignPlant, x: np.ndarray, u: np.ndarray, p: SimpleNamespace) -> dict[str, tuple[float, ...]]:
    """Every controlled quantity with its derivatives."""
    plant = one.problem.plant
    state = dict(zip(plant.state.elements, map(float, x), strict=True))
    if one.chain is not None:
        return one.chain(state, _named(plant.inputs, u), p)
    rates, order = _rates(plant, x, u, p), plant.orders[0]
    return {c: (*(state[c + "'" * k] for k in range(order)), rates[c]) for c in plant.controlled_names}


def _last(chain: Mapping[str, tuple[float, ...]]) -> np.ndarray:
    """The highest derivatives."""
    return np.array([values[-1] for values in chain.values()])


def _moved(one: ForeignPlant, x: np.ndarray, u: np.ndarray, p: SimpleNamespace) -> np.ndarray:
    """The state one cycle later."""
    plant, count = one.problem.plant, len(one.problem.plant.coordinates)
    if plant.step is not None:
        return np.array(list(_rates(plant, x, u, p).values()))

    def derivative(_: float, state: np.ndarray) -> np.ndarray:
        return np.concatenate([state[count:], list(_rates(plant, state, u, p).values())])

    return np.asarray(
        solve_ivp(derivative, (0, one.problem.period), x, method="DOP853", rtol=1e-10, atol=1e-12).y[:, -1]
    )


# --- Beside each other ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plant", [magnet, stocking])
def test_errors_are_those_of_an_independent_integration(plant):
    """A force by the square of its input, and a map of two outputs."""
    one = plant()
    law, adapted = fp.ComputedTorque(fp.Exponential(one.rate, integral=False)), fp.ModelReferenced(fp.Affine(one.gain))
    late = np.arange(one.problem.cycles) * one.problem.period >= one.problem.measure_from - 1e-9
    for controller in (law, law.with_deformation(adapted)):
        found = fp.measure(one.problem, fp.simulate(one.problem, controller, seed=0, compiled=False))
        errors = by_hand(one, adaptive=controller is not law)
        rms = {c: float(np.sqrt(np.mean(e[late] ** 2))) for c, e in errors.items()}
        assert dict(found.rms_error) == pytest.approx(rms, rel=1e-4)
