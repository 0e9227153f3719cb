"""One cycle of a controller by value: loops written out in numpy, commands at their limits, and automatic settings."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.iteration import affine
from helpers.plants import chain, simulated

import fpirhc as fp
from fpirhc.errors import InvalidValue

PERIOD, RATE = 0.05, 2.0
EXACT, BELIEVED, LOAD = np.array([2.0, 4.0]), np.array([1.0, 8.0]), np.array([0.0, 3.0])
LIMITS = {"u": (-4.0, 5.0), "w": (-1.0, np.inf)}


def masses(**settings: Any) -> fp.Problem:
    """Two masses, 2 and 4 kg, taken for 1 and 8; b'' also feels a force of 3 N. Along sin 2t and cos t."""
    plant = fp.Plant(
        coordinates={"a": "m", "b": "rad"},
        inputs={"u": "N", "w": "N"},
        parameters={"m": fp.Parameter(1.0, 2.0, "kg"), "n": fp.Parameter(8.0, 4.0, "kg")},
        response=lambda q, v, u, p: {"a": u.u / p.m, "b": (u.w - 3.0) / p.n},
    )
    usual: dict[str, Any] = {"start": {"a": 0.5, "b": 1.0}, "period": PERIOD, "duration": 8.0}
    reference = fp.Trajectory(lambda t: {"a": ca.sin(2 * t), "b": ca.cos(t)})
    return fp.Problem(plant, reference, **(usual | settings))


def by_hand(gain: float, referenced: bool, cycles: int) -> dict[str, np.ndarray]:
    """Computed torque without an integral, with the affine iteration on requests or on differences from the model's response."""
    low, high = (np.array([ends[k] for ends in LIMITS.values()]) for k in (0, 1))
    q, v, request, delta, before = np.array([0.5, 1.0]), np.zeros(2), None, np.zeros(2), None
    log: dict[str, list[np.ndarray]] = {
        n: [] for n in ("state", "desired", "realised", "deformed", "command", "clipped")
    }
    for k in range(cycles):
        t = k * PERIOD
        at, rate, bend = (
            np.array(x)
            for x in ([np.sin(2 * t), np.cos(t)], [2 * np.cos(2 * t), -np.sin(t)], [-4 * np.sin(2 * t), -np.cos(t)])
        )
        desired = bend + 2 * RATE * (rate - v) + RATE**2 * (at - q)
        realised = (np.zeros(2) if before is None else before - LOAD) / EXACT
        if referenced:
            modelled = (np.zeros(2) if before is None else before - LOAD) / BELIEVED
            delta = delta if before is None else delta - gain * (realised - (modelled - delta))
            wanted = desired + delta
        else:
            wanted = desired if request is None else request - gain * (realised - desired)
        unclipped = BELIEVED * wanted + LOAD
        command = np.clip(unclipped, low, high)
        request = wanted + (command - unclipped) / BELIEVED  # what the clipped command means is stored
        values = np.concatenate([q, v]), desired, realised, request, command, [float(np.any(command != unclipped))]
        for name, value in zip(log, values, strict=True):
            log[name].append(np.asarray(value))
        response = (command - LOAD) / EXACT
        q, v, before = q + PERIOD * v + PERIOD**2 / 2 * response, v + PERIOD * response, command
    return {name: np.array(rows) for name, rows in log.items()}


@pytest.mark.parametrize("gain", [0.0, 0.3, 0.9])
@pytest.mark.parametrize("referenced", [False, True])
def test_a_run_is_the_loop_by_hand(gain, referenced):
    """Also where commands are clipped, on one side or on both."""
    problem, map = masses(limits=fp.Limits(inputs=LIMITS)), affine(gain) if gain else fp.Identity()
    form = fp.ModelReferenced(map) if referenced and gain else map
    run = simulated(problem, fp.ComputedTorque(fp.Exponential(rate=RATE, integral=False), form))
    expected = by_hand(gain or 0.0, referenced, run.cycles) if gain else {**by_hand(0.0, True, run.cycles)}
    for name in ("state", "desired", "command", "clipped"):
        np.testing.assert_allclose(run[name], expected[name], atol=1e-9, err_msg=name)
    np.testing.assert_allclose(run["realised"][1:], expected["realised"][1:], atol=1e-9)
    if gain and not referenced:
        np.testing.assert_allclose(run["deformed"], expected["deformed"], atol=1e-9)
    assert 5 < run["clipped"].sum() < run.cycles - 5


def test_a_clipped_command_of_a_curved_response_means_what_the_response_is_there():
    """u^3 / m: the stored request is that of the command that was sent, and of one that was not clipped the wanted one."""
    plant = fp.Plant(
        coordinates={"a": "m"},
        inputs={"u": "N"},
        parameters={"m": fp.Parameter(1.0, 1.5, "kg")},
        response=lambda q, v, u, p: {"a": u.u**3 / p.m},
        inverse=lambda q, v, r, p: {"u": ca.sign(r.a) * ca.fabs(p.m * r.a) ** (1 / 3)},
    )
    wave = fp.Trajectory(lambda t: {"a": 3 * ca.sin(2 * t)})
    limits = fp.Limits(inputs={"u": (-2.0, 2.0)})
    problem = fp.Problem(plant, wave, {"a": 0.0, "a'": 6.0}, period=PERIOD, duration=6.0, limits=limits)
    run = simulated(problem, fp.ComputedTorque(fp.Exponential(rate=RATE), fp.Affine(-0.4)))
    assert 5 < run["clipped"].sum() < run.cycles - 5
    np.testing.assert_allclose(run["deformed"], run["command"] ** 3, rtol=1e-9, atol=1e-9)


def test_a_command_that_is_no_number_is_held():
    """A heater by the square of its current, of which too little is asked for a while: the last command, and the status says so."""
    plant = fp.Plant(
        coordinates={"y": "K"},
        inputs={"i": "A"},
        order=1,
        parameters={"c": fp.Parameter(1.0, 1.2, "1")},
        response=lambda q, u, p: {"y": p.c * u.i**2 - q.y},
        inverse=lambda q, r, p: {"i": ca.sqrt((r.y + q.y) / p.c)},
    )
    falling = fp.Trajectory(lambda t: {"y": 1.5 + ca.sin(4 * t)})
    problem = fp.Problem(plant, falling, {"y": 1.5}, period=PERIOD, duration=4.0)
    run = simulated(problem, fp.ComputedTorque(fp.Exponential(rate=1.0)))
    impossible = run["deformed.y"] + run["state.y"] < 0
    held = run["status"][:, 0] == fp.Status.NON_FINITE
    assert 5 < held.sum() < run.cycles - 5
    assert not (impossible & ~held).any()
    assert np.isfinite(run["command"]).all()
    later = np.flatnonzero(held[1:]) + 1
    np.testing.assert_array_equal(run["command"][later], run["command"][later - 1])


def test_a_map_with_a_memory_remembers_nothing_of_an_absurd_response():
    """A response error beyond 10 000 times what the limits allow, 5 m/s^2: the request stays, and the filter forgets nothing."""
    problem = masses(limits=fp.Limits(inputs={"u": (-5.0, 5.0), "w": (-5.0, 11.0)}))
    controller = fp.ComputedTorque(fp.Exponential(rate=RATE), fp.Filtered(fp.Affine(-0.5), pole=0.5))
    stepper, memory = fp.Stepper(problem, controller, compiled=False), None
    memory = stepper.start()
    for k in range(4):
        _, memory = stepper.step(k * PERIOD, problem.start_state, np.array([0.1, -0.2]), memory)
    following, far = {}, problem.start_state + np.array([1e4 / RATE**2, 0.0, 0.0, 0.0])  # -3e4 m/s^2 is desired there
    for size in (1e4, 3e4):
        _, after = stepper.step(4 * PERIOD, far, np.array([size, 0.0]), memory)
        following[size] = stepper.memory.unpack(after)
    kept = stepper.memory.unpack(memory)
    filters = [name for name in kept if "filter" in name]
    assert filters
    for name in filters:
        np.testing.assert_array_equal(following[3e4][name], kept[name])
        assert not np.array_equal(following[1e4][name], kept[name])


# Automatic settings


PLANNED = {
    "limits": fp.Limits(inputs={"u": (-2.0, 3.0), "w": (-8.0, 8.0)}),
    "horizon": fp.Horizon(stages=8, step=PERIOD),
    "cost": fp.Quadratic(states={"a": 9.0, "b": 9.0}, effort={"u": 0.1, "w": 0.1}),
    "duration": 0.5,
}
PLAN = fp.RecedingHorizon(fp.FixedPointSolver(iterations=4, tolerance=1e-6), fp.Sigmoid(gain=-0.5))


@pytest.mark.parametrize(
    ("wrap", "masses_known"), [(lambda c: c, (1, 8)), (fp.ExactModel, (2, 4))], ids=["alone", "inside"]
)
def test_the_scale_of_a_plan_covers_a_jump_between_the_limits(wrap, masses_known):
    """5 N on 1 kg and 16 N on 8 kg: (5, 2). In a wrapper it is chosen on the problem that the inner controller sees."""
    problem, jump = masses(**PLANNED), np.hypot(5.0 / masses_known[0], 16.0 / masses_known[1])
    scale = jump / fp.Sigmoid(gain=-0.5, scale=1.0).largest_step()
    maps = [fp.Sigmoid(gain=-0.5, **s) for s in ({}, {"scale": scale}, {"scale": 1.2 * scale})]
    chosen, own, other = (simulated(problem, wrap(replace(PLAN, deformation=m)))["command"] for m in maps)
    assert np.abs(chosen - own).max() < 0.1 * np.abs(other - own).max()


BACK = {
    (1, False): 0.0,
    (1, True): 1.5 * 1 / 2,
    (2, False): 1.5 * 1 / 2,
    (2, True): 1.25 * 9 / 8,
}  # by order and integral


@pytest.mark.parametrize(("order", "integral"), BACK)
def test_the_scale_covers_what_brings_the_loop_back(order, integral):
    """From the 500 m/s^n that the reference needs of the model, by sin^N tan(theta) of the N poles of the law, and a spare."""
    path = fp.Trajectory(lambda t: {"y": 500 * t**order / order})
    problem = fp.Problem(chain(order), path, {"y": -300.0}, period=PERIOD, duration=1.0)
    scale = max(1.0, BACK[order, integral] * RATE * PERIOD * 500 / fp.Sigmoid(gain=-0.5, scale=1.0).largest_step())
    maps = [fp.Sigmoid(gain=-0.5, **s) for s in ({}, {"scale": scale}, {"scale": 1.02 * scale})]
    law = fp.Exponential(RATE, integral=integral)
    chosen, own, other = (simulated(problem, fp.ComputedTorque(law, m))["command"] for m in maps)
    assert np.abs(chosen - own).max() < 0.3 * np.abs(other - own).max()


def test_a_plan_without_limits_needs_a_scale():
    free = masses(**{**PLANNED, "limits": fp.Limits(inputs={"u": (-2.0, 3.0)})})
    with pytest.raises(InvalidValue, match="input 'w' has no finite limits"):
        simulated(free, PLAN)


# Limits of rates are kept in the command of every controller, as limits of inputs are

FASTEST = 20.0  # N/s
PROBLEM = fp.Problem(
    plant=fp.Plant(
        coordinates={"x": "m"},
        inputs={"F": "N"},
        order=2,
        response=lambda q, v, u, p: {"x": u.F / p.mass},
        parameters={"mass": fp.Parameter(1.0, 2.0, "kg")},
    ),
    reference=fp.Trajectory(lambda t: {"x": 1 - ca.cos(2 * t)}),
    start={"x": 0.5},
    period=0.01,
    duration=3.0,
    measure_from=1.0,
    limits=fp.Limits(inputs={"F": (-20.0, 20.0)}, rates={"F": (-FASTEST, FASTEST)}),
    horizon=fp.Horizon(stages=20, step=0.05),
    cost=fp.Quadratic(states={"x": 100.0, "x'": 1.0}, rate={"F": 1e-3}),
)
CONTROLLERS = {
    "RHC": fp.RecedingHorizon(fp.FixedPointSolver()),
    "RHC+FPI": fp.RecedingHorizon(fp.FixedPointSolver(), fp.ModelReferenced(fp.Affine(gain=-0.8))),
    "CTC+FPI": fp.ComputedTorque(fp.Exponential(rate=5.0), fp.Affine(gain=-0.5)),
    "PID": fp.PID({"x": 50.0}, {"x": 40.0}, {"x": 14.0}),
    "ADRC": fp.rivals.ADRC(5.0, observer=50.0),
}


def fastest(run: fp.Run) -> float:
    """The fastest change of the command, in shares of the limit; the first one is from the input before the run."""
    sent = np.concatenate([[0.0], np.ravel(run["command"])])
    return float(np.abs(np.diff(sent)).max() / (PROBLEM.period * FASTEST))


@pytest.mark.parametrize("name", CONTROLLERS)
def test_no_command_moves_faster_than_its_limit(name):
    """With an actuator that is no faster a plant twice as heavy is another task: the run says so, and at_limit counts it."""
    free = replace(PROBLEM, limits=replace(PROBLEM.limits, rates={}))
    run, faster = (simulated(p, CONTROLLERS[name]) for p in (PROBLEM, free))
    assert fastest(faster) > 1.5
    assert fastest(run) <= 1 + 1e-9
    assert fp.measure(PROBLEM, run)["at_limit"][""] > 0.01


def test_a_rate_that_has_a_price_may_be_passed():
    soft = replace(PROBLEM, limits=replace(PROBLEM.limits, prices={"F": 1e-3}))
    assert fastest(simulated(soft, CONTROLLERS["CTC+FPI"])) > 1.5
