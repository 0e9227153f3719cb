"""Plants of a certified box that leave what its certificate states: none.

    python benchmarks/certificate.py [PLANTS]       2 000 random plants of each of four boxes, a quarter of them corners

All plants run in a loop in numpy, side by side. One violates the certificate where a state leaves its bounds or limits at an end
of a cycle, a command leaves its bounds, or a response error is larger than stated.
"""

from __future__ import annotations

import sys
from collections import namedtuple
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
from foreign import FOREIGN

import fpirhc as fp

ROUNDING = 1e-9  # of the integrators: the theorem is about the exact motion


# Mismatch in percent, rate of the law, effective gain, what plans leave of the inputs.
Loop = namedtuple("Loop", "mismatch pieces rate gain period duration room")
LOOPS = {
    "body": Loop(5.0, 1, 4.0, 1.0, 0.02, 1.0, {"T1": 0.3, "T2": 0.5, "T3": 0.3}),
    "arm": Loop(5.0, 2, 6.0, 0.8, 0.01, 1.0, {"T1": 8.0, "T2": 4.0}),
    "tanks": Loop(5.0, 2, 4.0, 1.0, 0.02, 1.5, {"Q1": 0.8, "Q2": 0.8}),
    "quadrotor": Loop(2.0, 2, 8.0, 1.0, 0.01, 0.5, {"left": 1.0, "right": 1.0}),
}


def torques(q, v, r, p):
    """The inverse of the arm in the form of mechanics, which has no division."""
    c2, h = ca.cos(q.q2), -0.5 * p.m2 * ca.sin(q.q2)
    m11 = p.m1 * 0.25 + p.m2 * (1.25 + c2) + 0.2
    m12, m22 = p.m2 * (0.25 + 0.5 * c2) + 0.1, p.m2 * 0.25 + 0.1
    g2 = 0.5 * p.m2 * 9.81 * ca.cos(q.q1 + q.q2)
    g1 = (0.5 * p.m1 + p.m2) * 9.81 * ca.cos(q.q1) + g2
    return {
        "T1": m11 * r.q1 + m12 * r.q2 + h * v.q2 * (2 * v.q1 + v.q2) + g1 + 0.5 * v.q1,
        "T2": m12 * r.q1 + m22 * r.q2 - h * v.q1**2 + g2 + 0.5 * v.q2,
    }


def task(name: str) -> tuple[fp.Problem, fp.RecedingHorizon]:
    """Problem and controller of a plant."""
    loop, case = LOOPS[name], FOREIGN[name]()
    plant = replace(case.plant, inverse=torques) if name == "arm" else case.plant
    start = {**dict.fromkeys(plant.names, 0.0), **case.start}
    limits = replace(case.limits, rates={})  # what they cut is not covered
    facts = {"limits": limits, "horizon": case.horizon, "cost": case.cost, "period": loop.period}
    problem = fp.Problem(plant=plant, reference=case.reference, start=start, duration=loop.duration, **facts)
    plans = {"tracking": fp.Exponential(loop.rate, integral=False), "room": loop.room}
    map_ = fp.ModelReferenced(fp.Affine(-2 * loop.gain))
    return problem, fp.RecedingHorizon(fp.FixedPointSolver(iterations=200, tolerance=1e-7), map_, **plans)


def drawn(box: dict[str, tuple[float, float]], count: int) -> np.ndarray:
    """Parameters in the box, one plant a row, a quarter of them at its corners."""
    ends, random = np.array(list(box.values())), np.random.default_rng(0)
    shares = random.uniform(size=(count, len(ends)))
    shares[: count // 4] = shares[: count // 4] > 0.5
    return ends[:, 0] + shares * (ends[:, 1] - ends[:, 0])


def runs(name: str, stated: Any, plants: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States (cycles + 1, nx, plants), commands and response errors; plans are those of one run."""
    problem, a, plant = stated.problem, LOOPS[name].gain, stated.problem.plant
    plans = fp.simulate(problem, stated.controller, seed=0)
    law, gains = stated.controller.planner.tracking, np.zeros((len(plant.controlled_names), plant.state.size))
    for row, coordinate in zip(gains, plant.controlled_names, strict=True):
        for j, gain in enumerate(law.gains(plant.chains[coordinate])):
            row[plant.state.elements.index(coordinate + "'" * j)] = gain
    count, period, move = len(plants), problem.period, plant.equations
    respond, invert, rate = (f.map(count) for f in (move.controlled_response, move.inverse, move.rate))
    exact, believed, deformation = plants.T, np.tile(plant.approximate[:, None], count), 0.0
    x = np.tile(problem.start_state[:, None], count)
    states, commands, errors = [x], [], []
    for target, nominal in zip([problem.start_state, *plans["target"][:-1]], plans["nominal"], strict=True):
        desired = nominal[:, None] + gains @ (target[:, None] - x)
        if commands:
            slip = respond(x, commands[-1], exact) - respond(x, commands[-1], believed) + deformation
            deformation = deformation - a * slip.full()
        u = invert(x, desired + deformation, believed).full()
        errors.append(respond(x, u, exact).full() - desired)
        slopes = [rate(x, u, exact).full()]
        for share in (0.5, 0.5, 1.0):
            slopes.append(rate(x + share * period * slopes[-1], u, exact).full())
        x = x + period / 6 * (slopes[0] + 2 * slopes[1] + 2 * slopes[2] + slopes[3])
        states.append(x)
        commands.append(u)
    return np.array(states), np.array(commands), np.array(errors)


def violating(stated: Any, found: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    """Whether a plant leaves what is stated, one entry a plant."""
    states, commands, errors = found
    least, most = (end[:, None] for end in stated.problem.limits.state_bounds(stated.problem.plant))
    low, high = (end[:, None] for end in np.array(list(stated.commands.values())).T)
    large = np.array(list(stated.error.values()))[:, None]
    beyond = [np.abs(errors) - large, low - commands, commands - high, least - states, states - most]
    for rows in (states[:-1], states[1:]):  # both ends of every cycle
        beyond += [stated.lower[:, :, None] - rows, rows - stated.upper[:, :, None]]
    return np.any([(excess > ROUNDING).any(axis=(0, 1)) for excess in beyond], axis=0)


if __name__ == "__main__":
    every, count = 0, int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    for name, loop in LOOPS.items():
        problem, controller = task(name)
        stated = fp.certify_limits(problem, controller, mismatch=loop.mismatch, pieces=loop.pieces)
        found = runs(name, stated, drawn(stated.box, count))
        wrong, reached = int(violating(stated, found).sum()), np.abs(found[2]).max((0, 2)) / list(stated.error.values())
        print(
            f"{name}: {stated}; {wrong} of {count} plants violate it; errors reach {reached.max():.0%} of their bound"
        )
        every += wrong
    print(f"{every} of {count * len(LOOPS)} plants violate their certificate")
