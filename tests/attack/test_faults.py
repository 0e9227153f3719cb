"""Faults of a loop - what happens to sample, command, memory or plant - leave no raw error, no command outside, nothing frozen."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc import Status
from fpirhc.contracts import Controller, values_of
from fpirhc.errors import FpirhcError

Array = np.ndarray
FIRST, BEGIN = 0, 30  # cycles in which faults begin


@dataclass
class Cycle:
    """What one cycle of a loop passes on; a fault changes it in place."""

    number: int
    time: float
    state: Array
    realised: Array
    memory: Array
    past: list[tuple[Array, Array]]  # earlier samples, newest last


@dataclass(frozen=True)
class Fault:
    """A fault that begins, lasts and ends."""

    name: str
    sample: Callable[[Cycle], None] | None = None
    actuator: Callable[[Array, Array, Array], Array] | None = None  # (command, lower, upper) -> what the plant is given
    heavier: float = 1.0  # factor on the plant's first parameter
    first: int = BEGIN
    length: int = 1
    single: bool = False  # one bad sample, after which everything must be as with the tick left out

    @property
    def end(self) -> int:
        """First cycle after the fault."""
        return self.first + self.length


def _set(what: str, value: float, entry: int | None = None) -> Callable[[Cycle], None]:
    def change(cycle: Cycle) -> None:
        array = getattr(cycle, what).copy()
        array[slice(None) if entry is None else entry] = value
        setattr(cycle, what, array)

    return change


def _clock(change: Callable[[float], float]) -> Callable[[Cycle], None]:
    def apply(cycle: Cycle) -> None:
        cycle.time = change(cycle.time)

    return apply


def _old(age: int) -> Callable[[Cycle], None]:
    def apply(cycle: Cycle) -> None:
        if len(cycle.past) > age:
            cycle.state, cycle.realised = cycle.past[-1 - age]

    return apply


def _stuck(cycle: Cycle) -> None:
    cycle.state, cycle.realised = cycle.past[BEGIN - 1]


def _poison(place: Callable[[int], slice]) -> Callable[[Cycle], None]:
    def apply(cycle: Cycle) -> None:
        cycle.memory = cycle.memory.copy()
        cycle.memory[place(cycle.memory.size)] = np.nan

    return apply


SINGLE = (
    Fault("state is NaN", _set("state", np.nan), single=True),
    Fault("one state is NaN", _set("state", np.nan, 0), single=True),
    Fault("state is infinite", _set("state", np.inf), single=True),
    Fault("response is NaN", _set("realised", np.nan), single=True),
    Fault("response is infinite", _set("realised", -np.inf), single=True),
    Fault("clock is NaN", _clock(lambda _: np.nan), single=True),
    Fault("state overflows, 1e301", _set("state", 1e301), single=True),
)
LASTING = (
    Fault("response spikes, 1e9", _set("realised", 1e9)),
    Fault("response spikes, 1e155", _set("realised", 1e155)),
    Fault("state spikes, 1e9", _set("state", 1e9)),
    Fault("state spikes, 1e155", _set("state", 1e155)),
    Fault("samples lost, 5 cycles", _set("state", np.nan), length=5),
    Fault("samples stuck, 10 cycles", _stuck, length=10),
    Fault("samples 3 cycles late", _old(3), length=20),
    Fault("clock repeats", _clock(lambda t: t - 1e-3), length=2),
    Fault("clock goes back", _clock(lambda t: 0.5 * t), length=3),
    Fault("clock overflows", _clock(lambda _: 1e308)),
    Fault("memory is NaN", _poison(lambda _: slice(None))),
    Fault("half of the memory is NaN", _poison(lambda n: slice(n // 2, None))),
    Fault("one number of the memory is NaN", _poison(lambda n: slice(n - 1, n))),
    Fault("actuator gives nothing", actuator=lambda u, low, high: 0 * u, length=15),
    Fault(
        "actuator stuck at its upper limit",
        actuator=lambda u, low, high: np.where(np.isfinite(high), high, u),
        length=15,
    ),
    Fault("actuator of the opposite sign", actuator=lambda u, low, high: -u, length=15),
    Fault("parameter jumps", heavier=1.3, length=10**6),
)
_EARLY = (*SINGLE, *(f for f in LASTING if "spikes" in f.name))
AT_START = tuple(replace(f, name=f"at the start, {f.name}", first=FIRST, length=3, single=False) for f in _EARLY)
FAULTS = (*SINGLE, *LASTING, *AT_START)


# A stepper and its plant are driven through a fault

_GONE = 1e12  # size of a state that no plant comes back from
CYCLES, LATE = 80, 15  # cycles of a run, and of its end, in which a controller must act again
SKIPPING = {Status.BAD_SAMPLE, Status.NON_FINITE, Status.SOLVER_FAILED, Status.RESTARTED}


class Bench:
    """A controller on its plant, ready for any number of faults."""

    def __init__(self, problem: fp.Problem, controller: Controller) -> None:
        self.problem, plant = problem, problem.plant
        self.stepper = fp.Stepper(problem, controller, compiled=False)
        self.limits = problem.limits.input_bounds(plant)
        self._advance = problem.integrator.step(plant, problem.period)
        x, u, p = plant.symbols()
        values = values_of(plant, x, u, p)
        self._names = [name + "'" * order for name, order in plant.response_orders.items()]
        rows = ca.densify(ca.vertcat(*(values[name] for name in self._names)))
        self._response = ca.Function("response", [x, u, p], [rows])
        self._calm = np.zeros(len(plant.names))
        self.lost = False  # whether the plant itself left its domain, such as a tank below its bottom
        self.clean = self._run(None)[0]

    def wrong(self, fault: Fault) -> str:
        """What a machine would suffer from; empty where nothing did."""
        try:
            differs = fault.single and self._differs(fault)
            commands, statuses = self._run(fault)
        except FpirhcError as error:
            return f"refused: {error}"
        except Exception as error:  # noqa: BLE001 -- every error that gets here is what is looked for
            return f"{type(error).__name__}: {error}"
        lower, upper = self.limits
        outside = int((~np.isfinite(commands) | (commands < lower) | (commands > upper)).any(axis=1).sum())
        late = commands[-LATE:]
        # A command at a limit stays there for good reason; one that is held between its limits does not move again.
        still = (np.ptp(late, axis=0) == 0).all() and ((late[-1] > lower) & (late[-1] < upper)).any()
        moves = np.ptp(self.clean[-LATE:], axis=0).max() > 0
        skips = all(status in SKIPPING for status in statuses[-LATE:])
        frozen = not self.lost and fault.end < CYCLES - LATE and (skips or (still and moves))
        facts = {
            f"{outside} commands outside": outside > 0,
            "it still skips its cycles, or holds its command, at the end": frozen,
            "not equal to the tick left out": differs,
        }
        return "; ".join(text for text, true in facts.items() if true)

    def _run(self, fault: Fault | None) -> tuple[np.ndarray, list[Status]]:
        commands, statuses = [], []
        past: list[tuple[np.ndarray, np.ndarray]] = []
        plant, period = self.problem.plant, self.problem.period
        memory, x = self.stepper.start(), np.array(self.problem.start_state)
        u, exact = np.zeros(plant.input.size), np.array(plant.exact)
        self.lost = False
        for k in range(CYCLES):
            active = fault is not None and fault.first <= k < fault.end
            if active and fault is not None and exact.size:
                exact = np.array(plant.exact) * np.where(np.arange(exact.size) == 0, fault.heavier, 1.0)
            realised = np.asarray(self._response(x, u, exact).full()).ravel()
            cycle = Cycle(k, k * period, x.copy(), realised, memory, past)
            if active and fault is not None and fault.sample is not None:
                fault.sample(cycle)
            past.append((x.copy(), realised))
            command, memory = self._step(cycle)
            commands.append(command)
            statuses.append(Status(int(self.stepper.trace()["status"][0])))
            u = command
            if active and fault is not None and fault.actuator is not None:
                u = fault.actuator(command, *self.limits)
            x = np.asarray(self._advance(x, u, exact, self._calm).full()).ravel()
            self.lost |= not (np.abs(x) <= _GONE).all()
        return np.array(commands), statuses

    def _step(self, cycle: Cycle) -> tuple[np.ndarray, np.ndarray]:
        return self._stepped(cycle.time, *self._shown(cycle), cycle.memory)

    @property
    def _stepped(self) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
        return self.stepper.step_measured if self.stepper.estimates else self.stepper.step

    def _shown(self, cycle: Cycle) -> tuple[np.ndarray, ...]:
        """What a step is given; a controller that estimates its state is given what its sensors show."""
        if not self.stepper.estimates:
            return cycle.state, cycle.realised
        plant = self.problem.plant
        names = (*plant.state.elements, *self._names)
        values = dict(zip(names, (*cycle.state, *cycle.realised), strict=True))
        return (np.array([values[n] for n in self.stepper.measures]),)

    def _differs(self, fault: Fault) -> bool:
        """Whether later commands differ from those with the tick of the fault left out, for the same measurements."""
        memories = [self.stepper.start()] * 2
        x = np.array(self.problem.start_state)
        generator = np.random.default_rng(0)
        size = len(self._names)
        for k in range(fault.first + 10):
            state, realised = x + 1e-3 * generator.standard_normal(x.size), generator.standard_normal(size)
            clean = Cycle(k, k * self.problem.period, state, realised, memories[1], [])
            cycle = Cycle(k, clean.time, state.copy(), realised.copy(), memories[0], [])
            if k == fault.first and fault.sample is not None:
                fault.sample(cycle)
            one, memories[0] = self._step(cycle)
            shown, right = self._shown(cycle), self._shown(clean)
            if cycle.time != clean.time or not all(map(np.array_equal, shown, right)):
                continue  # the fault reaches what the step is given
            other, memories[1] = self._step(clean)
            if not np.array_equal(one, other):
                return True
        return False


QUICK: tuple[Any, ...] = (("two_mass", "CTC+FPI (eq 6)"), ("two_mass", "RHC+FPI"), ("noisy_motor", "RHC"))
PROBLEMS: tuple[str, ...] = ("two_mass", "van_der_pol", "cart_pole", "delayed_mass", "noisy_motor", "two_link_arm")
PROBLEMS += ("mass_spring_slots", "delayed_tanks", "three_link_arm", "chain_of_masses", "mrac_pendulum")


@pytest.mark.parametrize(("name", "of"), [*QUICK, *(pytest.param(n, None, marks=pytest.mark.slow) for n in PROBLEMS)])
def test_faults_of_the_loop(name, of):
    """A single bad sample is a tick left out; of all controllers in the slow lane."""
    task = fp.load_problem(name)
    for title in [of] if of else task.controllers:
        bench = Bench(task.problem, task.controllers[title])
        wrong = {fault.name: bench.wrong(fault) for fault in FAULTS}
        assert {k: v for k, v in wrong.items() if v} == {}, title
