"""Random closed loops, and what becomes of them: linear and nonlinear plants with deformations of all kinds."""

from __future__ import annotations

import inspect
from dataclasses import dataclass

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.contraction.spectrum import response_jacobian
from fpirhc.controllers import check

PERIOD = 5e-3  # s
DURATION = 8.0  # s; the reference rests from about 2.5 s on
LATE = (
    0.05  # share of the largest response error of the first eighth below which those of the last quarter count as gone
)
ROUNDING = 1e-8  # share of it from which on errors need not fall any more
MAPS = (
    fp.Affine(gain=-0.5),
    fp.Sigmoid(gain=-0.5, scale=5.0),
    fp.Sigmoid(gain=-0.5, scale=50.0),
    fp.Sigmoid(gain=-0.5, scale=1000.0),
    fp.RFPTVector(offset=1e5, sign=-1, gain=5e-6),
    fp.RFPT(offset=1e5, sign=-1, gain=5e-6),
    fp.Rotation(fraction=0.4, radius=1e4),
)


@dataclass(frozen=True, eq=False)
class Case:
    """One random closed loop."""

    name: str
    problem: fp.Problem
    controller: fp.ComputedTorque


def random_case(seed: int) -> Case:
    """Return a closed loop: 1 to 3 controlled coordinates of order 1 to 3, linear to strongly nonlinear, with or without dead time.

    Some have an inner state of their own, stable or not; some models have the wrong sign of the inputs' effect.
    """
    random = np.random.default_rng(seed)
    n, order = int(random.integers(1, 4)), int(random.integers(1, 4))
    nonlinearity = float(random.choice([0.0, 0.3, 1.0, 2.0]))  # how nonlinear
    inner = bool(random.uniform() < 0.25)
    plant = _plant(random, n, order, nonlinearity, inner)
    cycles = float(random.choice([0, 0, 0, 0.5, 1, 2, 4]))
    start = {f"q{k}": float(random.uniform(-0.1, 0.1)) for k in range(n)}
    problem = fp.Problem(
        plant=plant,
        reference=fp.Trajectory(_motion(random, n, inner)),
        start={**start, "z": 0.0} if inner else start,
        period=PERIOD,
        duration=DURATION,
        dead_time=fp.DeadTime(inputs={f"u{k}": cycles * PERIOD for k in range(n)}),
    )
    law = fp.Exponential(rate=float(random.uniform(2.0, 5.0)), integral=bool(random.integers(2)))
    deformation = _deformation(random, _largest(problem), cycles)
    name = f"{seed}: {n} x order {order}, bend {nonlinearity}, inner {inner}, dead time {cycles}, {deformation}"
    return Case(name, problem, fp.ComputedTorque(law, deformation))


def _motion(random: np.random.Generator, n: int, inner: bool):
    size, speed = random.uniform(0.2, 0.8, n), random.uniform(0.5, 2.0, n)

    def motion(t):
        moving = {f"q{k}": size[k] * ca.sin(speed[k] * t) * ca.exp(-((t / 1.3) ** 4)) for k in range(n)}
        return {**moving, "z": 0 * t} if inner else moving

    return motion


def _plant(random: np.random.Generator, n: int, order: int, nonlinearity: float, inner: bool) -> fp.Plant:
    """q^(r) = A x + bend (sin, products, cubes) + g(q) B u, the model's entries wrong by factors, at times of wrong sign."""
    size = n * order
    exact = {f"a{k}": float(v) for k, v in enumerate(random.uniform(-3.0, 1.0, n * size))}
    gains = np.eye(n) * random.uniform(0.5, 2.0, n) + (1 - np.eye(n)) * random.uniform(-0.3, 0.3, (n, n))
    exact |= {f"b{k}": float(v) for k, v in enumerate(gains.ravel())}
    exact |= {"c": nonlinearity, "s": 0.4 * min(nonlinearity, 1.0)}
    if inner:
        exact |= {"decay": float(random.choice([-3.0, 2.0, 5.0])), "back": 1.0}
    wrong = {name: value * float(random.uniform(0.4, 2.0)) for name, value in exact.items()}
    if random.uniform() < 0.1:
        wrong |= {f"b{k}": -wrong[f"b{k}"] for k in range(n * n)}
    cubic = 0.1 * nonlinearity * float(random.uniform() < 0.25)  # a response that is not affine in the inputs

    def response(*arguments):
        *derivatives, u, p = arguments
        q = derivatives[0]
        x = [d[f"q{k}"] for d in derivatives for k in range(n)]
        pushed = [u[f"u{k}"] + cubic * u[f"u{k}"] ** 3 for k in range(n)]
        collected = {}
        for i in range(n):
            free = sum(p[f"a{i * size + j}"] * x[j] for j in range(size))
            term = p.c * (ca.sin(3 * q[f"q{i}"]) + x[size - 1] * q["q0"] - q[f"q{i}"] ** 3)
            gain = 1 + p.s * ca.sin(2 * q[f"q{i}"])
            collected[f"q{i}"] = free + term + gain * sum(p[f"b{i * n + k}"] * pushed[k] for k in range(n))
        if inner:
            collected["q0"] += p.back * q["z"]
            collected["z"] = q["q0"] - p.decay * q["z"]
        return collected

    names = [f"d{k}" for k in range(order)] + ["u", "p"]
    kind = inspect.Parameter.POSITIONAL_ONLY
    vars(response)["__signature__"] = inspect.Signature([inspect.Parameter(name, kind) for name in names])
    controlled = [f"q{k}" for k in range(n)]
    every = [*controlled, "z"] if inner else controlled
    return fp.Plant(
        coordinates=dict.fromkeys(every, "m"),
        inputs={f"u{k}": "N" for k in range(n)},
        order={c: 1 if c == "z" else order for c in every},
        response=response,
        controlled=controlled,
        parameters={name: fp.Parameter(wrong[name], exact[name], "1") for name in exact},
    )


def _largest(problem: fp.Problem) -> float:
    """Largest eigenvalue of J at the start, in size."""
    plant, wanted = problem.plant, np.zeros(len(problem.plant.inputs))
    jacobian = response_jacobian(plant)(problem.start_state, wanted, plant.exact, plant.approximate)
    return float(np.abs(np.linalg.eigvals(jacobian.full())).max())


def _deformation(random: np.random.Generator, largest: float, cycles: float):
    """A map whose gain is too small, good, or too large for the plant, paired or not."""
    product = float(random.uniform(0.05, 3.5))
    if cycles and random.uniform() < 0.5:
        product *= 0.5
    deformation = MAPS[int(random.integers(len(MAPS)))]
    gain = product / largest
    deformation = deformation.with_effective_gain(min(gain, 1.0) if isinstance(deformation, fp.Rotation) else gain)
    if not cycles:
        return deformation
    return [deformation, fp.Paired(deformation, cycles=cycles), fp.Increment(deformation, cycles=cycles)][
        int(random.integers(3))
    ]


def dies_out(case: Case) -> bool:
    """Whether the simulated response error dies out; a gain of the wrong sign, refused otherwise, is run too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(check, "check_gain_sign", lambda *_: None)
        patch.setattr(check, "check_gain_size", lambda *_: None)
        run = fp.simulate(case.problem, case.controller, seed=0, compiled=False)
    if run.stop is not None:
        return False
    errors = np.linalg.norm(run["realised"] - run["desired"], axis=1)
    first, *_, seventh, last = (part.max() for part in np.array_split(errors, 8))
    small = max(seventh, last) < LATE * first
    # A bounded oscillation may be small beside the burst that it began with, or for a while, but does not keep falling.
    falls = last < max(0.5 * seventh, ROUNDING * first)
    return bool(small and falls)
