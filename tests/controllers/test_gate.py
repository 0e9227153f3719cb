"""The gate around a small step, against rules that are written down here once more, cycle by cycle.

The step inside counts its cycles, sums what it is given, and commands the sum. So a cycle that ran, ran twice, or began anew
shows in one number. Scalar code and a graph have two ways through the gate, and keep the same rules.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc import Gate, Status
from fpirhc.conformance.loops import two_masses
from fpirhc.contracts import Block, Layout, Signal, scalar
from fpirhc.controllers.gate import AGAIN, was_skipped
from fpirhc.symbolic.block import compose
from fpirhc.symbolic.live import Derived

LIMITS = fp.Limits(inputs={"Fa": (-30.0, 30.0), "Fb": (-6.0, 40.0)})
PROBLEM = replace(two_masses(), limits=LIMITS, input_before={"Fa": 2.5, "Fb": -1.5})
START, BEFORE = [0.0, 7.0], [2.5, -1.5]  # of the step's memory (count, sum), and of the command
RANGES = {"state.a": (-1.0, 3.0), "state.b": (-np.inf, 5.0), "state.a'": (-4.0, np.inf)}
both = pytest.mark.parametrize("opaque", [False, True], ids=["scalar", "graph"])


def inner(opaque: bool, *, with_status: bool = True):
    """(count, sum) -> (count + 1, sum + a); command (sum + a, -count); 'fine' is the status, 1/b a part of the command."""
    plant = PROBLEM.plant
    reads = Layout((scalar("time", "s"), plant.state, plant.response_signal("realised")))
    memory = Layout((scalar("count"), scalar("total", start=7.0)))

    def step(s):
        total = s.total + s.state[0]
        # b = 0.125 is outside the domain of this step: its command is infinite; at b = 0.25 its memory alone is.
        command = np.array([1.0, 0.0]) * (total + 1e-300 / (s.state[1] - 0.125)) + np.array([0.0, 1.0]) * (-s.count)
        held = int(Status.NON_FINITE) - int(
            Status.NOT_CONVERGED
        )  # b = 0.375: the step says itself that it held its command
        told = {"status": int(Status.NOT_CONVERGED) + held * (s.state[1] == 0.375)} if with_status else {}
        return {
            "command": command,
            **told,
            "count_next": s.count + 1 + 1e-300 / (s.state[1] - 0.25),
            "total_next": total,
        }

    writes = Layout((plant.input, *([scalar("status")] if with_status else [])))
    block = Block("inside", reads, writes, step, memory, opaque=opaque)
    return compose("inside", reads, [block], outputs=("command",))


class Gated:
    """A gate with its memory, stepped with numbers by name."""

    def __init__(self, opaque, **settings):
        self.gate = Gate(PROBLEM, inner(opaque), **settings)
        self.block = self.gate.block()
        self.reads, self.layout = self.gate.reads, self.gate.memory
        self.memory = {s.name: s.start_vector() for s in self.layout.signals}
        self.function = self.block.function

    def __call__(self, a=0.5, b=1.0, time=0.0, realised=0.0, **others):
        """Command and status; a, b are those of the state."""
        given = {"time": [time], "state": [a, b, 0.0, 0.0], "realised": [realised, 0.0], **others}
        values = [given[n] for n in self.reads.names] + [self.memory[m] for m in self.layout.names]
        results = [np.asarray(v.full())[:, 0] for v in self.function(*values)]
        written = dict(zip([*self.block.writes.names, *self.layout.names], results, strict=True))
        self.memory = {m: written[m] for m in self.layout.names}
        return written["command"].tolist(), Status(int(written["status"][0]))

    @property
    def own(self):
        """(count, sum) of the step inside."""
        return np.concatenate([self.memory[s.name] for s in self.gate.controller_memory.signals]).tolist()

    def remembered(self):
        return {name: value.copy() for name, value in self.memory.items()}


@both
def test_a_good_sample_passes(opaque):
    gated = Gated(opaque)
    assert gated(0.5) == ([7.5, 0.0], Status.NOT_CONVERGED)
    assert gated(1.0) == ([8.5, -1.0], Status.NOT_CONVERGED)
    assert gated.own == [2.0, 8.5]
    assert gated.memory["held_command"].tolist() == [8.5, -1.0]


@both
@pytest.mark.parametrize("bad", [{"a": np.nan}, {"b": np.inf}, {"time": -np.inf}, {"realised": np.nan}], ids=str)
def test_a_bad_sample_leaves_every_memory_as_it_was(opaque, bad):
    """The last command once more, before the first one the command before the run, and nothing is remembered of it."""
    gated = Gated(opaque)
    before = gated.remembered()
    assert gated(**bad) == (BEFORE, Status.BAD_SAMPLE)
    assert all(np.array_equal(before[n], v) for n, v in gated.memory.items())
    gated(0.5)
    before = gated.remembered()
    assert gated(**bad) == ([7.5, 0.0], Status.BAD_SAMPLE)
    assert all(np.array_equal(before[n], v) for n, v in gated.memory.items())
    assert gated(0.5) == ([8.0, -1.0], Status.NOT_CONVERGED)


@both
@pytest.mark.parametrize("outside", [0.125, 0.25], ids=["command", "memory"])
def test_a_step_that_is_not_finite_is_a_skipped_cycle(opaque, outside):
    """The command is held, count and sum are as they were, and the status says why."""
    gated = Gated(opaque)
    gated(0.5)
    before = gated.remembered()
    assert gated(1.0, b=outside) == ([7.5, 0.0], Status.NON_FINITE)
    changed = {n for n, v in gated.memory.items() if not np.array_equal(before[n], v)}
    assert changed == {"not_finite"}
    assert gated(0.5) == ([8.0, -1.0], Status.NOT_CONVERGED)
    assert gated.memory["not_finite"].tolist() == [0.0]


@both
def test_a_step_that_says_so_is_a_skipped_cycle_too(opaque):
    """Its command is finite, because it held it itself; a step without a status is judged by its numbers alone."""
    gated = Gated(opaque)
    gated(0.5)
    assert gated(1.0, b=0.375) == ([7.5, 0.0], Status.NON_FINITE)
    assert gated.own == [1.0, 7.5]
    silent = Gate(PROBLEM, inner(opaque, with_status=False)).block()
    ends = [silent.function(0.0, [0.5, b, 0.0, 0.0], np.zeros(2), *_starts(silent)) for b in (1.0, 0.125, 0.375)]
    first = [np.asarray(end[silent.writes.names.index("command")].full()).ravel().tolist() for end in ends]
    assert first == [[7.5, 0.0], BEFORE, [7.5, 0.0]]


def _starts(block):
    return [signal.start_vector() for signal in block.memory.signals]


@both
def test_after_ten_such_steps_one_is_tried_from_the_start(opaque):
    """Samples outside the domain stay so: the memory is kept. A good sample then tells that the memory was at fault."""
    gated = Gated(opaque)
    gated(0.5)
    for k in range(25):
        assert gated(1.0, b=0.125) == ([7.5, 0.0], Status.NON_FINITE), k
        assert gated.memory["not_finite"].tolist() == [(k + 1) % 11], k
        assert gated(np.nan)[1] == Status.BAD_SAMPLE  # counts for nothing
    assert gated.own == [1.0, 7.5]
    gated.memory["not_finite"] = np.array([10.0])
    assert gated(1.0) == ([8.0, 0.0], Status.RESTARTED)
    assert gated.own == [1.0, 8.0]
    gated.memory["not_finite"] = np.array([11.0])  # no count that there is
    gated(np.nan)
    assert gated.memory["not_finite"].tolist() == [0.0]
    gated.memory["not_finite"] = np.array([9.0])
    assert gated(1.0) == ([9.0, -1.0], Status.NOT_CONVERGED)


@both
def test_a_memory_that_is_not_finite_is_forgotten(opaque):
    """Every single number of it: the sample is the first one of a run, or the start's command is held."""
    names = list(Gated(opaque).memory)
    for name in names:
        for bad in (np.nan, np.inf):
            gated = Gated(opaque)
            for _ in range(3):
                gated(0.5)
            gated.memory[name] = np.full_like(gated.memory[name], bad)
            own = name in gated.gate.controller_memory.names
            command, status = gated(1.0)
            assert status == (Status.RESTARTED if own else Status.NOT_CONVERGED)  # a count that cannot be is none
            assert command == ([8.0, 0.0] if status == Status.RESTARTED else [9.5, -3.0])
            assert all(np.isfinite(v).all() for v in gated.memory.values()), name
    gated = Gated(opaque)
    gated(0.5)
    gated.memory["held_command"] = np.array([np.nan, 1.0])
    assert gated(np.nan) == (BEFORE, Status.BAD_SAMPLE)
    gated.memory["held_command"] = np.array([1e6, -1e6])
    assert gated(np.nan) == ([30.0, -6.0], Status.BAD_SAMPLE)


@both
def test_ranges_that_are_open_on_one_side(opaque):
    """Every number on the open side fits, none beyond the other one, however often it comes."""
    gated = Gated(opaque, ranges=RANGES)
    assert gated(b=-1e9)[1] == Status.NOT_CONVERGED
    assert gated(realised=-1e9)[1] == Status.NOT_CONVERGED  # no range is named
    assert gated(b=5.0)[1] == Status.NOT_CONVERGED
    assert gated(state=[0.5, 1.0, 1e9, 0.0])[1] == Status.NOT_CONVERGED
    assert gated(state=[0.5, 1.0, -4.0, 0.0])[1] == Status.NOT_CONVERGED
    for _ in range(22):
        assert gated(b=5.01)[1] == Status.BAD_SAMPLE
    for _ in range(22):
        assert gated(state=[0.5, 1.0, -4.01, 0.0])[1] == Status.BAD_SAMPLE


@both
def test_time_stamps(opaque):
    """A sample is later than the last good one, not later than now, and not older than the age that is allowed."""
    gated = Gated(opaque, max_age=0.1)
    for time, taken, fits in (
        (1.0, 0.95, True),
        (1.0, 0.95, False),  # not later
        (1.1, 1.05, True),
        (1.2, 1.21, False),  # from the future
        (1.2, 1.2, True),
        (1.4, 1.29, False),  # too old
        (1.4, 1.3125, True),
        (1.5, np.nan, False),
    ):
        status = gated(time=time, taken=[taken])[1]
        assert (status == Status.NOT_CONVERGED) == fits, (time, taken)
    assert gated.memory["good_taken"].tolist() == [1.3125]
    gated(b=0.125, time=1.5, taken=[1.49])  # what the step cannot use is not the last good sample
    assert gated.memory["good_taken"].tolist() == [1.3125]
    assert gated(time=1e9, taken=[1e9])[1] == Status.NOT_CONVERGED


@both
def test_what_is_trusted_is_not_checked(opaque):
    """A simulated clock may be anything; the memory of a loop is not looked at, and no steps are counted."""
    gated = Gated(opaque, trusted=("time", "memory"))
    assert "not_finite" not in gated.memory
    assert gated(0.5, time=np.nan) == ([7.5, 0.0], Status.NOT_CONVERGED)
    assert gated(np.nan) == ([7.5, 0.0], Status.BAD_SAMPLE)
    assert gated(1.0, b=0.125) == ([7.5, 0.0], Status.NON_FINITE)
    assert gated.own == [1.0, 7.5]


@both
def test_a_cycle_that_is_given_again_is_no_missing_one(opaque):
    """Its time is beyond every time: nothing is counted; a bad sample at any other time is missing."""
    gated = Gated(opaque, samples=2)
    gated(0.5, time=0.0)
    gated(np.nan, time=0.1)
    gated(np.nan, time=AGAIN)
    assert gated.memory["missing_cycles"].tolist() == [1.0]
    gated(np.nan, time=0.2)
    assert gated.memory["missing_cycles"].tolist() == [2.0]
    assert gated(0.5, time=0.3) == ([8.0, -1.0], Status.NOT_CONVERGED)
    assert gated.memory["missing_cycles"].tolist() == [0.0]


def test_what_is_remembered():
    """By name, with units and first values: of scalar code one signal each, of a graph the last good sample too."""
    one, other = (Gate(PROBLEM, inner(opaque), ranges=RANGES, max_age=1.0) for opaque in (False, True))
    assert one.memory.names == ("held_command", "good_taken", "not_finite", "count", "total")
    assert other.memory.names == (
        *("held_command", "good_time", "good_state", "good_realised", "good_taken"),
        *("not_finite", "controller_memory"),
    )
    assert one.memory["held_command"].start_vector().tolist() == BEFORE
    assert one.memory["held_command"].units == ("N", "N")
    assert other.memory["good_state"].start_vector().tolist() == PROBLEM.start_state.tolist()
    assert other.memory["good_taken"].start_vector()[0] < -1e299
    assert other.memory["controller_memory"].start_vector().tolist() == START
    assert other.named(other.memory).names[-2:] == ("count", "total")
    assert one.named(one.memory).names == one.memory.names
    assert Gate(PROBLEM, inner(False)).memory.names == ("held_command", "not_finite", "count", "total")
    assert one.reads.names == ("time", "state", "realised", "taken")
    assert Gate(PROBLEM, inner(False), trusted=("time",)).sample.names == ("state", "realised")


@pytest.mark.parametrize("trusted", [(), ("time", "memory")], ids=["device", "loop"])
def test_a_graph_holds_the_step_once(trusted):
    """It may hold an optimiser: a second place, for bad samples or for a restart, would double the code of a device."""
    gated = Gated(opaque=True, trusted=trusted).function
    graphs = [f for f in (gated, *gated.find_functions()) if f.is_a("MXFunction")]
    calls = [
        f.instruction_MX(k) for f in graphs for k in range(f.n_instructions()) if f.instruction_id(k) == ca.OP_CALL
    ]
    assert [c.which_function().name() for c in calls].count("fpirhc_inside") == 1


@both
def test_what_follows_from_live_settings_passes_with_the_memory_of_the_gate(opaque):
    """Values of the step's memory by name, of a graph as the one signal that its memory is here."""
    composite = inner(opaque)
    [block] = composite.blocks
    told = Derived(memory=lambda: {"count": np.array([4.0]), "total": np.array([5.0])})
    computed = replace(composite, blocks=(replace(block, derived=lambda values: told),))
    derived = Gate(PROBLEM, computed).block().derived
    assert derived is not None
    values = {name: np.asarray(v).ravel().tolist() for name, v in derived({}).memory().items()}
    assert values == ({"controller_memory": [4.0, 5.0]} if opaque else {"count": [4.0], "total": [5.0]})
    assert Gate(PROBLEM, composite).block().derived is None


def test_a_step_without_a_status_passes_too():
    block = Gate(PROBLEM, inner(False, with_status=False)).block()
    assert "status" not in block.writes
    assert isinstance(block.writes["command"], Signal)


@pytest.mark.parametrize("status", Status)
def test_cycles_that_were_skipped(status):
    bad = status in {Status.BAD_SAMPLE, Status.BAD_TIME, Status.NON_FINITE}
    assert bool(ca.evalf(was_skipped(ca.SX(int(status))))) == bad
