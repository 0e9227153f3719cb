"""Outputs y = h(x, p): what follows a reference may be an expression of the state."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import tasks
from helpers.of_outputs import OPTIMISER, arm, circle, hill, planned, sedated
from helpers.plants import simulated

import fpirhc as fp


def test_derivatives_of_outputs_are_those_of_the_motion() -> None:
    """y, y', y'' against differences of y along a simulated motion with the input held."""
    plant, h = arm(), 1e-3
    x, u, p, calm = np.array([0.4, 1.1, 0.7, -0.5]), np.array([0.3, -0.2]), plant.exact, np.zeros(2)
    back, ahead = (fp.RungeKutta4(substeps=4).step(plant, dt)(x, u, p, calm) for dt in (-h, h))
    before, now, after = (plant.equations.output(s, u, p, calm).full().ravel() for s in (back, x, ahead))
    assert plant.output.elements == ("x", "y", "x'", "y'")
    assert np.allclose(now[2:], (after - before)[:2] / (2 * h), atol=1e-6)
    response = plant.equations.controlled_response(x, u, p).full().ravel()
    assert np.allclose(response, (after - 2 * now + before)[:2] / h**2, atol=1e-5)
    assert np.allclose(plant.equations.inverse(x, response, p).full().ravel(), u)


def test_a_limit_of_an_output_is_kept_by_the_plan() -> None:
    low = fp.PathConstraint(lambda view: view.output.depth, lower=45.0, unit="1")
    problem = planned(limits=fp.Limits(inputs={"u": (0.0, 40.0)}, paths={"light": low}))
    run = simulated(problem, fp.ExactModel(fp.RecedingHorizon(OPTIMISER)))
    free = simulated(planned(), fp.ExactModel(fp.RecedingHorizon(OPTIMISER)))
    assert free["output.depth"].min() < 41
    assert run["output.depth"].min() > 44.9


def test_an_output_that_is_only_judged_is_measured_and_not_controlled() -> None:
    plant = hill(5.5)
    both = {**plant.outputs, "level": fp.Output("mg/l", lambda x, p: x.E)}
    plant = replace(plant, outputs=both, controlled=("depth",))
    first = sedated(hill(5.5))

    def motion(t: Any) -> dict[str, Any]:
        return {**first.reference.coordinates(t), "level": 4.0 + 0 * t}

    judged = replace(first, plant=plant, reference=fp.Trajectory(motion), judged=("depth", "level"))
    run = simulated(judged, fp.ComputedTorque(fp.Exponential(rate=1.0)))
    assert run.layout["desired"].elements == ("depth",)
    assert np.array_equal(run["true_error.level"], 4.0 - run["plant_state.E"])


# What is refused, and how

DOUBLE: dict[str, Any] = {
    "states": {"a": "m", "b": "m/s"},
    "inputs": {"u": "N"},
    "parameters": {},
    "rates": lambda x, u, p: {"a": x.b, "b": u.u},
}


def double(outputs: dict[str, fp.Output], **settings: Any) -> fp.Plant:
    """Two integrators with some outputs."""
    return fp.Plant.of_states(**{**DOUBLE, **settings}, outputs=outputs)


SQUARE = {"y": fp.Output("m^2", lambda x, p: x.a**2)}


def squared(motion: Callable[[Any], Any], **settings: Any) -> fp.Problem:
    """Y = a^2."""
    return fp.Problem(
        plant=double(SQUARE), reference=fp.Trajectory(lambda t: {"y": motion(t)}), start={"a": 1.0, "b": 0.0}, period=1e-2,
        duration=4.0, **settings,
    )  # fmt: skip


WRONG: dict[str, tuple[Callable[[], object], str]] = {
    "not reached": (lambda: double({"y": fp.Output("m", lambda x, p: 3.0 + 0 * x.a)}), "no input reaches 'y'"),
    "another expression": (lambda: double({"a": fp.Output("m", lambda x, p: 2 * x.a)}), "rename the output"),
    "arguments": (lambda: double({"y": fp.Output("m", lambda x: x.a)}), r"called as function\(x, p\)"),
    "name in it": (lambda: double({"y": fp.Output("m", lambda x, p: x.c)}), "state 'c' is unknown"),
    "controlled": (lambda: double(SQUARE, controlled=("z",)), "quantity 'z' is unknown. Valid: y"),
    "name of a state": (lambda: double(SQUARE, states={"a'": "m", "b": "m"}), "'a'' is not an identifier"),
    "name of an input": (lambda: double({"u": fp.Output("m", lambda x, p: x.a)}), "both an input and an output"),
    "no rate": (lambda: double(SQUARE, rates=lambda x, u, p: {"a": x.b}), "rates does not give the derivative b' of state 'b'"),
    "reference": (lambda: replace(squared(lambda t: 1 + 0 * t), reference=fp.Trajectory(lambda t: {"yy": t})), "mean 'y'"),
    "judged": (lambda: squared(lambda t: 1 + 0 * t, judged=("z",)), "judged: quantity 'z' is unknown"),
    "states in the cost": (lambda: squared(lambda t: 1 + 0 * t, cost=fp.Quadratic(states={"a": 1.0})), "have no reference"),
    "both in the cost": (
        lambda: replace(tasks.two_mass.problem, cost=fp.Quadratic(states={"q1": 1.0}, outputs={"q2": 1.0})),
        "states and outputs: both weigh errors",
    ),
    "reality": (lambda: replace(squared(lambda t: 1 + 0 * t), reality=fp.Reality(double({}))), "it has no 'y'"),
    "too few inputs": (
        lambda: double({**SQUARE, "b": fp.Output("m/s", lambda x, p: x.b)}).controlled_names, "cannot hold 2 outputs"
    ),
    "deviation": (
        lambda: simulated(
            planned(cost=fp.Quadratic(outputs={"depth": 1.0}, deviation={"u": 1e-3})), fp.RecedingHorizon(OPTIMISER)
        ),
        "needs the states C, E",
    ),
    "disturbance": (lambda: sedated(hill(4.0), disturbances={"deep": fp.Noise(1.0)}), "coordinate or output 'deep' is unknown"),
    "disturbance without a number": (
        lambda: sedated(hill(4.0), disturbances={"depth": fp.Formula(ca.sqrt)}), "not finite"
    ),
    "gains": (lambda: simulated(sedated(hill(5.5)), fp.PID({"deep": -1.0})), "controlled coordinate 'deep' is unknown"),
    "mechanics": (
        lambda: simulated(circle(arm()), fp.load_problem("planar_arm").controllers["AID"]), "mechanics in its own coordinates"
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", WRONG)
def test_a_mistake_is_named(mistake: str) -> None:
    make, words = WRONG[mistake]
    with pytest.raises(fp.FpirhcError, match=words):
        make()
