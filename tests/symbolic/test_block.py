"""Blocks: wiring by name, delays, multi-rate, and their mistakes."""

from __future__ import annotations

import sys
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fpirhc as fp
from fpirhc.contracts import Block, Delay, Layout, Signal, scalar, vector
from fpirhc.errors import InvalidName, InvalidShape, InvalidValue
from fpirhc.simulation.loop import close_loop
from fpirhc.symbolic.block import compose, every
from fpirhc.symbolic.layout import Named
from fpirhc.symbolic.live import copied, is_live, live_number, live_numbers, nominal
from fpirhc.symbolic.paths import changed_at

U, Y = scalar("u"), scalar("y")


def double() -> Block:
    """Y = 2 u."""
    return Block("double", Layout((U,)), Layout((Y,)), lambda s: {"y": 2 * s.u})


def summing() -> Block:
    """A running sum of u."""
    memory = Layout((scalar("total"),))
    return Block("sum", Layout((U,)), Layout((Y,)), lambda s: {"y": s.total + s.u, "total_next": s.total + s.u}, memory)


def run(composite, inputs):
    """Traces of the first column for a sequence of scalar inputs."""
    memory, collected = composite.memory.start(), []
    for u in inputs:
        memory, trace = composite.function(memory, u)[:2]
        collected.append(float(trace[0]))
    return collected


def test_blocks_are_wired_by_name():
    last = Block("add", Layout((Y, U)), Layout((scalar("z"),)), lambda s: {"z": s.y + s.u})
    composite = compose("wired", Layout((U,)), [double(), last], outputs=("z",))
    _, trace, z = composite.function([], 3.0)
    assert composite.trace.names == ("y", "z")
    assert trace.full().ravel().tolist() == [6.0, 9.0]
    assert float(z) == 9.0


def test_memory_is_explicit():
    """The same arguments give the same results: nothing is remembered outside the memory."""
    composite = compose("summed", Layout((U,)), [summing()])
    assert run(composite, [1, 2, 3]) == [1, 3, 6]
    assert run(composite, [1, 2, 3]) == [1, 3, 6]


def test_delay_carries_a_late_signal_to_the_next_cycle():
    """An early block reads what a later block wrote one cycle ago, and the start value first."""
    early = Block("early", Layout((scalar("before"),)), Layout((scalar("x"),)), lambda s: {"x": s.before})
    delay = Delay(scalar("before", start=7.0), "y")
    composite = compose("delayed", Layout((U,)), [early, double()], [delay])
    assert run(composite, [1, 2, 3]) == [7, 2, 4]


@settings(deadline=None, derandomize=True, max_examples=25)
@given(cycles=st.integers(1, 7), inputs=st.lists(st.integers(-5, 5), min_size=1, max_size=20))
def test_every_runs_in_every_nth_cycle_and_holds(cycles, inputs):
    """Y is the sum of the inputs of the cycles that ran, held in between."""
    composite = compose("slow", Layout((U,)), [every(summing(), cycles)])
    expected, total = [], 0
    for k, u in enumerate(inputs):
        total += u if k % cycles == 0 else 0
        expected.append(total)
    assert run(composite, inputs) == expected


class Counter(ca.Callback):
    """Counts its evaluations."""

    def __init__(self):
        ca.Callback.__init__(self)
        self.calls = 0
        self.construct("counter", {})

    def eval(self, arguments):
        """Pass the argument on."""
        self.calls += 1
        return [arguments[0]]


def test_skipped_cycles_do_not_evaluate():
    """The expensive branch costs only when it runs."""
    counter = Counter()
    costly = Block("costly", Layout((U,)), Layout((Y,)), lambda s: {"y": counter(s.u)}, opaque=True)
    composite = compose("rare", Layout((U,)), [every(costly, 5)])
    run(composite, range(20))
    assert counter.calls == 4


def test_plain_blocks_become_scalar_code():
    """Without opaque blocks the composite is one scalar Function, as fast as hand-written code."""
    assert compose("plain", Layout((U,)), [double()]).function.is_a("SXFunction")
    assert not compose("slow", Layout((U,)), [every(double(), 2)]).function.is_a("SXFunction")


def test_private_wires_are_not_traced():
    """Names that begin with '_' connect blocks only."""
    wire = Block("wire", Layout((U,)), Layout((scalar("_w"),)), lambda s: {"_w": s.u})
    last = Block("last", Layout((scalar("_w"),)), Layout((Y,)), lambda s: {"y": s._w})
    assert compose("wires", Layout((U,)), [wire, last]).trace.names == ("y",)


def test_wiring_mistakes():
    with pytest.raises(InvalidName, match="block 'double' reads 'u', which no earlier block writes"):
        compose("bad", Layout((scalar("v"),)), [double()])
    with pytest.raises(InvalidName, match="writes 'y', which is already written"):
        compose("bad", Layout((U,)), [double(), summing()])
    with pytest.raises(InvalidShape, match="reads 'u' with 1 entries, but it has 2"):
        compose("bad", Layout((vector("u", ("a", "b")),)), [double()])
    with pytest.raises(InvalidName, match=r"does not give 'y'.*Did you mean 'yy'"):
        _ = Block("b", Layout((U,)), Layout((Y,)), lambda s: {"yy": s.u}).function
    with pytest.raises(InvalidShape, match="gives 'y' with 2 entries, expected 1"):
        _ = Block("b", Layout((U,)), Layout((Y,)), lambda s: {"y": ca.vertcat(s.u, s.u)}).function
    with pytest.raises(InvalidValue, match="every 0 cycles"):
        every(double(), 0)


LAYOUT = Layout(
    (scalar("t", "s", 1.5), vector("q", ("q1", "q2"), "m"), Signal("v", ("a", "b", "c"), ("m",), (1.0, 2.0, 3.0)))
)


def test_layout_names_every_entry():
    """Columns, units and start values follow the order of the signals."""
    assert LAYOUT.columns == ("t", "q.q1", "q.q2", "v.a", "v.b", "v.c")
    assert LAYOUT.units == ("s", "m", "m", "m", "m", "m")
    assert LAYOUT.start().tolist() == [1.5, 0, 0, 1, 2, 3]


@settings(deadline=None, derandomize=True, max_examples=50)
@given(st.lists(st.floats(-1e6, 1e6), min_size=6, max_size=6))
def test_pack_and_unpack_are_inverse(entries):
    """Names to places and back loses nothing; numbers and expressions are laid out alike."""
    flat = np.array(entries)
    assert np.array_equal(LAYOUT.pack(LAYOUT.unpack(flat)), flat)
    assert np.array_equal(LAYOUT.join(LAYOUT.split(ca.DM(flat))).full().ravel(), flat)


def test_layout_mistakes():
    """Unknown names get the nearest, wrong sizes are counted, start values must be finite."""
    with pytest.raises(InvalidName, match="Did you mean 'q'"):
        LAYOUT.slice("qq")
    with pytest.raises(InvalidShape, match="'q' has 2 entries, got 3"):
        LAYOUT.pack({"q": [1, 2, 3]})
    with pytest.raises(InvalidShape, match="expected 6 entries, got 5"):
        LAYOUT.unpack(np.zeros(5))
    with pytest.raises(InvalidName, match="appears twice"):
        Layout((U, U))
    with pytest.raises(InvalidValue, match="not finite"):
        Layout((scalar("u", start=float("inf")),))
    with pytest.raises(InvalidShape, match="2 entries but 1 start values"):
        Layout((Signal("q", ("a", "b"), (), (1.0,)),))
    with pytest.raises(InvalidName, match=r"coordinate 'q3' is unknown. Did you mean 'q[12]'"):
        _ = Named(("q1", "q2"), ca.SX.sym("q", 2), "coordinate").q3


def test_a_live_number_is_found_in_a_copy_of_a_value_that_was_searched_before():
    plain = replace(fp.Exponential(rate=6.0), largest=(1.0, 2.0))
    assert nominal(plain) is plain
    assert not is_live({"law": [plain]})
    open_rate = changed_at(plain, "rate", live_number("rate", 6.0), copy=copied)
    assert list(live_numbers([plain, open_rate])) == ["rate"]
    assert nominal(open_rate) == plain


def test_a_loop_is_closed_in_few_calls():
    """Each call costs more than the work in it; searches of frozen values, names and places are done once."""
    problem = fp.load_problem("two_mass").problem
    law = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Sigmoid(gain=-0.5))
    calls = 0

    def count(frame, event, _):
        nonlocal calls
        calls += event == "call" and "/fpirhc/" in frame.f_code.co_filename

    sys.setprofile(count)
    try:
        close_loop(problem, law)
    finally:
        sys.setprofile(None)
    assert calls <= 2250  # 2122 alone; what other tests pushed out of the caches is searched again
