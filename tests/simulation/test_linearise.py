"""A loop that is asked for its linearisation answers with what its own runs do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reviewed import mass

import fpirhc as fp
from fpirhc.plant.motion import with_exact_parameters
from fpirhc.simulation.linearise.asked_loop import AskedLoop
from fpirhc.simulation.linearise.linear_loop import LinearCycle, LinearLoop
from fpirhc.simulation.linearise.linearisation import Linearisation

SHIPPED = [
    "two_mass:CTC+FPI (eq 6)",
    "two_mass:RHC",
    "noisy_motor:RHC+FPI",
    "van_der_pol_duffing:RHC offset-free",
    "mrac_pendulum:intelligent PD",
]


def asked(name: str) -> AskedLoop:
    problem, controller = name.split(":")
    task = fp.load_problem(problem)
    return AskedLoop(task.problem, task.controllers[controller])


@pytest.mark.parametrize("name", SHIPPED)
def test_a_deviation_of_the_state_is_carried_on_as_by_the_step_itself(name):
    """X F^k Z d is half the difference of two runs whose plants begin at x + d and x - d, after k periods of the plans."""
    loop = asked(name)
    state = loop.loop.memory.slice("_state_before")
    settled = loop.run(loop.start(), 300)
    memory = settled.memories[300]
    linear = Linearisation(loop).at(memory)
    sizes = 1e-4 * np.abs(settled.memories[:, state]).max(axis=0)
    count, periods, runs = len(linear.cycles), 3, []
    for sign in (1, -1):  # on both sides, so that what bends cancels
        moved = memory.copy()
        moved[state] += sign * sizes
        runs.append(loop.run(moved, periods * count).memories[count::count, state])
    z, expected = linear.placed @ sizes, []
    for _ in range(periods):
        z = linear.dynamics @ z
        expected.append(linear.cycles[0].state @ z)
    found = (runs[0] - runs[1]) / 2
    assert np.abs(found - expected).max(axis=0) / np.abs(found).max(axis=0) == pytest.approx(0, abs=2e-3)


def test_poles_of_a_tracking_law_are_those_of_its_continuous_loop():
    """On a mass that the model knows (d/dt + L)^3 governs the integrated error: e^(-L T) three times."""
    problem = mass()
    loop = AskedLoop(problem, fp.ComputedTorque(fp.Exponential(rate=5.0)))
    linear = Linearisation(loop).at(loop.run(loop.start(exact=problem.plant.approximate), 10).memories[5])
    slow = np.sort(np.abs(linear.poles))[-3:]
    assert np.prod(slow) == pytest.approx(np.exp(-15.0 * problem.period), rel=2e-3)
    assert slow == pytest.approx(np.exp(-5.0 * problem.period), rel=2e-2)


def test_a_loop_whose_plans_wait_is_asked_over_a_whole_period():
    """The poles of plans every ten cycles are not those of plans in every cycle: between plans nothing is fed back."""
    loop = asked("two_mass:RHC")
    settled = loop.run(loop.start(), 100)
    assert len(Linearisation(loop).at(settled.memories[100]).cycles) == loop.repeats == 10
    assert asked("two_mass:CTC").repeats == 1


def test_a_mode_that_neither_plant_nor_command_shows_is_left_out():
    """A covariance that forgets grows by 1/lambda where nothing excites it; a growing state of the plant counts all the same."""
    shown, unseen = np.array([[0.0, 1.0]]), np.array([[1.0, 0.0]])
    alone = diagonal(1.01, state=unseen, errors=unseen)
    assert alone.radius == pytest.approx(0.5)
    assert diagonal(1.01, state=shown, errors=unseen).radius == pytest.approx(1.01)
    assert diagonal(1.01, state=unseen, errors=shown).radius == pytest.approx(1.01)


def test_a_neutral_mode_counts_where_an_error_shows_it():
    """The amount of a drug that has left the body is no fault of the loop; the position of a plant that nothing holds is."""
    assert diagonal(1.0, state=np.eye(2), errors=np.array([[1.0, 0.0]])).radius == pytest.approx(0.5)
    assert diagonal(1.0, state=np.eye(2), errors=np.eye(2)).radius == pytest.approx(1.0)


def test_a_double_neutral_mode_counts_as_single_ones_do():
    """Time that is spent in a queue that stays, z+ = [[1, 1], [0, 1]] z: the poles split by the root of rounding, 1e-6."""
    drift = np.array([[0.5, 0.0, 0.0], [0.0, 1.0, 1.0], [0.0, 2e-12, 1.0]])
    for shown, radius in ((0, 0.5), (1, 1 + np.sqrt(2e-12))):
        cycle = LinearCycle(drift, np.ones((3, 1)), np.eye(3)[:1], np.eye(3))
        loop = LinearLoop((cycle,), np.eye(3)[[shown]], np.eye(3), 0.1)
        assert loop.radius == pytest.approx(radius, rel=1e-9)


def diagonal(pole: float, *, state: np.ndarray, errors: np.ndarray) -> LinearLoop:
    """A loop with the poles 0.5, which the command shows, and another one."""
    cycle = LinearCycle(np.diag([0.5, pole]), np.ones((2, 1)), np.array([[1.0, 0.0]]), state)
    return LinearLoop((cycle,), errors, np.eye(2), 0.1)


def test_the_spread_of_noise_over_a_period_is_that_of_its_cycles():
    """z+ = f_k z + w with f = 0.5, 0.9: the variance before the first cycle is P = .45^2 P + .81 + 1."""
    one, other = (LinearCycle(np.array([[f]]), np.eye(1), np.eye(1), np.eye(1)) for f in (0.5, 0.9))
    loop = LinearLoop((one, other), np.eye(1), np.eye(1), 0.1)
    assert loop.spread(np.eye(1))[0, 0] == pytest.approx(1.81 / (1 - 0.45**2))
    assert loop.radius == pytest.approx(np.sqrt(0.45))


def test_noise_and_quantum_are_no_part_of_the_linear_loop():
    """A quantised sensor has the slope 0 or infinity; it is asked as if it had no quantum."""
    task = fp.load_problem("noisy_motor")
    controller = task.controllers["RHC"]
    coarse = {n: replace(s, quantum=0.05) for n, s in task.problem.sensing.sensors.items()}
    rough = replace(task.problem, sensing=replace(task.problem.sensing, sensors=coarse))
    radii = []
    for problem in (task.problem, rough):
        loop = AskedLoop(problem, controller)
        radii.append(Linearisation(loop).at(loop.run(loop.start(), 200).memories[200]).radius)
    assert radii[1] == radii[0]


def test_other_parameters_are_another_memory_and_no_other_build():
    """The model's own loop is that of a problem whose plant has the model's parameters."""
    task = fp.load_problem("two_mass")
    plant = task.problem.plant
    loop = asked("two_mass:CTC")
    own = Linearisation(loop).at(loop.run(loop.start(exact=plant.approximate), 50).memories[50])
    rebuilt = AskedLoop(
        replace(task.problem, plant=with_exact_parameters(plant, plant.approximate)), task.controllers["CTC"]
    )
    other = Linearisation(rebuilt).at(rebuilt.run(rebuilt.start(), 50).memories[50])
    assert np.sort(np.abs(own.poles)) == pytest.approx(np.sort(np.abs(other.poles)), rel=1e-9, abs=1e-9)


def test_a_gain_that_a_run_refuses_has_poles_too():
    """J = 1.5 and a = 1.59: the iteration is multiplied by 1 - a J = -1.38; the wrong sign grows as well."""
    for deformation in (fp.Affine(gain=-2 * 1.59), fp.Affine(gain=0.5)):
        loop = AskedLoop(mass(), fp.ComputedTorque(fp.Exponential(rate=1.0), deformation))
        factor = 1 - deformation.effective_gain() * 1.5
        poles = Linearisation(loop).at(loop.run(loop.start(), 3).memories[2]).poles
        assert np.abs(poles - factor).min() < 2e-2
