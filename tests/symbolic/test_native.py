"""Compiled loops: the same numbers, a cache that is never wrong, and a fallback that says why."""

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

import fpirhc as fp

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
