"""Ctrl-C in a solver and in a step is an interruption, and no fault of theirs."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from unittest.mock import Mock

import casadi as ca
import numpy as np
import pytest
from helpers import tasks

import fpirhc as fp


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


def test_an_interruption_inside_a_solver_is_an_interruption():
    """IPOPT catches it and goes on, and CasADi reports it as a SystemError, which would be taken for a fault of the program."""
    long = replace(tasks.two_mass.problem, duration=500.0)
    reports: list[int] = []

    def run() -> None:
        controller = fp.RecedingHorizon(fp.Ipopt())
        ended = fp.simulate(long, controller, seed=0, compiled=False, progress=lambda cycle, _: reports.append(cycle))
        pytest.fail(f"the run ended after {ended.cycles} of {long.cycles} cycles and not as interrupted: {ended.stop}")

    with interrupted_once(lambda: reports, every=0.01), pytest.raises(KeyboardInterrupt):
        run()


class Interrupts(ca.Callback):
    """Ctrl-C in the middle of a Function of a user's own."""

    def __init__(self) -> None:
        ca.Callback.__init__(self)
        self.construct("interrupts", {})

    def eval(self, arguments):
        signal.raise_signal(signal.SIGALRM)
        return [arguments[0]]


def test_an_interruption_of_a_stepper_is_no_failed_solver(monkeypatch):
    """A failed solver holds the command; an interruption goes to the caller, whichever error CasADi makes of it."""
    wrapped = SystemError("a result with an exception set")
    wrapped.__cause__ = KeyboardInterrupt()
    x, interrupts = ca.MX.sym("x"), Interrupts()
    broken = ca.Function("f", [x], [interrupts(x)])
    for error, expected in [
        (lambda: broken(1.0), KeyboardInterrupt),
        (Mock(side_effect=wrapped), KeyboardInterrupt),
        (Mock(side_effect=SystemError("a fault")), SystemError),
    ]:
        stepper = fp.Stepper(tasks.two_mass.problem, tasks.two_mass.controllers["CTC"], compiled=False)
        monkeypatch.setattr(stepper, "_evaluate", error)
        with interrupted_once(lambda: True, every=3600.0), pytest.raises(expected):
            stepper.step(0.0, np.zeros(4), np.zeros(2), stepper.start())
