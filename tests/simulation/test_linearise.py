"""A loop that is asked for its linearisation answers with what its own runs do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reviewed import mass

import fpirhc as fp
from fpirhc.simulation.linearise.asked_loop import AskedLoop
from fpirhc.simulation.linearise.linear_loop import LinearCycle, LinearLoop

SHIPPED = ["two_mass:CTC+FPI (eq 6)", "two_mass:RHC", "noisy_motor:RHC+FPI", "van_der_pol_duffing:RHC offset-free"]


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
    linear = loop.at(memory)
    sizes = 1e-4 * np.abs(settled.memories[:, state]).max(axis=0)
    count, periods, runs = len(linear.cycles), 3, []
    for sign in (1, -1):  # on both sides, so that what bends cancels
        moved = memory.copy()
        moved[state] += sign * sizes
        runs.append(loop.run(moved, periods * count).memories[count::count, state])
    z, expected = linear.placed @ sizes, []
    for _ in range(periods):
        z = linear.dynamics @ z
        expected.append(linear.state @ z)
    found = (runs[0] - runs[1]) / 2
    assert np.abs(found - expected).max(axis=0) / np.abs(found).max(axis=0) == pytest.approx(0, abs=2e-3)


def test_poles_of_a_tracking_law_are_those_of_its_continuous_loop():
    """On a mass that the model knows (d/dt + L)^3 governs the integrated error: e^(-L T) three times."""
    problem = mass()
    loop = AskedLoop(problem, fp.ComputedTorque(fp.Exponential(rate=5.0)))
    linear = loop.at(loop.run(loop.start(exact=problem.plant.approximate), 10).memories[5])
    slow = np.sort(np.abs(linear.poles))[-3:]
    assert np.prod(slow) == pytest.approx(np.exp(-15.0 * problem.period), rel=2e-3)
    assert slow == pytest.approx(np.exp(-5.0 * problem.period), rel=2e-2)


def test_a_loop_whose_plans_wait_is_asked_over_a_whole_period():
    """The poles of plans every ten cycles are not those of plans in every cycle: between plans nothing is fed back."""
    loop = asked("two_mass:RHC")
    settled = loop.run(loop.start(), 100)
    assert len(loop.at(settled.memories[100]).cycles) == loop.repeats == 10
    assert asked("two_mass:CTC").repeats == 1


def test_a_mode_that_neither_plant_nor_command_shows_is_left_out():
    """A covariance that forgets grows by 1/lambda where nothing excites it; a growing state of the plant counts all the same."""
    dynamics, nothing = np.diag([0.5, 1.01]), np.zeros((1, 2))
    shown = np.array([[0.0, 1.0]])
    cycle = LinearCycle(dynamics, np.ones((2, 1)), np.array([[1.0, 0.0]]))
    errors = np.array([[1.0, 0.0]])
    unseen = LinearLoop((cycle,), errors, nothing, nothing.T, 0.1)
    assert unseen.radius == pytest.approx(0.5)
    assert replace(unseen, state=shown).radius == pytest.approx(1.01)
    assert replace(unseen, errors=shown).radius == pytest.approx(1.01)


def test_a_neutral_mode_counts_where_an_error_shows_it():
    """The amount of a drug that has left the body is no fault of the loop; the position of a plant that nothing holds is."""
    cycle = LinearCycle(np.diag([0.5, 1.0]), np.ones((2, 1)), np.array([[1.0, 0.0]]))
    amount = LinearLoop((cycle,), np.array([[1.0, 0.0]]), np.eye(2), np.eye(2), 0.1)
    assert amount.radius == pytest.approx(0.5)
    assert replace(amount, errors=np.eye(2)).radius == pytest.approx(1.0)


def test_noise_and_quantum_are_no_part_of_the_linear_loop():
    """A quantised sensor has the slope 0 or infinity; it is asked as if it had no quantum."""
    task = fp.load_problem("noisy_motor")
    controller = task.controllers["RHC"]
    coarse = {n: replace(s, quantum=0.05) for n, s in task.problem.sensing.sensors.items()}
    rough = replace(task.problem, sensing=replace(task.problem.sensing, sensors=coarse))
    radii = []
    for problem in (task.problem, rough):
        loop = AskedLoop(problem, controller)
        radii.append(loop.at(loop.run(loop.start(), 200).memories[200]).radius)
    assert radii[1] == radii[0]


def test_other_parameters_are_another_memory_and_no_other_build():
    """The model's own loop is that of a problem whose plant has the model's parameters."""
    task = fp.load_problem("two_mass")
    plant = task.problem.plant
    loop = asked("two_mass:CTC")
    own = loop.at(loop.run(loop.start(exact=plant.approximate), 50).memories[50])
    rebuilt = AskedLoop(replace(task.problem, plant=plant.with_exact(plant.approximate)), task.controllers["CTC"])
    other = rebuilt.at(rebuilt.run(rebuilt.start(), 50).memories[50])
    assert np.sort(np.abs(own.poles)) == pytest.approx(np.sort(np.abs(other.poles)), rel=1e-9, abs=1e-9)
