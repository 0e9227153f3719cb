"""The gate around a small step, against its rules, which are written down here once more in plain Python, cycle by cycle.

The step inside counts its cycles, sums what it is given, and commands the sum. So a cycle that ran, ran twice, or began anew
shows in one number. Scalar code and a graph have two ways through the gate, and keep the same rules.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.conformance import two_masses
from fpirhc.contracts import Block, Controller, Deformation, Layout, scalar

INF, PATIENCE = np.inf, 10
LIMITS = {"Fa": (-300.0, 300.0), "Fb": (-6000.0, 40.0)}
TWO = two_masses()
RANGES = {"a": (-1.0, 3.0), "b": (-INF, 5.0), "a'": (-4.0, INF), "b''": (-INF, 9.0)}
PROBLEM = replace(
    TWO,
    sensing=fp.Sensing({name: fp.Sensor(range=ends) for name, ends in RANGES.items()}),
    limits=fp.Limits(inputs=LIMITS),
    input_before={"Fa": 2.5, "Fb": -1.5},
    horizon=None,
    cost=None,
)
START, BEFORE = np.array([0.0, 7.0]), np.array([2.5, -1.5])  # of the step's memory (count, sum), and of the command
FINE = int(fp.Status.OK), int(fp.Status.NOT_CONVERGED)


@dataclass(frozen=True)
class Counting(Controller):
    """(count, sum) -> (count + 1, sum + a) with the command (sum + a, -count).

    At b = 0.125 the command is infinite, at b = 0.25 the memory alone is, at b = 0.375 it says itself that it held its command, and
    where b < 0 its status is NOT_CONVERGED.
    """

    opaque: bool
    deformation: Deformation = field(default_factory=fp.Identity)

    def blocks(self, built):
        plant = built.plant
        reads = Layout((scalar("time", "s"), plant.state, plant.response_signal("realised")))
        memory = Layout((scalar("count"), scalar("total", start=7.0)))

        def step(s):
            total, b = s.total + s.state[0], s.state[1]
            told = (b < 0) * FINE[1] + (b == 0.375) * int(fp.Status.NON_FINITE)
            command = np.array([1.0, 0.0]) * (total + 1e-300 / (b - 0.125)) - np.array([0.0, 1.0]) * s.count
            count = s.count + 1 + 1e-300 / (b - 0.25)
            return {"command": command, "status": told, "count_next": count, "total_next": total}

        writes = Layout((plant.input, scalar("status")))
        return [Block("inside", reads, writes, step, memory, opaque=self.opaque)], []


class Rules:
    """What the gate does, in plain Python."""

    def __init__(self):
        self.held, self.own, self.failed, self.skipped = BEFORE, START, 0, 0

    def fits(self, state, realised):
        """Finite, and inside its ranges."""
        inside = -1 <= state[0] <= 3 and state[1] <= 5 and state[2] >= -4 and realised[1] <= 9
        return bool(np.isfinite([*state, *realised]).all() and inside)

    def step(self, state, realised):
        """Command and status."""
        if not self.fits(state, realised):
            return self.skip(fp.Status.BAD_SAMPLE)
        trial = self.failed == PATIENCE
        count, total = START if trial else self.own
        if state[1] in (0.125, 0.25, 0.375):
            self.failed = 0 if trial else self.failed + 1
            return self.skip(fp.Status.NON_FINITE)
        status = fp.Status.NOT_CONVERGED if state[1] < 0 else fp.Status.OK
        status = fp.Status.RESTARTED if trial else status
        self.held, self.own = np.array([total + state[0], -count]), np.array([count + 1, total + state[0]])
        self.failed = 0
        return self.held, status

    def skip(self, status):
        """The command is held."""
        self.skipped += 1
        return self.held, status


def sample(random, bad):
    """A state and a response; of the bad ones each is bad in one thing."""
    state, realised = np.array([*random.uniform(-0.5, 0.5, 2), 0.0, 0.0]), np.zeros(2)
    if random.uniform() < bad:
        kind = int(random.integers(0, 13))
        if kind < 3:
            state[1] = (0.125, 0.25, 0.375)[kind]
        elif kind < 11:
            wrong = ((0, np.nan), (1, INF), (3, -INF), (0, 3.01), (0, -1.01), (1, 5.01), (2, -4.01), (1, np.nan))
            state[wrong[kind - 3][0]] = wrong[kind - 3][1]
        else:
            realised[1] = {11: np.nan, 12: 9.1}[kind]
    elif random.uniform() < 0.2:  # at the edge of what is good, and on the side that is open
        state[:] = ((3.0, 5.0, -4.0, 1e9), (-1.0, -1e9, 1e9, -1e9))[int(random.integers(0, 2))]
    return state, realised


def told(gated):
    """Status of the last step; what it says of a gap is of who replays it (tests/sensing/test_lost_samples.py)."""
    status = fp.Status(int(gated.trace()["status"][0]))
    return fp.Status.OK if status == fp.Status.SETTLING else status


def stepper(opaque):
    return fp.Stepper(PROBLEM, Counting(opaque), compiled=False, bridged=0)


both = pytest.mark.parametrize("opaque", [False, True], ids=["scalar", "graph"])


@both
@pytest.mark.parametrize("bad", [0.1, 0.5, 0.95])
def test_a_gate_follows_its_rules(opaque, bad):
    """Two hundred cycles from the first one, with few, many, and nearly only bad samples."""
    gated, rules, random, seen = stepper(opaque), Rules(), np.random.default_rng(round(10 * bad)), set()
    memory = gated.start()
    for k in range(200):
        state, realised = sample(random, bad)
        command, memory = gated.step(k * PROBLEM.period, state, realised, memory)
        expected, status = rules.step(state, realised)
        shown, kept = gated.trace(), gated.memory.unpack(memory)
        assert told(gated) == status, k
        assert command.tolist() == expected.tolist() == shown["command"].tolist(), k
        assert (kept["count"][0], kept["total"][0], gated.skipped) == (*rules.own, rules.skipped), k
        seen.add(status)
    assert len(seen) >= (4 if bad < 0.9 else 3)


@both
def test_after_ten_steps_that_are_not_finite_one_is_tried_from_the_start(opaque):
    """Samples outside the domain stay so: the memory is kept. A good sample then tells that the memory was at fault."""
    gated, rules, said = stepper(opaque), Rules(), []
    memory = gated.start()
    for k, b in enumerate([1.0, *[0.125] * 25, 1.0, *[0.25] * 9, 1.0, *[0.25] * 10, 1.0, 1.0, *[0.25] * 21, 1.0]):
        state = np.array([0.5, b, 0.0, 0.0])
        command, memory = gated.step(k * PROBLEM.period, state, np.zeros(2), memory)
        expected, status = rules.step(state, np.zeros(2))
        assert (command.tolist(), told(gated)) == (expected.tolist(), status), k
        assert gated.memory.unpack(memory)["total"][0] == rules.own[1]
        said.append(status)
    assert said.count(fp.Status.RESTARTED) == 2


@both
@pytest.mark.parametrize("bad", [np.nan, INF, 1e301, 1e7, 1e3])
def test_a_memory_that_cannot_be_is_forgotten(opaque, bad):
    """Every number of it: the controller begins anew, or the command of the start is held; nothing that is not finite is left."""
    gated = stepper(opaque)
    memory = gated.start()
    for k in range(3):
        _, memory = gated.step(k * PROBLEM.period, np.array([0.5, 1.0, 0, 0]), np.zeros(2), memory)
    time = 3 * PROBLEM.period
    for name in ("held_command", "not_finite", "missing_cycles", "count", "total"):
        wrong = memory.copy()
        wrong[gated.memory.slice(name)] = bad
        command, after = gated.step(time, np.array([0.5, 1.0, 0, 0]), np.zeros(2), wrong)
        assert np.isfinite(after).all(), name
        status = told(gated)
        if name in ("count", "total") and not abs(bad) <= 1e300:
            assert (status, command.tolist()) == (fp.Status.RESTARTED, [7.5, 0.0]), name
        elif name in ("not_finite", "missing_cycles"):  # a count that cannot be is none
            assert (status, command.tolist()) == (fp.Status.OK, [9.0, -3.0]), name
        held, after = gated.step(time, np.full(4, np.nan), np.zeros(2), wrong)
        counts = {n: gated.memory.unpack(after)[n][0] for n in ("not_finite", "missing_cycles")}
        gap = 1 if name != "missing_cycles" else bad + 1 if abs(bad) <= 1e6 else -1  # as before the first good sample
        assert counts == {"not_finite": 0, "missing_cycles": gap}, name
        start = name == "held_command" and not abs(bad) <= 1e300
        clipped = [300.0, 40.0] if name == "held_command" else [8.5, -2.0]
        assert held.tolist() == (BEFORE.tolist() if start else clipped), name


def test_what_is_remembered_has_names_units_and_first_values():
    """The last good samples for whoever replays a gap."""
    one, other = stepper(False).memory, stepper(True).memory
    assert one["held_command"].start_vector().tolist() == BEFORE.tolist()
    assert one["held_command"].units == ("N", "N")
    assert other["good_state"].start_vector().tolist() == PROBLEM.start_state.tolist()
