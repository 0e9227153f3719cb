"""The price of a certificate of limits: what certified plans cost beside verified ones, and that it vanishes with the period.

    python benchmarks/certificate.py [PLANT ...]     prints the table; --write puts it into docs/certificate.md

All plans are those of the model alone (`FromPlan` with room), tracked by the same law and deformation. Cost: the mean of the stage
cost of the run with the exact parameters, as share of that without margins, which may pass its limits. Verified margins are those
of `fp.tightened`, for which runs of some plants of the box speak; certified ones hold for all of it.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import casadi as ca
from foreign import FOREIGN
from table import write_table

import fpirhc as fp
from fpirhc.controllers.base import Controller

PAGE = Path(__file__).resolve().parents[1] / "docs" / "certificate.md"


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


def verified(problem: fp.Problem, controller: Controller, mismatch: float, free: float) -> str:
    """The share of the cost with margins that runs verify, or '-' where there are none."""
    try:
        return f"{cost(problem, fp.tightened(problem, controller, mismatch=mismatch)) / free:.3f}"
    except fp.FpirhcError as error:
        print(error)
        return "-"


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
            free = cost(problem, controller)
            row = (f"{stated.contraction:.2f}", f"{widest} {100 * shares[widest]:.2g} %")
            prices = (
                verified(problem, controller, loop.mismatch, free),
                f"{cost(problem, stated.controller) / free:.3f}",
            )
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
