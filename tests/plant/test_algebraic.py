"""Algebraic states by Newton's method inside the response, against IDAS, and against equations that are solved by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import brentq

import fpirhc as fp
from fpirhc.errors import InvalidProblem

THERMAL = 0.05  # V, emission coefficient times thermal voltage
SATURATION = 3e-7  # A


def diode(u, p, z):
    """Currents into the node before the resistor of the capacitor: from the source, through the diode, to the capacitor."""
    return (u.source - z.node) / p.source_resistor - SATURATION * (ca.exp(z.node / THERMAL) - 1)


def clipper(*, steps: int = 40, guess: Any = None, equations: Any = None) -> fp.Plant:
    """A source, a diode to ground, and a capacitor behind a resistor; the node's voltage has no dynamics."""

    def node(q, u, p, z):
        return {"node": diode(u, p, z) - (z.node - q.v) / p.resistor}

    return fp.Plant(
        coordinates={"v": "V"},
        inputs={"source": "V"},
        order=1,
        response=lambda q, u, p, z: {"v": (z.node - q.v) / (p.resistor * p.capacity)},
        parameters={
            "source_resistor": fp.Parameter(approximate=120.0, exact=100.0, unit="Ohm"),
            "resistor": fp.Parameter(approximate=1000.0, exact=1300.0, unit="Ohm"),
            "capacity": fp.Parameter(approximate=1e-6, exact=1.2e-6, unit="F"),
        },
        algebraic=fp.Algebraic(
            units={"node": "V"},
            equations=equations or node,
            guess=guess or (lambda q, u, p: {"node": ca.fmin(u.source, 0.7)}),
            steps=steps,
        ),
    )


def task(plant: fp.Plant, **changes: Any) -> fp.Problem:
    """Follow a sine below the voltage at which the diode takes everything."""
    values = {
        "plant": plant,
        "reference": fp.Trajectory(lambda t: {"v": 0.35 + 0.15 * ca.sin(200 * t)}),
        "start": {"v": 0.3},
        "period": 1e-4,
        "duration": 0.05,
        "limits": fp.Limits(inputs={"source": (-2.0, 3.0)}),
        "integrator": fp.RungeKutta4(4),
    }
    return fp.Problem(**{**values, **changes})


ADAPTIVE = fp.ComputedTorque(fp.Exponential(rate=300.0), fp.Affine(gain=-0.5))


def test_the_plant_moves_as_idas_says():
    """SUNDIALS IDAS integrates the equations as they stand, with the logged commands."""
    problem = task(clipper())
    run = fp.simulate(problem, ADAPTIVE, seed=1)
    assert run.stop is None
    exact = problem.plant.exact
    v, node, u = ca.SX.sym("v"), ca.SX.sym("node"), ca.SX.sym("u")
    equations = {
        "x": v,
        "z": node,
        "p": u,
        "ode": (node - v) / (exact[1] * exact[2]),
        "alg": (u - node) / exact[0] - SATURATION * (ca.exp(node / THERMAL) - 1) - (node - v) / exact[1],
    }
    idas = ca.integrator("idas", "idas", equations, 0.0, problem.period, {"reltol": 1e-11, "abstol": 1e-12})
    balance = ca.Function("balance", [v, node, u], [equations["alg"]])
    state, errors = float(run["state.v"][0]), []
    for k, command in enumerate(run["command.source"][:-1]):
        node_at_start = brentq(lambda z, x=state, u=command: float(balance(x, z, u)), -3.0, 3.0, xtol=1e-14)
        state = float(idas(x0=state, z0=node_at_start, p=command)["xf"])
        errors.append(state - run["state.v"][k + 1])
    assert np.abs(errors).max() < 1e-7
    assert run["command.source"].max() > 1.0  # the diode conducts: without it the command stays near the node


def test_adaptation_works_on_a_plant_with_algebraic_states():
    """The relative order, the inverse by Newton's method and the deformation see the response through the algebraic state."""
    problem = task(clipper(), measure_from=0.02)
    plain, adapted = (
        fp.simulate(problem, c, seed=1)["error.v"][200:] for c in (ADAPTIVE.with_deformation(fp.Identity()), ADAPTIVE)
    )
    assert np.sqrt(np.mean(adapted**2)) < 0.3 * np.sqrt(np.mean(plain**2))


def test_affine_equations_equal_those_that_are_solved_by_hand():
    """A resistor in place of the diode: one step is exact, and the response stays affine."""
    network = clipper()

    def node(q, u, p, z):
        return {"node": (u.source - z.node) / p.source_resistor - z.node / 500.0 - (z.node - q.v) / p.resistor}

    def by_hand(q, u, p):
        total = 1 / p.source_resistor + 1 / 500.0 + 1 / p.resistor
        node = (u.source / p.source_resistor + q.v / p.resistor) / total
        return {"v": (node - q.v) / (p.resistor * p.capacity)}

    assert network.algebraic is not None
    solved = replace(network, algebraic=replace(network.algebraic, equations=node, guess={"node": 0.2}))
    hand = replace(network, algebraic=None, response=by_hand)
    assert solved.equations.affine
    assert not network.equations.affine
    horizon = {
        "horizon": fp.Horizon(stages=8, step=2e-4),
        "cost": fp.Quadratic(states={"v": 1e4}, deviation={"source": 1.0}),
    }
    rhc = fp.RecedingHorizon(fp.FixedPoint(iterations=3, tolerance=1e-8), fp.Affine(gain=-0.5))
    for controller in (ADAPTIVE, rhc):
        runs = [fp.simulate(task(p, **horizon, duration=0.01), controller, seed=1) for p in (solved, hand)]
        assert runs[0]["state.v"] == pytest.approx(runs[1]["state.v"], abs=1e-11)
        assert runs[0]["command.source"] == pytest.approx(runs[1]["command.source"], abs=1e-8)


def test_the_solution_solves_the_equations_from_a_far_guess_or_is_not_a_number():
    """Never a value in between: with too few steps the response is NaN."""
    plant, few = clipper(), clipper(steps=2, guess={"node": 2.0})
    for source in np.linspace(-2.0, 3.0, 26):
        z = float(plant.equations.algebraic([0.3], [source], plant.exact))
        left = (source - z) / 100 - SATURATION * (np.exp(z / THERMAL) - 1) - (z - 0.3) / 1300
        assert abs(left) < 1e-12
        assert np.isnan(float(few.equations.algebraic([0.3], [source], few.exact)))
        assert np.isnan(float(few.equations.response([0.3], [source], few.exact)))


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "too few steps": ({"steps": 2, "guess": {"node": 2.0}}, "does not arrive at node in 2 steps; give a nearer guess"),
    "index above one": (
        {"equations": lambda q, u, p, z: {"node": u.source - q.v + 0 * z.node}},
        "singular .index above 1",
    ),
    "no equation": ({"equations": lambda q, u, p, z: {"nod": z.node}}, "'nod' is unknown.*'node'"),
    "no guess": ({"guess": {"knot": 1.0}}, "guess have nothing for 'node'"),
    "wrong name inside": ({"equations": lambda q, u, p, z: {"node": z.note}}, "'note' is unknown.*'node'"),
}


@pytest.mark.parametrize("name", BAD)
def test_mistakes_are_named_before_a_run(name):
    changes, text = BAD[name]
    with pytest.raises(InvalidProblem, match=text):
        task(clipper(**changes))


def test_the_response_takes_the_algebraic_states_last():
    plant = clipper()
    with pytest.raises(InvalidProblem, match=r"called as response\(q, u, p, z\)"):
        replace(plant, response=lambda q, u, p: {"v": -q.v + u.source})
