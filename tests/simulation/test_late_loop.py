"""A loop with delay lines that are not written out has the poles and the response of the one that is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.errors import NoAnswer, NotSupported
from fpirhc.simulation.linearise.asked_loop import AskedLoop
from fpirhc.simulation.linearise.late_loop import Late, LateLoop
from fpirhc.simulation.linearise.linear_loop import LinearCycle, LinearLoop
from fpirhc.simulation.linearise.linearisation import Linearisation

PERIOD, STATES, LONGEST = 0.01, 4, 15


def both(seed: int, size: float) -> tuple[LateLoop, LinearLoop]:
    """A random loop of four states, two of which act again after 3 and 15 cycles, and the same with 18 states that wait."""
    random = np.random.default_rng(seed)
    dynamics = random.normal(size=(STATES, STATES))
    dynamics *= 0.9 / np.abs(np.linalg.eigvals(dynamics)).max()
    entry, arriving = random.normal(size=(STATES, 1)), random.normal(size=(1, STATES))
    late = [
        Late(place, cycles, size * random.normal(size=STATES), random.normal(size=1))
        for place, cycles in ((3, 3), (1, LONGEST))
    ]
    state = np.zeros((1, STATES))
    short = LateLoop((LinearCycle(dynamics, entry, arriving, state),), state, state.T, PERIOD, tuple(late))
    waits = sum(one.cycles for one in late)
    whole, wide_entry = np.zeros((STATES + waits,) * 2), np.pad(entry, ((0, waits), (0, 0)))
    whole[:STATES, :STATES], shown = dynamics, np.pad(arriving, ((0, 0), (0, waits)))
    first = STATES
    for one in late:
        whole[first, one.place] = 1.0
        whole[first + 1 : first + one.cycles, first : first + one.cycles - 1] = np.eye(one.cycles - 1)
        last = first + one.cycles - 1
        whole[:STATES, last], shown[0, last] = one.dynamics, one.arriving[0]
        first += one.cycles
    nothing = np.zeros((1, STATES + waits))
    return short, LinearLoop((LinearCycle(whole, wide_entry, shown, nothing),), nothing, nothing.T, PERIOD)


@pytest.mark.parametrize("size", [0.01, 0.3, 3.0])
@pytest.mark.parametrize("seed", range(6))
def test_radius_and_response_are_those_of_all_eigenvalues(seed, size):
    """Loops that converge and loops that grow: the argument principle counts what eigenvalues show."""
    short, whole = both(seed, size)
    assert short.radius == pytest.approx(np.abs(np.linalg.eigvals(whole.dynamics)).max(), rel=1e-7)
    frequencies = np.pi / PERIOD * np.linspace(0.003, 1.0, 40)
    assert short.opened(0)(frequencies) == pytest.approx(whole.opened(0)(frequencies), rel=1e-8)


@pytest.mark.parametrize("cycles", [1, 3])
@pytest.mark.parametrize("seed", range(6))
def test_commands_that_arrive_later_are_those_of_the_whole_loop(seed, cycles):
    short, whole = both(seed, 0.3)
    radius = np.abs(np.linalg.eigvals(whole.delayed([0], cycles).dynamics)).max()
    assert short.delayed([0], cycles).radius == pytest.approx(radius, rel=1e-7)


@pytest.mark.parametrize("slower", [0.9, 0.9999, 1.1])
def test_what_stays_as_it_is_and_no_judged_error_shows_is_left_out(slower):
    """The amount that has left the body, beside a mode that is judged; where it is judged too, the loop does not converge."""
    loop = waiting(np.array([[slower, 0.0], [0.3, 1.0]]), 500)
    judged = replace(loop, errors=np.array([[1.0, 0.0]]))
    assert judged.radius == pytest.approx(slower, abs=2e-8)
    assert replace(loop, errors=np.array([[0.0, 1.0]])).radius == pytest.approx(max(slower, 1.0), abs=2e-6)


def test_a_double_mode_that_stays_and_no_judged_error_shows_is_left_out_as_a_single_one():
    """The time that is spent in a queue that stays: its null vector is one, its poles are two."""
    loop = waiting(np.array([[0.9, 0.0, 0.0], [0.2, 1.0, 1.0], [0.3, 0.0, 1.0]]), 500)
    assert replace(loop, errors=np.eye(3)[:1]).radius == pytest.approx(0.9, abs=2e-8)
    assert replace(loop, errors=np.eye(3)[1:2]).radius == pytest.approx(1.0, abs=2e-5)


@pytest.mark.parametrize("count", range(1, 9))
@pytest.mark.parametrize("angle", [0.0, 0.3])
def test_poles_that_lie_together_near_the_unit_circle_are_all_counted(count, angle):
    """So are those of a plant with several slow coordinates, or with several alike that swing, behind a long dead time."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    dynamics = 0.9995 * (np.kron(np.eye(count), turn) if angle else np.eye(count))
    assert waiting(dynamics, 500).radius == pytest.approx(0.9995, abs=1e-8)


@pytest.mark.parametrize("poles", [(1.0,), (1.0, 1.0), (-1.0, 0.2), (1.0, -1.0, 0.999)])
def test_poles_on_the_unit_circle_do_not_decay(poles):
    """An integrator puts det M = 0 on a point where turns are counted."""
    assert waiting(np.diag(poles), 500).radius == pytest.approx(1.0, abs=2e-8)


def test_lines_of_several_channels_turn_the_determinant_together():
    """Twenty channels z = 0.9 z^-30 and more have the poles of one; written out, a channel has 30 states."""
    count, cycles = 20, 30
    late = tuple(Late(k, cycles, 0.9 * np.eye(count)[k], np.zeros(1)) for k in range(count))
    loop = replace(waiting(np.zeros((count, count)), 1), late=late)
    assert loop.radius == pytest.approx(0.9 ** (1 / (cycles + 1)), abs=1e-8)


def waiting(dynamics: np.ndarray, cycles: int) -> LateLoop:
    """A loop with these dynamics, and a delay line that acts on nothing."""
    size = len(dynamics)
    nothing = np.zeros((1, size))
    cycle = LinearCycle(dynamics, np.ones((size, 1)), np.ones((1, size)), nothing)
    late = (Late(0, cycles, np.zeros(size), np.zeros(1)),)
    return LateLoop((cycle,), np.eye(size), nothing.T, PERIOD, late)


def test_a_line_of_a_loop_is_found_in_its_memory():
    """Repetitive control with a period of 60 cycles: written out it has 60 states more."""
    task = fp.load_problem("mrac_pendulum")
    problem = replace(task.problem, disturbances={})
    control = fp.rivals.RepetitiveControl(fp.Exponential(6.0), repeats=60 * problem.period, gain=0.4, smoothing=0.05)
    loop = AskedLoop(problem, control)
    memory = loop.run(loop.start(), 300).memories[-1]
    [line] = [np.flatnonzero([name in column for column in loop.loop.memory.columns]) for name in ("lessons",)]
    asked = Linearisation(loop)
    whole, short = asked.at(memory), asked.late_at(memory, [line])
    assert len(whole.dynamics) - len(short.cycles[0].dynamics) > 55
    rounding = 2e-5  # three poles of the law lie together, which rounding parts
    assert short.radius == pytest.approx(whole.radius, abs=rounding)
    frequencies = np.pi / problem.period * np.linspace(0.0123, 0.987, 40)
    assert short.opened(0)(frequencies) == pytest.approx(whole.opened(0)(frequencies), rel=1e-4)
    assert short.delayed([0], 3).radius == pytest.approx(whole.delayed([0], 3).radius, abs=rounding)
    with pytest.raises(NoAnswer, match="delay line of 59 cycles"):
        short.delayed([0], -1)


def test_entries_that_do_more_than_wait_are_refused():
    """The plan of `two_mass` is a row of entries by name too, and moves as a whole."""
    task = fp.load_problem("two_mass")
    loop = AskedLoop(replace(task.problem, disturbances={}), task.controllers["RHC"])
    line = np.flatnonzero(["plan_inputs" in column and "Q1@" in column for column in loop.loop.memory.columns])
    with pytest.raises(NotSupported, match="do not only wait"):
        Linearisation(loop).late_at(loop.run(loop.start(), 50).memories[-1], [line])
