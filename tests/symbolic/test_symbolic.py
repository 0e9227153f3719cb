"""Layouts and blocks, and their compiled loops: the same numbers, a cache that is never wrong, and a fallback that says why."""

import os
import stat
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.machine import needs_compiler
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


needs_posix = pytest.mark.skipif(os.name != "posix", reason="owners and modes of files are those of POSIX")
LAW = fp.ComputedTorque(fp.Exponential(rate=6.0))
ALONE = """
import sys
sys.path[:0] = {paths}
from symbolic_model import model, LAW
import fpirhc as fp
for number in {numbers}:
    problem = model(number)
    runs = [fp.simulate(problem, LAW, seed=0, compiled=c) for c in (True, False)]
    assert runs[0].compiled, runs[0].settings
    assert (runs[0].log == runs[1].log).all()
"""
MODEL = """
import fpirhc as fp
LAW = fp.ComputedTorque(fp.Exponential(rate=6.0))
def model(number):
    plant = fp.Plant({"y": "m"}, {"u": "N"}, {}, lambda q, v, u, p: {"y": number * u.u - q.y})
    return fp.Problem(plant, fp.Trajectory(lambda t: {"y": 0.1 * t}), {"y": 0.1}, 0.01, 0.2)
"""


def model(number: float, response: Any = None) -> fp.Problem:
    """A small loop whose code has this number."""
    plant = fp.Plant({"y": "m"}, {"u": "N"}, {}, response or (lambda q, v, u, p: {"y": number * u.u - q.y}))
    return fp.Problem(plant, fp.Trajectory(lambda t: {"y": 0.1 * t}), {"y": 0.1}, 0.01, 0.2)


def run(number: float, compiled: bool | None = True) -> fp.Run:
    return fp.simulate(model(number), LAW, seed=0, compiled=compiled)


def why_not(result: fp.Run) -> str:
    assert not result.compiled
    return str(result.settings["why not compiled"])


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    """An empty cache."""
    monkeypatch.setenv("FPIRHC_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def libraries(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.suffix in {".so", ".dylib", ".dll"})


def other_process(folder: Path, *numbers: float) -> subprocess.Popen[bytes]:
    """Another process that compiles these models, or finds them."""
    (folder.parent / "symbolic_model.py").write_text(MODEL)
    text = ALONE.format(paths=[str(folder.parent)], numbers=numbers)
    own = {**os.environ, "FPIRHC_CACHE": str(folder), "FPIRHC_CFLAGS": "-O0"}
    return subprocess.Popen([sys.executable, "-c", text], env=own)


# The same numbers


def every_operation(x: Any, y: Any) -> list[Any]:
    unary = [ca.exp, ca.log, ca.sin, ca.cos, ca.tan, ca.asin, ca.acos, ca.atan, ca.sinh, ca.cosh, ca.tanh, ca.asinh, ca.atanh,
             ca.log1p, ca.expm1, ca.floor, ca.ceil, ca.sqrt, ca.fabs, ca.sign, ca.logic_not, ca.erf]  # fmt: skip
    binary = [ca.fmin, ca.fmax, ca.atan2, ca.hypot, ca.fmod, ca.copysign, ca.logic_or, ca.logic_and]
    values = [*(f(x) for f in unary), ca.acosh(x + 2), *(f(x, y) for f in binary), *(f(y, x) for f in binary)]
    values += [x**y, x**2.5, x * x, 2 * x, 1 / x, x - y, x / y, x < y, x <= y, x == y, x != y]
    return [*values, ca.if_else(x > y, x, y)]


@needs_compiler
def test_every_operation_has_the_bits_of_the_virtual_machine(cache):
    """Each is the rate of a state of its own; contraction of multiply-add is off, so both round alike."""
    probe = every_operation(ca.SX.sym("x"), ca.SX.sym("y"))
    names = [f"s{k}" for k in range(len(probe))]

    def rates(x: Any, u: Any, p: Any) -> dict[str, Any]:
        values = every_operation(0.5 + 0.4 * ca.sin(x.turn), 0.5 + 0.4 * ca.cos(3 * x.turn))
        return {"turn": u.u, **dict(zip(names, values, strict=True))}

    plant = fp.Plant.of_states(
        states={"turn": "rad", **dict.fromkeys(names, "1")},
        inputs={"u": "rad/s"},
        parameters={},
        rates=rates,
        outputs={"y": fp.Output("rad", lambda x, p: x.turn)},
    )
    start = dict.fromkeys(["turn", *names], 0.0)
    problem = fp.Problem(plant, fp.Trajectory(lambda t: {"y": 3 * t}), start, 0.05, 2.0)
    compiled, plain = (fp.simulate(problem, LAW, seed=0, compiled=c) for c in (True, False))
    assert compiled.compiled
    assert np.ptp(plain["state.turn"]) > 5
    np.testing.assert_array_equal(compiled.log, plain.log)


@needs_compiler
def test_own_flags_make_another_library_with_the_same_numbers(cache, monkeypatch):
    """A plan whose loops are written in C, not optimised and optimised."""
    task = fp.load_problem("leaking_tanks")
    problem = replace(task.problem, duration=20 * task.problem.period, measure_from=0.0)
    commands, counts = set(), []
    for flags in ("-O1", "-O0 -DFPIRHC_UNUSED='a word'"):
        monkeypatch.setenv("FPIRHC_CFLAGS", flags)
        commands.add(fp.simulate(problem, task.controllers["RHC+FPI"], seed=0, compiled=True)["command"].tobytes())
        counts.append(len(libraries(cache)))
    assert len(commands) == 1
    assert counts[1] == 2 * counts[0]


# A cache that is never wrong


@needs_compiler
def test_cache_is_by_content_and_shared_by_processes(cache):
    """The same model compiles once, another model gets another library; four processes at once get their own model's numbers."""
    at_once = [other_process(cache, 1.5, 2.5) for _ in range(2)]
    assert [process.wait() for process in at_once] == [0, 0]
    found = {path: path.stat().st_mtime_ns for path in libraries(cache)}
    assert len(found) == 2
    assert other_process(cache, 2.5, 1.5).wait() == 0
    assert {path: path.stat().st_mtime_ns for path in libraries(cache)} == found
    assert other_process(cache, 3.5).wait() == 0
    assert len(libraries(cache)) == 3
    assert not list(cache.rglob("building-*"))


@needs_compiler
@pytest.mark.parametrize("content", [b"", b"not a library"])
def test_damaged_library_is_built_again(cache, content):
    """What a full disk leaves in its place: the answer is right and the cache is whole again."""
    assert other_process(cache, 4.5).wait() == 0
    [path] = libraries(cache)
    begin = path.read_bytes()[:4]
    path.write_bytes(content)
    assert other_process(cache, 4.5).wait() == 0
    assert path.read_bytes()[:4] == begin


@needs_compiler
@needs_posix
@pytest.mark.parametrize("who", ["open to others", "open to a group", "of another user", "a link"])
def test_library_that_others_may_have_written_is_not_run(cache, who):
    """One that computes with another number would differ from the virtual machine: a folder of others is not read."""
    number = 4.512345678901
    assert other_process(cache, number).wait() == 0
    [path] = libraries(cache)
    content = path.read_bytes()
    planted = content.replace(struct.pack("<d", number), struct.pack("<d", 1 + number))
    assert planted != content
    path.unlink()
    path.write_bytes(planted)
    assert other_process(cache, number).wait() != 0  # it is run from a folder of one's own
    own = path.parent
    if who == "a link":
        own.rename(own.with_name("elsewhere"))
        own.symlink_to(own.with_name("elsewhere"))
    elif who == "of another user" and os.geteuid() == 0:  # only root can give a folder away
        os.chown(own, 65534, 65534)
    else:
        own.chmod(0o775 if who == "open to a group" else 0o777)
    assert other_process(cache, number).wait() == 0
    assert path.read_bytes() == planted


@needs_compiler
@needs_posix
def test_a_shared_folder_stays_as_it_is(tmp_path, monkeypatch):
    """FPIRHC_CACHE may name a folder that others use, too: its mode and what is in it are theirs; the own one is closed."""
    shared, theirs = tmp_path / "shared", tmp_path / "shared" / "building-a-house"
    theirs.mkdir(parents=True)
    os.utime(theirs, (0, 0))
    shared.chmod(0o1777)
    monkeypatch.setenv("FPIRHC_CACHE", str(shared))
    old = os.umask(0)
    try:
        assert run(6.5).compiled
    finally:
        os.umask(old)
    [own] = {*shared.iterdir()} - {theirs}
    assert (stat.S_IMODE(shared.stat().st_mode), stat.S_IMODE(own.stat().st_mode)) == (0o1777, 0o700)
    assert len(libraries(own)) == 1


@needs_compiler
@pytest.mark.parametrize("place", ["a; touch owned; $(touch owned) b", "taken/cache"])
def test_hostile_names_and_places_that_cannot_be_written(tmp_path, monkeypatch, place):
    (tmp_path / "taken").write_text("")
    monkeypatch.setenv("FPIRHC_CACHE", str(tmp_path / place))
    assert run(7.5 + len(place)).compiled
    assert not list(tmp_path.rglob("owned"))


# A fallback that says why


@pytest.mark.parametrize(
    ("compiler", "reason"),
    [
        ("none", "FPIRHC_CC=none"),
        ("no-such-compiler", "'no-such-compiler', asked for by FPIRHC_CC, was not found"),
        ("broken", "no space left"),
    ],
)
def test_without_a_compiler_the_loop_runs_and_says_so(cache, monkeypatch, tmp_path, compiler, reason):
    """No other compiler is taken, and one that fails is no reason to stop."""
    broken = tmp_path / "broken"
    broken.write_text("#!/bin/sh\necho 'no space left' >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("FPIRHC_CC", str(broken) if compiler == "broken" else compiler)
    result = run(8.5)
    assert reason in why_not(result)
    np.testing.assert_array_equal(result.log, run(8.5, compiled=False).log)


def test_solver_calls_stay_in_the_virtual_machine(cache):
    """IPOPT cannot be written as C; the reason says so."""
    task = fp.load_problem("van_der_pol")
    short = replace(task.problem, duration=4 * task.problem.period, measure_from=0.0)
    assert why_not(fp.simulate(short, fp.RecedingHorizon(fp.Ipopt()), seed=0, compiled=True))
