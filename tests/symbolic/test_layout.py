"""Layouts and blocks of a user's own: names to places and back, and what is wrong with them."""

import sys

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fpirhc as fp
from fpirhc.contracts import Block, Layout, Signal, scalar, vector
from fpirhc.errors import InvalidName, InvalidValue

U, Y = scalar("u"), scalar("y")
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


def test_a_step_is_a_pure_function_of_names():
    """A running sum of u: the same arguments give the same results, nothing is remembered outside the memory."""
    memory = Layout((scalar("total"),))
    block = Block(
        "sum", Layout((U,)), Layout((Y,)), lambda s: {"y": s.total + s.u, "total_next": s.total + s.u}, memory
    )
    for _ in range(2):
        assert [float(v) for v in block.function(3.0, 4.0)] == [7.0, 7.0]


def block(step) -> object:
    return Block("b", Layout((U,)), Layout((Y,)), step).function


WRONG = {
    "nearest": (lambda: LAYOUT.slice("qq"), InvalidName, "Did you mean 'q'"),
    "size": (lambda: LAYOUT.pack({"q": [1, 2, 3]}), InvalidValue, "'q' has 2 entries, got 3"),
    "whole size": (lambda: LAYOUT.unpack(np.zeros(5)), InvalidValue, "expected 6 entries, got 5"),
    "twice": (lambda: Layout((U, U)), InvalidName, "appears twice"),
    "start": (lambda: Layout((scalar("u", start=float("inf")),)), InvalidValue, "not finite"),
    "starts": (lambda: Layout((Signal("q", ("a", "b"), (), (1.0,)),)), InvalidValue, "2 entries but 1 start values"),
    "not given": (lambda: block(lambda s: {"yy": s.u}), InvalidName, "does not give 'y'.*Did you mean 'yy'"),
    "too many": (
        lambda: block(lambda s: {"y": ca.vertcat(s.u, s.u)}),
        InvalidValue,
        "gives 'y' with 2 entries, expected 1",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_mistakes_are_named(name):
    make, error, words = WRONG[name]
    with pytest.raises(error, match=words):
        make()


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
        fp.simulator(problem, law, compiled=False)
    finally:
        sys.setprofile(None)
    assert calls <= 1_350  # 1221 alone; what other tests pushed out of the caches is searched again
