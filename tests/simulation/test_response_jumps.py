"""What one spike of a measured response is worth: at most five times what the command moves by in ordinary cycles, of any size.

The loop is closed: a stepper on its simulated plant, and one sample of the response with something added.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.conformance.loops import two_masses
from fpirhc.controllers.check import checked
from fpirhc.controllers.contract import Controller
from fpirhc.controllers.plausible import JUMPS, response_jumps
from fpirhc.simulation.path import true_response
from fpirhc.simulation.step_arguments import raw_measurements
from fpirhc.status import Status
from fpirhc.symbolic.layout import Layout
from fpirhc.symbolic.native import find_compiler

WORTH = 5.0  # times the normal movement
AT, CYCLES, SETTLED = 300, 330, 100
SIZES = (30.0, -1e3)  # m/s2
SHIPPED = (("two_mass", "CTC+FPI (eq 3)"), ("two_mass", "CTC+FPI (eq 6)"), ("two_mass", "RHC+FPI"))
CONTROLLER = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Sigmoid(gain=-0.5, scale=50.0))


class Closed:
    """A stepper on its plant."""

    def __init__(self, problem: fp.Problem, controller: Controller, *, compiled: bool = False) -> None:
        self.problem, self.stepper = problem, fp.Stepper(problem, controller, compiled=compiled)
        response = checked(problem, controller).response(problem) or true_response(problem)
        assert response.function is not None
        self.advance, self.response = problem.integrator.step(problem.plant, problem.period), response.function

    def run(self, added: dict[int, float], pushed: dict[int, float] | None = None) -> tuple[np.ndarray, list[Status]]:
        """Commands and statuses, with numbers added to the response and to the plant's acceleration in some cycles."""
        plant = self.problem.plant
        memory, x, u = self.stepper.start(), np.array(self.problem.start_state), np.array(self.problem.inputs_before)
        commands, statuses = [], []
        for k in range(CYCLES):
            push = np.full(len(plant.names), (pushed or {}).get(k, 0.0))
            seen = np.asarray(self.response(x, u, plant.exact, push).full()).ravel() + added.get(k, 0.0)
            u, memory = self.stepper.step(k * self.problem.period, x, seen, memory)
            commands.append(u)
            statuses.append(Status(int(self.stepper.trace()["status"][0])))
            x = np.asarray(self.advance(x, u, plant.exact, push).full()).ravel()
        return np.array(commands), statuses


@cache
def shipped(problem: str, name: str) -> Closed:
    task = fp.load_problem(problem)
    return Closed(task.problem, task.controllers[name])


@pytest.mark.parametrize(("problem", "name"), SHIPPED)
def test_a_spike_is_worth_five_ordinary_movements(problem, name):
    """The deviation of the command from the run without it, in that cycle and after it."""
    closed = shipped(problem, name)
    clean, _ = closed.run({})
    normal = np.abs(np.diff(clean[SETTLED:], axis=0)).max()
    for size in SIZES:
        spiked, statuses = closed.run({AT: size})
        assert np.abs(spiked - clean).max() <= WORTH * normal, size
        assert statuses[AT] == Status.BAD_SAMPLE
        assert Status.BAD_SAMPLE not in statuses[AT + 1 :]


def test_a_response_that_stays_where_it_jumped_to_is_believed():
    """A force that begins to push: one cycle is skipped, no more, and the iteration learns the force."""
    pushed = dict.fromkeys(range(AT, CYCLES), -5.0)
    _, statuses = shipped("two_mass", "CTC+FPI (eq 6)").run({}, pushed)
    skipped = [k for k, s in enumerate(statuses) if s == Status.BAD_SAMPLE]
    assert skipped == [AT]


def test_spikes_in_a_row_are_not_doubted_for_long():
    """Noise that begins at once, each sample elsewhere: the usual change doubles until it is believed."""
    generator = np.random.default_rng(0)
    noise = {k: float(500 * generator.standard_normal()) for k in range(AT - 100, CYCLES)}
    _, statuses = shipped("two_mass", "CTC+FPI (eq 6)").run(noise)
    skipped = [k for k, s in enumerate(statuses) if s == Status.BAD_SAMPLE]
    assert skipped
    assert len(skipped) < 15
    assert max(skipped) < AT - 80


def test_ordinary_noise_is_not_doubted():
    """Noise that is there from the start, through the sensing of a problem: the stepper has the loop's commands."""
    sensors = {name: fp.Sensor(noise=fp.Noise(0.3)) for name in ("a''", "b''")}
    problem = replace(two_masses(), duration=2.0, measure_from=0.0, sensing=fp.Sensing(sensors=sensors))
    run = fp.simulate(problem, CONTROLLER, seed=0, compiled=False)
    stepper, shown = fp.Stepper(problem, CONTROLLER, compiled=False), raw_measurements(run)
    assert f"{JUMPS}.begun" in stepper.memory.columns
    memory = stepper.start()
    for k in range(run.cycles):
        command, memory = stepper.step_measured(run.time[k], shown[k], memory)
        np.testing.assert_allclose(command, run["command"][k], rtol=1e-9, atol=1e-9)


def test_memory_that_is_not_finite_begins_anew():
    """Also that of the check, from any number of it."""
    closed = shipped("two_mass", "CTC+FPI (eq 6)")
    stepper, start = closed.stepper, closed.stepper.start()
    x, r = np.array(closed.problem.start_state), np.zeros(2)
    expected, _ = stepper.step(0.0, x, r, start)
    for k, name in enumerate(stepper.memory.columns):
        if name.startswith(JUMPS):
            poisoned = start.copy()
            poisoned[k] = np.nan
            command, after = stepper.step(0.0, x, r, poisoned)
            assert np.array_equal(command, expected)
            assert np.isfinite(after).all()


@pytest.mark.skipif(find_compiler() is None, reason="this machine has no C compiler")
def test_compiled_check_is_the_same():
    task = fp.load_problem("two_mass")
    controller = task.controllers["CTC+FPI (eq 6)"]
    compiled = Closed(task.problem, controller, compiled=True)
    added = {AT: 1e3, AT + 5: -40.0, AT + 6: -40.0, AT + 12: 2.0}
    (one, first), (other, second) = (c.run(added) for c in (shipped("two_mass", "CTC+FPI (eq 6)"), compiled))
    assert first == second
    assert first.count(Status.BAD_SAMPLE) >= 2
    np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9)


def test_a_response_without_a_scale_is_not_doubted():
    """Inputs without limits state no largest response."""
    problem = replace(two_masses(), limits=fp.Limits())
    reads = Layout((problem.plant.state, problem.plant.response_signal("realised")))
    assert response_jumps(problem, reads) is None
    assert response_jumps(two_masses(), reads) is not None
