"""The price of a certificate of limits: what certified plans cost beside verified ones, and that it vanishes with the period.

    python benchmarks/certificate.py [PLANT ...]     prints the table; --write puts it into docs/certificate.md

All plans are those of the model alone (`FromPlan` with room), tracked by the same law and deformation. Verified margins are
widened until no run of corners and random plants of the box passes a limit. Certified ones are for all plants of the box. Cost: the
mean of the stage cost of the run with the exact parameters, as share of that without margins.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import casadi as ca
import numpy as np
from foreign import FOREIGN
from table import write_table

import fpirhc as fp
from fpirhc.controllers.base import Controller
from fpirhc.plant.plant import exact_ranges
from fpirhc.simulation.model_as_plant import exactly
from fpirhc.simulation.simulate import simulator

PAGE = Path(__file__).resolve().parents[1] / "docs" / "certificate.md"
PLANTS, PASSES = 8, 10


@dataclass(frozen=True)
class Loop:
    """Mismatch in percent, pieces, rate of the law, effective gain, periods, duration, and what plans leave of the inputs."""

    mismatch: float
    pieces: int
    rate: float
    gain: float
    periods: tuple[float, ...]
    duration: float
    room: dict[str, float]


LOOPS = {
    "body": Loop(5.0, 1, 4.0, 1.0, (0.02, 0.01, 0.005), 3.0, {"T1": 0.3, "T2": 0.5, "T3": 0.3}),
    "arm": Loop(5.0, 2, 6.0, 0.8, (0.01, 0.005, 0.0025), 3.0, {"T1": 8.0, "T2": 4.0}),
    "tanks": Loop(5.0, 2, 4.0, 1.0, (0.02, 0.01, 0.005), 3.0, {"Q1": 0.4, "Q2": 0.4}),
    "quadrotor": Loop(2.0, 2, 8.0, 1.0, (0.01, 0.005, 0.0025), 2.0, {"left": 1.0, "right": 1.0}),
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


def task(name: str, period: float, duration: float | None = None) -> tuple[fp.Problem, fp.RecedingHorizon]:
    """Problem and controller of a plant."""
    loop, case = LOOPS[name], FOREIGN[name]()
    plant = replace(case.plant, inverse=torques) if name == "arm" else case.plant
    problem = fp.Problem(
        plant=plant,
        reference=case.reference,
        start={**dict.fromkeys(plant.names, 0.0), **case.start},
        period=period,
        duration=duration or loop.duration,
        limits=case.limits,
        horizon=case.horizon,
        cost=case.cost,
    )
    plans = fp.FromPlan(fp.Exponential(loop.rate, integral=False), room=loop.room)
    map_ = fp.ModelReferenced(fp.Affine(-2 * loop.gain))
    return problem, fp.RecedingHorizon(fp.FixedPoint(iterations=200, tolerance=1e-7), map_, plans)


def cost(problem: fp.Problem, controller: Controller) -> float:
    """The mean of the stage cost."""
    return float(fp.simulate(problem, controller, seed=0)["cost"].sum(axis=1).mean())


def price(problem: fp.Problem, controller: Controller, with_margins: Controller) -> str:
    """The cost with margins as share of that without."""
    return f"{cost(problem, with_margins) / cost(problem, controller):.3f}"


def verified(problem: fp.Problem, controller: fp.RecedingHorizon, mismatch: float) -> Controller:
    """The controller with the margins that runs verify."""
    assert problem.horizon is not None
    ends = np.array(list(exact_ranges(problem.plant, mismatch).values()))
    shares = np.random.default_rng(0).uniform(size=(PLANTS, len(ends)))
    shares[: PLANTS // 2] = shares[: PLANTS // 2] > 0.5
    plants = ends[:, 0] + shares * (ends[:, 1] - ends[:, 0])
    lower, upper = problem.limits.state_bounds(problem.plant)
    margins = np.zeros(len(lower))
    for _ in range(PASSES):
        named = zip(problem.plant.state.elements, margins, strict=True)
        held = {name: (m,) * problem.horizon.stages for name, m in named if name in problem.limits.states}
        margined = replace(controller, margins=held)
        loop = simulator(problem, margined)
        runs = [loop.run(seed=0, variant=replace(problem, plant=exactly(problem.plant, p)))["state"] for p in plants]
        beyond = np.max([np.maximum(run - upper, lower - run).max(axis=0) for run in runs], axis=0)
        if (beyond <= 0).all():
            return margined
        margins += 1.1 * np.maximum(beyond, 0.0)
    raise RuntimeError(f"after {PASSES} passes a plant still passes a limit")


def main() -> None:
    """Run and print."""
    rows = []
    for name in [a for a in sys.argv[1:] if not a.startswith("--")] or list(LOOPS):
        loop = LOOPS[name]
        for period in loop.periods:
            problem, controller = task(name, period)
            stated = fp.certify_limits(problem, controller, mismatch=loop.mismatch, pieces=loop.pieces)
            if not stated.holds:
                print(name, period, stated)
                continue
            limits = problem.limits.states
            shares = {s: 2 * stated.tube[s] / (limits[s][1] - limits[s][0]) for s in limits}
            widest = max(shares, key=lambda s: shares[s])
            row = (f"{stated.contraction:.2f}", f"{widest} {100 * shares[widest]:.2g} %")
            tried = verified(problem, controller, loop.mismatch)
            prices = price(problem, controller, tried), price(problem, controller, stated.controller)
            rows.append([name, f"{loop.mismatch:g} %", f"{1000 * period:g} ms", *row, *prices])
            print(rows[-1], flush=True)
    heads = [
        "plant",
        "mismatch",
        "period",
        "contraction",
        "widest tube, of half the range",
        "cost, verified",
        "cost, certified",
    ]
    write_table("certificate", heads, rows, PAGE)


if __name__ == "__main__":
    main()
