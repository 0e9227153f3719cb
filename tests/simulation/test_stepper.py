"""A controller against a machine: misuse, threads, solvers that raise, and what is wrong but finite."""

from __future__ import annotations

import threading
from dataclasses import replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.plants import linear
from helpers.replay import status

import fpirhc as fp
from fpirhc import Status
from fpirhc.conformance.loops import two_masses
from fpirhc.contracts import Controller, Deformation
from fpirhc.errors import ConcurrentUse, FpirhcError, InvalidShape, InvalidValue, NotSupported
from fpirhc.symbolic.evaluate import Latest

TRACK = fp.Exponential(rate=6.0)
SHAPE = fp.Sigmoid(gain=-0.5, scale=50.0)
CONTROLLERS: dict[str, Controller] = {
    "computed torque": fp.ComputedTorque(TRACK, SHAPE),
    "plan": fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-3), SHAPE),
}
PROBLEM = replace(two_masses(), duration=0.4)


@cache
def case(name: str) -> tuple[fp.Stepper, fp.Run]:
    """A stepper and a run whose measurements it is given."""
    controller = CONTROLLERS[name]
    return fp.Stepper(PROBLEM, controller, compiled=False), fp.simulate(PROBLEM, controller, seed=0, compiled=False)


def sample(run: fp.Run, cycle: int, **bad: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Time, state and response of one cycle, the named ones multiplied by a bad number."""
    time, state, realised = (bad.get(name, 1.0) for name in ("time", "state", "realised"))
    return time * float(run.time[cycle]), state * run["state"][cycle], realised * run["realised"][cycle]


@pytest.mark.parametrize("name", ["computed torque", "plan"])
def test_compiled_gate_is_the_same(name):
    virtual, run = case(name)
    compiled = fp.Stepper(PROBLEM, CONTROLLERS[name])
    memories = [virtual.start(), compiled.start()]
    for k in range(20):
        factor = np.nan if k in {0, 7, 8} else 1.0
        memories = [np.full_like(m, np.nan) if k == 12 else m for m in memories]
        (one, first), (other, second) = (
            s.step(*sample(run, k, state=factor), m) for s, m in zip((virtual, compiled), memories, strict=True)
        )
        memories = [first, second]
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9, equal_nan=False)
        assert status(virtual) == status(compiled)


# Misuse


def misuses(memory: np.ndarray) -> dict[str, tuple[type[FpirhcError], str, tuple[Any, ...]]]:
    """What a caller may get wrong: error, words of the message, arguments."""
    x, r = np.zeros(4), np.zeros(2)
    return {
        "scalar state": (InvalidShape, "'state' has 4 entries", (0.0, 1.0, r, memory)),
        "truth value as time": (InvalidValue, "'time' must be a number of seconds, got True", (True, x, r, memory)),
        "truth value": (InvalidValue, "'state' must be made of real numbers", (0.0, True, r, memory)),
        "text": (InvalidValue, "'state' must be made of real numbers", (0.0, "5", r, memory)),
        "no memory": (InvalidValue, "'memory' is not made of numbers", (0.0, x, r, None)),
        "no response": (InvalidValue, "'realised' is not made of numbers", (0.0, x, None, memory)),
        "short state": (InvalidShape, "'state' has 4 entries", (0.0, x[:3], r, memory)),
        "matrix": (InvalidShape, "'state' has 4 entries", (0.0, x.reshape(2, 2), r, memory)),
        "swapped": (InvalidShape, "'state' has 4 entries", (0.0, r, x, memory)),
        "ragged": (InvalidValue, "'state' is not made of numbers", (0.0, [[1.0], [1.0, 2.0]], r, memory)),
        "complex": (InvalidValue, "real numbers", (0.0, x + 0j, r, memory)),
        "dictionary": (InvalidValue, "'state' is not made of numbers", (0.0, {"a": 1.0}, r, memory)),
        "short memory": (InvalidShape, "'memory' has", (0.0, x, r, memory[:-1])),
        "masked": (FpirhcError, "masked", (0.0, np.ma.masked_array(x, [True, *3 * [False]]), r, memory)),
        "truth value of numpy": (FpirhcError, "seconds", (np.bool_(False), x, r, memory)),
        "text in an array": (FpirhcError, "numbers", (0.0, x, np.array(["a", "b"]), memory)),
        "memory of another": (InvalidValue, "not this controller's", (0.0, x, r, memory + 1)),
    }


@pytest.mark.parametrize("which", misuses(np.zeros(9)))
def test_misuse_is_refused_by_name(which):
    """Nothing is broadcast and nothing is guessed; the only token is back, so the next call is not taken for another thread's."""
    stepper, _ = case("computed torque")
    error, words, arguments = misuses(stepper.start())[which]
    with pytest.raises(error, match=words):
        stepper.step(*arguments)
    stepper.step(0.0, np.zeros(4), np.zeros(2), stepper.start())
    stepper.trace()


def test_other_forms_of_numbers_are_taken():
    """Lists, columns, strided views, integers and single precision mean what they say."""
    stepper, _ = case("computed torque")
    x, r, memory = np.array([0.5, -0.25, 1.0, 2.0]), np.array([1.0, -2.0]), stepper.start()
    expected, _ = stepper.step(0.0, x, r, memory)
    forms: list[tuple[Any, Any, Any]] = [
        (list(x), list(r), list(memory)),
        (x[:, None], r[None, :], memory),
        (np.repeat(x, 2)[::2], r, memory),
        (x.astype(np.float32), r.astype(int), memory),
    ]
    for form in forms:
        assert np.array_equal(stepper.step(0, *form)[0], expected)


def test_memory_of_the_same_size_of_another_controller_is_refused():
    """Same layout, other gain: its memory means something else."""
    stepper, _ = case("computed torque")
    other = fp.Stepper(PROBLEM, fp.ComputedTorque(TRACK, replace(SHAPE, scale=40.0)), compiled=False)
    assert other.memory.size == stepper.memory.size
    with pytest.raises(InvalidValue, match="another controller"):
        stepper.step(0.0, np.zeros(4), np.zeros(2), other.start())


# Threads


def test_what_is_built_once_is_built_for_every_thread():
    """An evaluator keeps the numbers of its last call, so that two threads may not share one."""
    latest, built = Latest[object](2), list[object]()

    def ask() -> None:
        built.append(latest.of((latest,), (), object))

    ask()
    ask()
    other = threading.Thread(target=ask)
    other.start()
    other.join()
    assert built[0] is built[1] is not built[2]


def test_second_thread_is_refused():
    """The stepper is entered by another thread while it evaluates: that one is refused and the first finishes."""
    stepper, _ = case("computed torque")
    evaluate, raised = stepper._evaluate, []

    def intrude() -> None:
        for work in (lambda: stepper.step(0.0, np.zeros(4), np.zeros(2), stepper.start()), stepper.trace):
            try:
                work()
            except ConcurrentUse as error:
                raised.append(str(error))

    def slow() -> object:
        thread = threading.Thread(target=intrude)
        thread.start()
        thread.join()
        return evaluate()

    expected, _ = stepper.step(0.0, np.ones(4), np.zeros(2), stepper.start())
    stepper._evaluate = slow
    try:
        command, _ = stepper.step(0.0, np.ones(4), np.zeros(2), stepper.start())
    finally:
        stepper._evaluate = evaluate
    assert np.array_equal(command, expected)
    assert len(raised) == 2
    assert "one stepper serves one thread" in raised[0]
    assert np.array_equal(stepper.step(0.0, np.ones(4), np.zeros(2), stepper.start())[0], expected)


def test_one_stepper_per_thread():
    """Four threads, each with a stepper of its own, have the commands of one thread."""
    _, run = case("computed torque")
    results: dict[int, list[bytes]] = {}

    def work(number: int, stepper: fp.Stepper) -> None:
        memory, commands = stepper.start(), []
        for k in range(60):
            command, memory = stepper.step(*sample(run, k), memory)
            commands.append(command.tobytes())
        results[number] = commands

    steppers = [fp.Stepper(PROBLEM, CONTROLLERS["computed torque"], compiled=False) for _ in range(5)]
    threads = [threading.Thread(target=work, args=(k, steppers[k])) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    work(4, steppers[4])
    assert all(results[k] == results[4] for k in range(4))


# Solvers


@pytest.mark.parametrize("first", [True, False])
def test_every_cycle_that_a_solver_fails_is_counted_once(first):
    """At the start of a run, where no time is known yet, and within it; in a row and after a step."""
    stepper, run = case("plan")
    memory, at = stepper.start(), 0
    if not first:
        _, memory = stepper.step(*sample(run, 0), memory)
        at = 1
    evaluate, solving = stepper._evaluate, "ffsfsssffs"

    def broken() -> object:
        if np.isnan(stepper._state[0]):  # a cycle that is stepped over has no sample, and needs no solver
            return evaluate()
        raise RuntimeError("OSQP failed")

    counts = []
    try:
        for k, how in enumerate(solving):
            stepper._evaluate = broken if how == "f" else evaluate
            _, memory = stepper.step(*sample(run, at + k), memory)
            counts.append(int(stepper.trace()["skipped"][0]))
    finally:
        stepper._evaluate = evaluate
    assert counts == [solving[: k + 1].count("f") for k in range(len(solving))]


@pytest.mark.parametrize(
    ("optimiser", "words"),
    [
        (fp.Fatrop(), "fatrop has no time limit"),
        (fp.Ipopt(), r"give Ipopt\(time_limit"),
        (fp.SequentialQuadratic(), r"give SequentialQuadratic\(splittings"),
    ],
)
def test_solver_without_a_bound_is_refused_on_a_machine(optimiser, words):
    """By name, with a remedy; `bounded=False` accepts it."""
    with pytest.raises(NotSupported, match=words):
        fp.Stepper(PROBLEM, fp.RecedingHorizon(optimiser), compiled=False)
    assert fp.Stepper(PROBLEM, fp.RecedingHorizon(optimiser), compiled=False, bounded=False).start().size


@pytest.mark.parametrize("optimiser", [fp.Ipopt(time_limit=10.0), fp.SequentialQuadratic(splittings=2000)])
def test_solver_with_a_time_limit_runs(optimiser):
    """The solver takes the option, and the first command is finite."""
    stepper = fp.Stepper(PROBLEM, fp.RecedingHorizon(optimiser), compiled=False)
    command, _ = stepper.step(0.0, PROBLEM.start_state, np.zeros(2), stepper.start())
    assert status(stepper) <= Status.NOT_CONVERGED
    assert np.isfinite(command).all()


# Wrong but finite


def driven(
    gain_of_plant: float, deformation: Deformation, *, cycles: int, stuck: bool = False, length: float = 1.0
) -> list[Status]:
    """Statuses of computed torque on y'' = g u in a unit of length, believed to be y'' = u; a stuck actuator gives nothing."""
    gain_of_plant *= length
    problem = fp.Problem(
        plant=linear(abs(gain_of_plant), length),
        reference=fp.Trajectory(lambda t: {"y": length * (1 + 0.2 * ca.sin(3 * t))}),
        start={"y": 0.0},
        period=1e-3,
        duration=2.0,
        limits=fp.Limits(inputs={"u": (-50.0, 50.0)}),
    )
    stepper = fp.Stepper(
        problem,
        fp.ComputedTorque(TRACK, deformation),
        compiled=False,
        monitor=fp.RunMonitor(saturated_after=0.2, window=50),
    )
    memory, x, u, statuses = stepper.start(), np.zeros(2), np.zeros(1), []
    for k in range(cycles):
        acting = 0.0 if stuck else gain_of_plant * float(u[0])
        u, memory = stepper.step(k * 1e-3, x, np.array([acting]), memory)
        statuses.append(status(stepper))
        acting = 0.0 if stuck else gain_of_plant * float(u[0])
        x = x + np.array([x[1] * 1e-3 + acting * 0.5e-6, acting * 1e-3])
    return statuses


def test_healthy_loop_is_ok_in_every_cycle():
    """Neither a moving reference nor a wrong model is a fault."""
    assert set(driven(0.8, fp.Affine(gain=-0.5), cycles=1500)) == {Status.OK}


@pytest.mark.parametrize("length", [1.0, 1e-12])
def test_flipped_sign_does_not_contract(length):
    """With the opposite sign of the plant's gain the factor is 1 + a lambda; the status says so within two windows and a half."""
    statuses = driven(-0.8, fp.Affine(gain=-0.5), cycles=120, length=length)
    assert Status.NOT_CONTRACTING in statuses


def test_stuck_actuator_saturates():
    """Nothing moves, so the command goes to its limit and stays there."""
    statuses = driven(0.8, fp.Affine(gain=-0.5), cycles=1500, stuck=True)
    assert Status.SATURATED in statuses[:900]
    assert statuses[0] == Status.OK


def test_every_status_has_a_place_and_a_remedy():
    assert sorted(s.severity for s in Status) == list(range(len(Status)))
    assert all(s.remedy for s in Status)
