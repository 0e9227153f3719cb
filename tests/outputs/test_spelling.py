"""A plant is the same plant, and its twin the same, whether written in (y, y', ..., y^(r-1)) or by its states with the output y."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import tasks
from helpers.forms import named_again, with_arguments
from helpers.kinds import slow_but
from helpers.on_problem import on_problem
from helpers.plants import simulated

import fpirhc as fp
from fpirhc.conformance import examples
from fpirhc.contracts import Controller

# Coordinates as outputs

TRACK, MAP = fp.Exponential(rate=6.0), fp.Sigmoid(gain=-0.5, scale=20.0)
PUSHED = {
    "disturbances": {"q1": fp.Formula(lambda t: 0.5 * ca.sin(2 * np.pi * 3.0 * t)), "Q2": fp.Step(at=0.01, size=5.0)}
}
LATE = {"dead_time": fp.DeadTime(inputs={"Q1": 3e-3, "Q2": 3e-3}, measurement=2e-3)}
AIMS = {"reference": fp.Setpoint({"q1": [(0.0, 2.2), (0.01, 2.4)], "q2": [(0.0, 5.4), (0.02, 5.3)]}, rate=10.0)}
NOISES = {"q1": 1e-3, "q2": 1e-3, "q1'": 1e-2, "q2'": 1e-2, "q1''": 0.1, "q2''": 0.1}
FILTER = fp.DisturbanceKalman({"q1": 5.0, "q2": 5.0}, NOISES)


def on_two_mass(controller: Controller | str, changes: dict[str, Any]) -> tuple[Controller, fp.Problem]:
    """A controller, or a shipped one by its name, and the problem with changes; a reality of None is the plant itself."""
    task = tasks.two_mass
    own = {"reality": fp.Reality(task.problem.plant)} if "reality" in changes else changes
    return task.controllers[controller] if isinstance(controller, str) else controller, replace(task.problem, **own)


LOOPS: dict[str, Callable[[], tuple[Controller, fp.Problem]]] = {
    **{f"{type(e).__name__}-{k}": partial(on_problem, e)
       for k, e in enumerate(examples("controllers", fp.ComputedTorque(TRACK, MAP)))},
    **{
        name: partial(on_two_mass, controller, changes)
        for name, controller, changes in (
            ("rate", fp.rivals.ResolvedAccelerationRate(rate=6.0), {}),  # the measured responses move the states of a wrong model
            ("disturbed", "RHC+FPI", PUSHED),
            ("plan", fp.RecedingHorizon(fp.FixedPointSolver(iterations=3, tolerance=1e-2), MAP, TRACK), {}),
            ("late", "RHC+FPI", LATE),
            ("paired", fp.Predicted(fp.ComputedTorque(TRACK, fp.Paired(MAP, cycles=5)), inputs=3e-3, measurement=2e-3), LATE),
            ("at once", fp.Estimating(fp.ComputedTorque(TRACK), FILTER, at_once=True), {}),
            ("set-points", "CTC+FPI (eq 6)", AIMS),
            ("plans to set-points", "RHC+FPI", AIMS),
            ("reality", fp.ComputedTorque(TRACK, fp.ModelReferenced(MAP)), {"reality": None}),
        )
    },
}  # fmt: skip


@pytest.mark.parametrize("name", slow_but(LOOPS, *list(LOOPS)[::2]))
def test_coordinates_as_outputs_change_no_signal(name: str) -> None:
    """Of any controller, bit by bit. A schedule of slots gives every output a reference, and every coordinate at its time."""
    controller, problem = LOOPS[name]()
    short = replace(problem, duration=40 * problem.period, measure_from=0.0)
    plain, run = (simulated(p, controller, seed=1) for p in (short, named_again(short)))
    slots = isinstance(controller, fp.Slotted)
    different = {n for n in plain.layout.names if not np.array_equal(plain[n], run[n], equal_nan=True)}
    assert different <= ({"reference", "desired", "deformed", "realised_of_slots"} if slots else set())
    assert slots or np.array_equal(run["output"], run["state"])
    assert np.ptp(run["command"], axis=0).max() > 0


# Plants whose outputs are linear in the state, and the same plants with their outputs as coordinates.

UNIT = "1"


def chain(order: int, wrong: Sequence[float]) -> fp.Plant:
    """x_k' = -a_k x_k + x_{k+1}, the last one -b x^3 + sin x_0 + u; y = x_0."""
    last, numbers = order - 1, {**{f"a{k}": 1.0 + 0.3 * k for k in range(order - 1)}, "b": 0.4}

    def rates(x: Any, u: Any, p: Any) -> dict[str, Any]:
        moves = {f"x{k}": x[f"x{k + 1}"] - p[f"a{k}"] * x[f"x{k}"] for k in range(last)}
        return {**moves, f"x{last}": u.u - p.b * x[f"x{last}"] ** 3 + ca.sin(x.x0)}

    return fp.Plant.of_states(
        states={f"x{k}": UNIT for k in range(order)},
        inputs={"u": UNIT},
        parameters={n: fp.Parameter(v * w, v, UNIT) for (n, v), w in zip(numbers.items(), wrong, strict=True)},
        rates=rates,
        outputs={"y": fp.Output(UNIT, lambda x, p: x.x0)},
    )


def unequal(wrong: Sequence[float]) -> fp.Plant:
    """Two outputs of orders 2 and 1, of 1 and of 1000 in their units, which both inputs move."""
    numbers = {"a": 1.0, "b": 0.5, "c": 0.8}
    return fp.Plant.of_states(
        states={"x0": UNIT, "x1": UNIT, "w": UNIT},
        inputs={"u": UNIT, "s": UNIT},
        parameters={n: fp.Parameter(v * k, v, UNIT) for (n, v), k in zip(numbers.items(), wrong, strict=True)},
        rates=lambda x, u, p: {
            "x0": x.x1 - p.a * x.x0 + 0.3 * x.w,
            "x1": u.u + 0.4 * u.s - p.b * x.x1**3,
            "w": u.s - 0.2 * u.u - p.c * x.w + 0.5 * ca.sin(x.x0),
        },
        outputs={"y": fp.Output(UNIT, lambda x, p: x.x0), "z": fp.Output("10^-3", lambda x, p: 1e3 * x.w)},
    )


def in_outputs(plant: fp.Plant) -> fp.Plant:
    """The plant with its outputs as coordinates: y^(r) = L_f^r h(x, u, p) at the x that has y, y', ..., y^(r-1)."""
    x, u, p = plant.symbols()
    seen = plant.equations.output(x, ca.SX.zeros(u.numel()), p, ca.SX.zeros(x.numel()))
    slope = ca.Function("slope", [p], [ca.jacobian(seen, x)])

    def response(*arguments: Any) -> Mapping[str, Any]:
        *derivatives, inputs, parameters = arguments
        z = ca.vertcat(*(derivatives[e.count("'")][e.rstrip("'")] for e in plant.output.elements))
        state = ca.solve(slope(parameters.vector), z)
        values = plant.equations.controlled_response(state, inputs.vector, parameters.vector)
        return dict(zip(plant.outputs, ca.vertsplit(values), strict=True))

    with_arguments(response, [f"d{k}" for k in range(max(plant.chains.values()))] + ["u", "p"])
    units = {name: one.unit for name, one in plant.outputs.items()}
    return fp.Plant(units, plant.inputs, plant.parameters, response, order=plant.chains)


def both(plant: fp.Plant, start: Mapping[str, float] | None = None, **settings: Any) -> tuple[fp.Problem, fp.Problem]:
    """The task on the plant by its states, and on the plant in its outputs."""
    sizes = {"y": 1.0, "z": 1e3}
    weights, rate = {n: 1 / sizes[n] ** 2 for n in plant.outputs}, dict.fromkeys(plant.inputs, 1e-3)
    begin = dict.fromkeys(plant.state.elements, 0.0) | dict(start or {})
    seen = plant.equations.output(np.array(list(begin.values())), 0, plant.exact, np.zeros(len(begin)))
    common: dict[str, Any] = {
        "reference": fp.Trajectory(lambda t: {n: sizes[n] * (1 - ca.cos(1.5 * t)) for n in plant.outputs}),
        "period": 0.02,
        "duration": 0.6,
        "horizon": fp.Horizon(stages=10, step=0.1),
        "limits": fp.Limits(inputs=dict.fromkeys(plant.inputs, (-50.0, 50.0))),
        **settings,
    }
    states = fp.Problem(plant=plant, start=begin, cost=fp.Quadratic(outputs=weights, rate=rate), **common)
    first = dict(zip(plant.output.elements, seen.full().ravel(), strict=True))
    return states, fp.Problem(
        plant=in_outputs(plant), start=first, cost=fp.Quadratic(states=weights, rate=rate), **common
    )


PLANTS = {"order 2": lambda w: chain(2, w[:2]), "order 3": lambda w: chain(3, w), "orders 2 and 1": unequal}
OPTIMISER = fp.FixedPointSolver(iterations=12, tolerance=1e-11)
WHOLE = fp.ModelReferenced(fp.Affine(-2.0))  # the whole response error in one cycle: an increment of the command


def agree(states: fp.Problem, coordinates: fp.Problem, controller: Controller) -> fp.Run:
    """The run by states, after it was compared with that in the outputs."""
    run, plain = (simulated(p, controller) for p in (states, coordinates))
    for signal, same in (("output", "state"), ("command", "command"), ("realised", "realised"), ("planned", "planned")):
        scale = np.abs(plain[same]).max(axis=0)
        np.testing.assert_allclose(run[signal] / scale, plain[same] / scale, atol=1e-9)
    return run


REPLANNING = {"measured": None, "own": fp.Exponential(rate=4.0)}


@pytest.mark.parametrize("way", slow_but(REPLANNING, "own"))
@pytest.mark.parametrize("name", PLANTS)
def test_adaptive_plans_on_a_plant_are_those_on_the_plant_in_its_outputs(name: str, way: str) -> None:
    wrong = np.random.default_rng(1).uniform(0.6, 1.6, 3)
    run = agree(*both(PLANTS[name](wrong)), fp.RecedingHorizon(OPTIMISER, WHOLE, REPLANNING[way]))
    assert np.abs(run["command_shift"]).max() > 0.1


@pytest.mark.parametrize("name", PLANTS)
def test_so_are_tracked_plans_without_adaptation(name: str) -> None:
    """From a start at which model and plant have other derivatives; what the law adds is passed through the same inverse."""
    wrong = np.random.default_rng(3).uniform(0.6, 1.6, 3)
    states, coordinates = both(PLANTS[name](wrong), {"x0": 0.4, "x1": -0.2})
    run = agree(states, coordinates, fp.RecedingHorizon(OPTIMISER, tracking=REPLANNING["own"]))
    assert np.abs(run["desired"] - run["nominal"]).max() > 0.1


# Twins of plants with outputs: a model-referenced form behind estimators and dead time of outputs
PLAIN = fp.ComputedTorque(fp.Exponential(rate=8.0))
REFERENCED = PLAIN.with_deformation(fp.ModelReferenced(fp.Sigmoid(gain=-0.3, scale=60.0)))
ESTIMATORS = (fp.VelocityDifference(), fp.PositionDifference(), fp.SavitzkyGolay(window=5, degree=3))
BOTH = fp.DeadTime(inputs={"u": 2e-3}, measurement=2e-3)
WAITS = {"none": fp.DeadTime(), "inputs": fp.DeadTime(inputs={"u": 3e-3}), "both": BOTH, "predicted": BOTH}
HAND = fp.Plant(
    {"q": "rad"},
    {"u": "N m"},
    {"J": fp.Parameter(1.3, 1.3, "kg m^2"), "L": fp.Parameter(1.0, 1.0, "m")},
    lambda q, v, u, p: {"q": (u.u - 5 * ca.sin(q.q)) / p.J},
    outputs={"y": fp.Output("m", lambda q, v, p: p.L * ca.sin(q.q) + 0.1 * q.q)},
)


@pytest.mark.parametrize("wait", WAITS)
@pytest.mark.parametrize("estimator", ESTIMATORS, ids=repr)
def test_an_exact_model_is_left_alone(estimator, wait):
    """Late, rounded and smoothed alike, the two responses are the same number, to rounding.

    Under a prediction the controller acts on outputs ahead, and the twin compares those of the samples.
    """
    quanta = {"y": fp.Sensor(quantum=1e-5)} if isinstance(estimator, fp.PositionDifference) else {}
    sensed: dict[str, Any] = {"sensing": fp.Sensing(quanta, estimator), "dead_time": WAITS[wait]}
    sine, limits = fp.Trajectory(lambda t: {"y": 0.5 * ca.sin(2 * t)}), fp.Limits(inputs={"u": (-60.0, 60.0)})
    late = fp.Problem(HAND, sine, {"q": 0.0, "q'": 1.0}, period=1e-3, duration=0.15, limits=limits, **sensed)
    both: list[Controller] = [PLAIN, REFERENCED]
    both = [fp.Predicted(c, inputs=2e-3, measurement=2e-3) for c in both] if wait == "predicted" else both
    one, other = (simulated(late, controller) for controller in both)
    assert one.stop is other.stop is None
    np.testing.assert_allclose(other["plant_output"], one["plant_output"], atol=1e-9)
