"""Every kind of plant, reference and integrator runs in a loop, compiled where it can be and where it is worth it."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
from helpers.plants import swing

import fpirhc as fp
from fpirhc.symbolic.native import find_compiler

TRACK = fp.Exponential(rate=6.0)
MAPS = (
    fp.Sigmoid(gain=-0.5, scale=10.0),
    fp.RFPT(offset=1e4, sign=-1.0, gain=2e-5),
    fp.RFPTVector(offset=1e4, sign=-1.0, gain=2e-5),
    fp.Rotation(fraction=0.2, radius=1e3),
    fp.Affine(gain=-0.4),
)


def test_table_reference_is_tracked_like_the_expression_it_samples():
    """A table goes through the same loop; its look-up keeps the loop an MX graph, which still compiles."""
    times = np.linspace(0, 3, 601)
    table = swing(reference=fp.Table(times, {"angle": 0.5 * np.sin(2 * times)}))
    runs = [fp.simulate(p, fp.ComputedTorque(TRACK, MAPS[0]), seed=0) for p in (swing(), table)]
    assert runs[1].compiled == (find_compiler() is not None)
    np.testing.assert_allclose(runs[1]["state.angle"], runs[0]["state.angle"], atol=1e-6)


def test_reference_integrator_gives_the_same_run():
    """CVODES against Runge-Kutta: the same closed loop within its tolerance; it stays in the virtual machine and says so."""
    short = {"duration": 0.5, "measure_from": 0.0}
    controller = fp.ComputedTorque(TRACK, MAPS[0])
    reference = fp.simulate(swing(integrator=fp.Cvodes(1e-10), **short), controller, seed=0)
    ordinary = fp.simulate(swing(integrator=fp.RungeKutta4(2), **short), controller, seed=0)
    assert not reference.compiled
    np.testing.assert_allclose(ordinary["state"], reference["state"], atol=1e-7)


def test_plant_that_is_not_affine_in_its_input():
    """A valve with a quadratic characteristic: the inverse is found numerically, and adaptation works on it."""
    tank = fp.Plant(
        {"level": "m"},
        {"valve": "1"},
        {"c": fp.Parameter(approximate=0.7, exact=1.0, unit="m/s"), "k": fp.Parameter(0.3, 0.5, "1/s")},
        lambda q, u, p: {"level": p.c * (u.valve + 0.5 * u.valve**3) - p.k * q.level},
        order=1,
    )
    problem = fp.Problem(
        tank, fp.Trajectory(lambda t: {"level": 1 + 0.3 * ca.sin(t)}), {"level": 1.0}, 1e-2, 10.0, measure_from=5.0
    )
    assert not tank.equations.affine
    # rate x period = 0.02; the response error falls by about half per cycle
    controllers = [fp.ComputedTorque(fp.Exponential(2.0), d) for d in (fp.Identity(), fp.Sigmoid(gain=-1.0, scale=5.0))]
    plain, adaptive = (fp.measure(problem, fp.simulate(problem, c, seed=0)).rms_error["level"] for c in controllers)
    assert adaptive < 0.1 * plain


def test_parameters_are_not_compiled_in():
    """Other exact values give another run with the same Function."""
    from fpirhc.simulation.loop import close_loop

    problem = swing(measure_from=2.0)
    heavier = replace(
        problem.plant, parameters={**problem.plant.parameters, "m": fp.Parameter(approximate=1.4, exact=1.2, unit="kg")}
    )
    controller = fp.ComputedTorque(TRACK)
    loops = [close_loop(replace(problem, plant=p), controller) for p in (problem.plant, heavier)]
    assert loops[0].function.n_instructions() == loops[1].function.n_instructions()
    memories = [loop.memory.start() for loop in loops]
    values = [loops[0].function(m)[0].full() for m in memories]
    other = loops[1].function(memories[1])[0].full()
    assert not np.array_equal(values[0], values[1])
    np.testing.assert_array_equal(values[1], other)


# Short runs are not worth a compiler: `compiled=None` chooses


def test_a_short_run_is_not_compiled_unless_it_is_asked_for():
    """None chooses by cycles and stages; the run says why, and is that of the virtual machine."""
    task = fp.load_problem("two_mass")
    short = replace(task.problem, duration=20 * task.problem.period, measure_from=0.0)
    law = task.controllers["CTC"]
    chosen = fp.simulate(short, law, seed=0, compiled=None)
    assert chosen.settings["why not compiled"] == "the run is short, and a compiler would take longer"
    assert np.array_equal(chosen.log, fp.simulate(short, law, seed=0, compiled=False).log)
    long = replace(task.problem, duration=200_000 * task.problem.period)
    ready = fp.simulator(long, law, compiled=None)
    assert ready.compiled or "short" not in ready.why_not_compiled
