"""Ctrl-C in a solver, in a step and in a build is an interruption, and no fault of theirs."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import casadi as ca
import numpy as np
import pytest
from helpers.line import line_text

import fpirhc as fp
from fpirhc.contraction import spectrum
from fpirhc.controllers.live_settings import live_settings
from fpirhc.errors import NotSupported
from fpirhc.symbolic.evaluate import Evaluator, attempted

LINE = line_text("period=5e-3, duration=1.5, measure_from=0.5, disturbances={'u': fp.Noise(0.1)}")
PLANNED = """measure_from=0.5,
    horizon=fp.Horizon(stages=30, step=5e-3),
    cost=fp.Quadratic(states={'y': 1.0}, deviation={'u': 1e-3}),"""
LONG = LINE.replace("measure_from=0.5,", PLANNED).replace(
    "controllers = {", "controllers = {\n    'RHC': fp.RecedingHorizon(fp.Ipopt()),"
)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """An empty working folder with a problem."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "line.py").write_text(LINE)
    return tmp_path


@contextmanager
def interrupted_once(begun: Callable[[], object], *, every: float = 0.05) -> Iterator[None]:
    """A signal that is answered as Ctrl-C is, wherever the program is at the first tick at which `begun` is true."""

    def interrupt(number: int, frame: object) -> None:
        if begun():
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, every, every)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


class _Interrupts(ca.Callback):
    """Ctrl-C in the middle of a Function."""

    def __init__(self) -> None:
        ca.Callback.__init__(self)
        self.construct("interrupts", {})

    def eval(self, arguments):
        signal.raise_signal(signal.SIGALRM)
        return [arguments[0]]


@pytest.mark.parametrize(
    "asked",
    [lambda e: e.failure(), lambda e: e(1.0), lambda e: attempted("part", e.function, 1.0, broken=[])],
    ids=["failure", "call", "part of a result"],
)
def test_an_interruption_between_two_operations_is_an_interruption(asked):
    """CasADi reports it as a RuntimeError, which looks like a solver that failed: a run would end early."""
    x, interrupts = ca.MX.sym("x"), _Interrupts()
    evaluator = Evaluator(ca.Function("f", [x], [interrupts(x)]))
    with interrupted_once(lambda: True, every=3600.0), pytest.raises(KeyboardInterrupt):
        asked(evaluator)


@pytest.mark.parametrize("every", [0.003, 0.01, 0.05])
def test_an_interruption_inside_a_solver_is_an_interruption(every, folder):
    """IPOPT catches it and goes on, and CasADi reports it as a SystemError, which would be taken for a fault of the program.

    The run is interrupted after its first report, and no machine solves the rest of its 100 000 plans before the next tick.
    """
    (folder / "long.py").write_text(LONG)
    task = fp.load_problem("long.py")
    long = replace(task.problem, duration=500.0)
    reports: list[int] = []

    def run() -> None:
        ended = fp.simulate(
            long, task.controllers["RHC"], seed=0, compiled=False, progress=lambda cycle, _: reports.append(cycle)
        )
        pytest.fail(f"the run ended after {ended.cycles} of {long.cycles} cycles and not as interrupted: {ended.stop}")

    with interrupted_once(lambda: reports, every=every), pytest.raises(KeyboardInterrupt):
        run()


def test_an_interruption_of_a_stepper_is_no_failed_solver(folder, monkeypatch):
    """A failed solver holds the command; an interruption goes to the caller, whichever error CasADi makes of it."""
    task = fp.load_problem("line.py")
    wrapped = SystemError("a result with an exception set")
    wrapped.__cause__ = KeyboardInterrupt()
    for error, expected in [
        (RuntimeError("KeyboardInterrupt"), KeyboardInterrupt),
        (wrapped, KeyboardInterrupt),
        (SystemError("a fault"), SystemError),
    ]:
        stepper = fp.Stepper(task.problem, task.controllers["CTC"], compiled=False)
        raising = Mock(side_effect=error)
        monkeypatch.setattr(stepper, "_evaluate", raising)
        with pytest.raises(expected):
            stepper.step(0.0, np.zeros(2), np.zeros(1), stepper.start())
        assert raising.called


class _Raising(ca.Callback):
    """A Function of a user's own that raises where it is evaluated."""

    def __init__(self, error: BaseException) -> None:
        ca.Callback.__init__(self)
        self.error = error
        self.construct("raising", {})

    def get_n_in(self) -> int:
        return 4

    def eval(self, _: object) -> list[float]:
        raise self.error


@pytest.mark.parametrize(
    ("error", "expected", "words"),
    [(ZeroDivisionError("of my own"), RuntimeError, "of my own"), (KeyboardInterrupt(), KeyboardInterrupt, None)],
    ids=["own error", "interruption"],
)
def test_a_solver_that_gives_up_hides_no_other_error(error, expected, words, monkeypatch):
    """Response Jacobians are not finite where Newton's method has no derivative; an error of the equations is raised."""
    plant = fp.load_problem("two_mass").problem.plant
    row = (np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)), np.zeros(1))
    raising = _Raising(error)
    monkeypatch.setattr(spectrum, "response_jacobian", lambda plant: raising)
    with pytest.raises(expected, match=words):
        spectrum.response_jacobians(plant, *row)
    z, p = ca.MX.sym("z"), ca.MX.sym("p")
    root = ca.rootfinder("root", "fast_newton", ca.Function("f", [z, p], [z**2 - p]))
    unsolved = ca.Function("unsolved", [*(ca.MX.sym(n) for n in "abc"), p], [ca.jacobian(root(0.0, p), p)])
    monkeypatch.setattr(spectrum, "response_jacobian", lambda plant: unsolved)
    assert np.isnan(spectrum.response_jacobians(plant, *row)).all()


def test_an_interruption_while_a_loop_with_live_settings_is_built_is_no_setting_that_cannot_be_live():
    task = fp.load_problem("two_mass")
    live = live_settings(task.problem, task.controllers["CTC"], ["tracking.rate"])
    with pytest.raises(KeyboardInterrupt):
        live.composed(Mock(side_effect=RuntimeError("in a solver: KeyboardInterrupt")))
    with pytest.raises(NotSupported, match="of my own"):
        live.composed(Mock(side_effect=RuntimeError("of my own")))
