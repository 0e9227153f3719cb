"""What meets the world around: files that are written, names of letters, processes that were forked, runs that are not finite."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.symbolic import native
from fpirhc.whole_file import write_whole

posix = pytest.mark.skipif(os.name != "posix", reason="links, modes and forks of POSIX")


def test_what_a_killed_process_left_blocks_no_write(tmp_path):
    """Numbers of processes come again in containers."""
    path = tmp_path / "report.html"
    (tmp_path / f".report.html.{os.getpid()}").write_text("torn")
    write_whole("x", path, "report")
    assert path.read_text() == "x"
    assert sorted(one.name for one in tmp_path.iterdir()) == [f".report.html.{os.getpid()}", "report.html"]


@posix
def test_links_and_modes_stay(tmp_path):
    target, link, new = tmp_path / "target.json", tmp_path / "link.json", tmp_path / "new.json"
    target.write_text("old")
    target.chmod(0o600)
    link.symlink_to(target)
    for path in (link, new):
        write_whole("new", path, "baseline")
    assert link.is_symlink()
    assert target.read_text() == "new"
    assert stat.S_IMODE(target.stat().st_mode) == 0o600
    mask = os.umask(0)
    os.umask(mask)
    assert stat.S_IMODE(new.stat().st_mode) == 0o666 & ~mask


def test_the_longest_name_is_written(tmp_path):
    path = tmp_path / ("n" * 251)
    write_whole("x", path, "report")
    assert path.read_text() == "x"


@posix
def test_a_forked_child_leaves_the_cache_of_its_parent():
    """And the parent removes it at its own end."""
    code = (
        "import os, sys\nfrom fpirhc.symbolic.native import cache_folder\nfolder = cache_folder()\nchild = os.fork()\n"
        "if child == 0:\n    sys.exit()\nos.waitpid(child, 0)\nprint(folder, folder.is_dir())"
    )
    environment = {**os.environ, "FPIRHC_CACHE": "/dev/null", "PYTHONPATH": str(Path(fp.__file__).parents[1])}
    words = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    ).stdout.split()
    assert words[1] == "True"
    assert not Path(words[0]).exists()
    assert native.cache_folder() != Path(words[0])


def driven(friction: str, angle: str = "x") -> fp.Problem:
    def response(q, v, u, p):
        return {angle: (u.F - getattr(p, "\N{GREEK SMALL LETTER MU}" if friction != "mu" else "mu") * v[angle]) / p.m}

    plant = fp.Plant(
        coordinates={angle: "m"},
        inputs={"F": "N"},
        response=response,
        parameters={"m": fp.Parameter(1.0, 1.2, "kg"), friction: fp.Parameter(0.1, 0.2, "N s/m")},
    )
    wave = fp.Trajectory(lambda t: {angle: ca.sin(t)})
    return fp.Problem(plant=plant, reference=wave, start={angle: 0.0, f"{angle}'": 1.0}, period=1e-2, duration=1.0)


def run(problem: fp.Problem) -> fp.Run:
    return fp.simulate(problem, fp.ComputedTorque(fp.Exponential(rate=6.0)), seed=0, compiled=False)


def test_the_micro_sign_is_the_letter_that_python_reads():
    """`p.\N{MICRO SIGN}` of a German keyboard asks for U+03BC (PEP 3131); the run is that of a parameter called mu."""
    assert np.array_equal(run(driven("\N{MICRO SIGN}")).log, run(driven("mu")).log)


@pytest.mark.parametrize("late", [0.3 - 0.2 - 0.1, 1e-13])
def test_a_dead_time_below_rounding_is_none(late):
    late = abs(late)
    assert late > 0
    plain = driven("mu")
    one = replace(plain, dead_time=fp.DeadTime(inputs={"F": late}, measurement=late))
    assert one.dead_time.queued == ()
    assert np.array_equal(run(one).log, run(plain).log)


def test_a_run_that_is_not_finite_is_not_complete(tmp_path):
    """Whoever made its log; in its words, and after it was saved and loaded."""
    one = run(driven("mu"))
    log = one.log.copy()
    log[17, one.layout.slice("command")] = np.nan
    broken = replace(one, log=log)
    assert "complete" in repr(one)
    assert "complete" not in repr(broken)
    assert "'command.F' is not finite in cycle 17" in broken.stop
    broken.save(tmp_path / "run")
    assert fp.load_run(tmp_path / "run").stop == broken.stop
