"""What meets the world around: files, names of letters, runs that are not finite, and traps of the libraries below."""

import os
import pickle
import stat
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp

posix = pytest.mark.skipif(os.name != "posix", reason="links and modes of POSIX")


def test_what_a_killed_process_left_blocks_no_write(tmp_path):
    """Numbers of processes come again in containers; the longest name of a file system is written."""
    torn, one = tmp_path / f".run.npz.{os.getpid()}", run(driven("mu"))
    torn.write_text("torn")
    for name in ("run.npz", "n" * 251):
        one.save(tmp_path / name)
        assert np.array_equal(fp.load_run(tmp_path / name).log, one.log)
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted([torn.name, "run.npz", "n" * 251])


@posix
def test_links_and_modes_stay(tmp_path):
    target, link, new = (tmp_path / f"{name}.npz" for name in ("target", "link", "new"))
    one = run(driven("mu"))
    target.write_text("old")
    target.chmod(0o600)
    link.symlink_to(target)
    for path in (link, new):
        one.save(path)
    assert link.is_symlink()
    assert np.array_equal(fp.load_run(target).log, one.log)
    assert stat.S_IMODE(target.stat().st_mode) == 0o600
    mask = os.umask(0)
    os.umask(mask)
    assert stat.S_IMODE(new.stat().st_mode) == 0o666 & ~mask


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


# Traps of the libraries below: what they do wrong without saying so, and that a guard here catches it


def test_ipopt_prints_nothing(capfd):
    """Its banner would spoil what --json prints."""
    short = replace(fp.load_problem("two_mass").problem, duration=0.01, measure_from=0.0)
    fp.simulate(short, fp.RecedingHorizon(fp.Ipopt(tolerance=1e-3)), seed=0, compiled=False)
    assert capfd.readouterr().out == ""


def test_a_power_has_no_finite_derivatives_at_its_kink():
    """CasADi's derivatives of sign(e) |e|^1.5 at zero are NaN or infinite; signed_power is rounded off and has finite ones."""
    e = ca.SX.sym("e")

    def derivatives(value):
        hessian, gradient = ca.hessian(value, e)
        return [float(v) for v in ca.Function("derivatives", [e], [gradient, hessian])(0.0)]

    assert not np.isfinite(derivatives(ca.sign(e) * ca.fabs(e) ** 1.5)).all()
    slope, curvature = derivatives(fp.signed_power(e, 1.5))
    assert 0 < slope < 1e-2 > abs(curvature)


def test_the_package_is_pickled_by_its_name():
    """lazy_loader gives it a class of module that pickles by value cannot take; functions of notebooks hold the package itself."""
    content = pickle.dumps(fp)
    assert len(content) < 100
    assert pickle.loads(content) is fp
