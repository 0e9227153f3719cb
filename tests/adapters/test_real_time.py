"""Machines: cycles by the clock on the wall, which is the test's own, and what a machine is left with when a run ends."""

import os
import shlex
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.adapters.tclab import RealTime
from fpirhc.errors import InvalidProblem

PERIOD = 0.1
TANK = fp.Plant(
    {"h": "m"},
    {"q": "m/s"},
    {"outlet": fp.Parameter(approximate=0.3, exact=0.3, unit="1/s")},
    lambda q, u, p: {"h": u.q - p.outlet * q.h},
    order=1,
)


class Tank:
    """Another outlet than the model's."""

    def __init__(self, inflow: Callable[[], float], show: Callable[[float], None]) -> None:
        self.inflow, self.show, self.now, self.level = inflow, show, 0.0, 1.0

    @property
    def clock(self) -> RealTime:
        return RealTime(lambda: self.now, self.sleep)

    def begin(self) -> None:
        self.level = 1.0
        self.show(self.level)

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        self.level += seconds * (self.inflow() - 0.5 * self.level)
        self.show(self.level)


LONG = 2.95  # s, for which a write hangs
LATE = "the cycle of 0.1 s ended 2.85 s late; choose a longer period, or a quicker bus or controller"


class Machine:
    """A tank on a bus, as a user writes it. Its third command, or the twentieth, is `bad`; what is sent is kept."""

    def __init__(self, bad: str = "") -> None:
        self.bad, self.sent, self.times, self.log = bad, 0.0, [], []
        self.tank = Tank(lambda: self.sent, lambda _level: None)
        self.clock = self.tank.clock

    def reset(self, _seed):
        self.log.append("open")
        self.clock.begin()
        return [self.tank.level]

    def step(self, time, command):
        with self.clock.cycle(time, PERIOD):
            [self.sent] = command
            self.log.append(float(self.sent))
            self.times.append(self.tank.now)
            if self.bad == "refused" and len(self.times) == 3:
                raise ConnectionError
            if self.bad == "hangs" and len(self.times) == 3:
                self.tank.sleep(LONG)
            if self.bad == "network" and len(self.times) >= 20:
                raise OSError("network is gone")
            if self.bad == "Ctrl-C" and len(self.times) == 20:
                os.kill(os.getpid(), signal.SIGINT)
        return [self.tank.level]

    def close(self):
        self.log.append("close")


def task(machine: Machine, rest=None) -> fp.Problem:
    return fp.Problem(
        plant=TANK,
        reality=fp.ExternalPlant(machine, {"h": "m"}, rest={"q": 0.25} if rest is None else rest),
        sensing=fp.Sensing(estimator=fp.PositionDifference()),
        reference=fp.Trajectory(lambda t: {"h": 1.0 + 0.1 * t}),
        start={"h": 1.0},
        period=PERIOD,
        duration=5.0,
    )


def run(problem: fp.Problem) -> fp.Run:
    return fp.simulate(problem, fp.ComputedTorque(fp.Exponential(rate=2.0)), seed=0, compiled=False)


def mistakes(machine: Machine, own: list[float]) -> list[str]:
    """Why the answer of each cycle is bad, or nothing; the controller takes its own time, s, before each."""
    body = fp.ExternalPlant(machine, {"h": "m"}, rest={})
    body.first(0)
    found = [""] * len(own)
    for k, seconds in enumerate(own):
        machine.tank.sleep(seconds)
        try:
            body.read(k * PERIOD, np.array([0.5]))
        except InvalidProblem as error:
            found[k] = str(error)
    return found


@pytest.mark.parametrize(("bad", "lasts", "words"), [("refused", PERIOD, "ConnectionError"), ("hangs", LONG, LATE)])
def test_a_command_that_is_refused_or_hangs_is_told_and_no_burst_follows(bad, lasts, words):
    """A cycle with an error lasts its period; the commands of cycles that were missed would else go out at one instant."""
    machine = Machine(bad)
    told = mistakes(machine, [0.0] * 6)
    assert [words in mistake for mistake in told] == [bool(mistake) for mistake in told] == [k == 2 for k in range(6)]
    assert np.diff(machine.times) == pytest.approx([PERIOD, PERIOD, lasts, PERIOD, PERIOD])


def test_a_cycle_that_is_a_little_late_is_caught_up():
    """The clock does not drift with the controller's own time; time 0 is that of the first command."""
    machine = Machine()
    assert not any(mistakes(machine, [1.0, 0.15, 0.0, 0.0]))
    assert machine.tank.now == pytest.approx(1.0 + 4 * PERIOD)


@pytest.mark.parametrize(
    ("bad", "cycles", "ends"),
    [
        ("", 50, None),
        ("network", 20, "network is gone"),
        ("Ctrl-C", 20, KeyboardInterrupt),
        ("refused", 3, "ConnectionError"),
    ],
)
def test_a_machine_is_left_with_what_rests_however_a_run_ends(bad, cycles, ends):
    """A finished run, a lost network, Ctrl-C, a refused command: the stated input is sent last, and the connection closed."""
    machine, one = Machine(bad), None
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        if ends is KeyboardInterrupt:
            with pytest.raises(KeyboardInterrupt):
                run(task(machine))
        else:
            one = run(task(machine))
    assert machine.log[0] == "open"
    assert machine.log[-2:] == [0.25, "close"]
    assert machine.log.count("close") == 1
    assert len(machine.times) == cycles + 1
    if isinstance(ends, str):
        assert ends in str(one.stop)
    warned = "the inputs at rest may not have arrived: reality: step of Machine raised OSError: network is gone"
    assert [str(w.message) for w in told if "at rest" in str(w.message)] == [warned] * (bad == "network")


def test_what_rests_is_stated():
    """A machine has no default that nobody chose; a body without `close` is not a machine, and {} sends nothing."""
    with pytest.raises(InvalidProblem, match=r"has close\(\), and would keep its last command .* rest={'u': 0.0}"):
        fp.ExternalPlant(Machine(), {"h": "m"})
    with pytest.raises(InvalidProblem, match="input 'p' is unknown"):
        task(Machine(), rest={"p": 0.0})
    machine = Machine()
    run(task(machine, rest={}))
    assert len(machine.times) == 50
    assert machine.log[-1] == "close"


def test_a_body_has_the_period_that_it_was_made_with():
    """Commands would else be held for another time than the problem's cycle, and nobody would see it."""
    body = fp.ExternalPlant(Machine(), {"h": "m"}, rest={}, period=0.1)
    with pytest.raises(InvalidProblem, match=r"one step of it takes 0\.1, and the problem's period is 0\.2"):
        body.check_motion(np.zeros(1), np.zeros(1), fp.RungeKutta4(), 0.2)
    body.check_motion(np.zeros(1), np.zeros(1), fp.RungeKutta4(), 0.1)


HEATER = """
import os, signal
from pathlib import Path
import fpirhc as fp

class Heater:
    def note(self, what):
        with Path("log").open("a") as file:
            file.write(f"{what} ")

    def reset(self, seed):
        self.T, self.steps = 0.0, 0
        self.note("open")
        return [self.T]

    def step(self, time, command):
        self.steps += 1
        self.note(float(command[0]))
        if self.steps == 5 and (name := os.environ.get("ENDED_BY")):
            os.kill(os.getpid(), getattr(signal, name))
        self.T += (0.8 * float(command[0]) - self.T) / 20
        return [self.T]

    def close(self):
        self.note("close")

plant = fp.Plant({"T": "K"}, {"Q": "%"}, {}, lambda q, u, p: {"T": (0.8 * u.Q - q.T) / 20}, order=1)
problem = fp.Problem(
    plant, fp.Trajectory(lambda t: {"T": 60.0 + 0 * t}), start={"T": 0.0}, period=1.0, duration=8.0,
    reality=fp.ExternalPlant(Heater(), {"T": "K"}, rest={"Q": 0.0}), sensing=fp.Sensing(estimator=fp.PositionDifference()),
)
controllers = {"CTC": fp.ComputedTorque(fp.Exponential(rate=0.2))}
"""


def by_command(folder: Path, words: str, **environment: str) -> tuple[int, list[str]]:
    """Exit code of a command in a process of its own, and what the heater noted."""
    (folder / "heater.py").write_text(HEATER)
    there = {**os.environ, "PYTHONPATH": str(Path(fp.__file__).parents[1]), **environment}
    call = [sys.executable, "-m", "fpirhc", *shlex.split(words), "--no-compile"]
    heard = partial(signal.signal, signal.SIGHUP, signal.SIG_DFL) if os.name == "posix" else None  # under nohup, too
    done = subprocess.run(call, cwd=folder, env=there, capture_output=True, check=False, preexec_fn=heard)
    return done.returncode, (folder / "log").read_text().split()


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("ended_by", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_command_that_is_ended_from_outside_leaves_a_machine_at_rest(ended_by, tmp_path):
    """Ctrl-C, a service that is stopped, a terminal that is closed."""
    code, log = by_command(tmp_path, "run heater.py CTC", ENDED_BY=ended_by)
    assert code == 130
    assert log[0] == "open"
    assert float(log[5]) > 50
    assert log[6:] == ["0.0", "close"]


def test_a_machine_is_commanded_by_one_run_at_a_time(tmp_path):
    """Two processes of a study would have two loops on one heater."""
    code, log = by_command(tmp_path, "study heater.py --over tracking.rate=0.1:0.3:5 --processes 2")
    assert code == 0
    assert [what for what in log if what in ("open", "close")] == 5 * ["open", "close"]
