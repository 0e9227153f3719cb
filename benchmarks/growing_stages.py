"""Stages and plans side by side, on a two-joint arm that MuJoCo simulates and whose model is wrong.

The body has rotor inertia, joint damping, dry friction and a tool of 1 kg; the model is two uniform rods without any of them.
A cycle lasts 2 ms. Each row is a horizon: errors of RHC and of RHC+FPI after the first second, and their ratio to those of 60
stages of 2 ms; then the time of a cycle of RHC+FPI that plans, and its ratio.

    .venv/bin/python benchmarks/growing_stages.py          # needs mujoco: pip install -e '.[outside]'
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

import fpirhc as fp
from fpirhc.adapters.mujoco import mujoco_body
from fpirhc.studies.comparison.timing import measure_cycle, stepper_to_time

PERIOD = 2e-3
JOINTS = ("shoulder", "elbow")
BODY = """<mujoco><option timestep="0.0005" integrator="implicitfast" gravity="0 0 -9.81"/>
<default><joint armature="0.03" damping="0.2" frictionloss="0.4"/>
<geom type="capsule" size="0.03" contype="0" conaffinity="0"/></default>
<worldbody><body><joint name="shoulder" axis="0 -1 0"/><geom fromto="0 0 0 0.5 0 0" mass="2.0"/>
<body pos="0.5 0 0"><joint name="elbow" axis="0 -1 0"/><geom fromto="0 0 0 0.4 0 0" mass="1.2"/>
<geom type="sphere" pos="0.4 0 0" size="0.05" mass="1.0"/></body></body></worldbody>
<actuator><motor name="M1" joint="shoulder" ctrlrange="-80 80"/>
<motor name="M2" joint="elbow" ctrlrange="-40 40"/></actuator></mujoco>"""


def rods(q: Any, v: Any, u: Any, p: Any) -> dict[str, ca.SX]:
    """Two uniform rods without friction and without tool."""
    l1, l2, g = 0.5, 0.4, 9.81
    a, b, c = p.m1 * l1**2 / 3 + p.m2 * l1**2 + p.m2 * l2**2 / 3, p.m2 * l1 * l2 / 2, p.m2 * l2**2 / 3
    bent, leaned = q.elbow, q.shoulder + q.elbow
    inertia = ca.vertcat(
        ca.horzcat(a + 2 * b * ca.cos(bent), c + b * ca.cos(bent)), ca.horzcat(c + b * ca.cos(bent), c)
    )
    turning = b * ca.sin(bent) * ca.vertcat(-(2 * v.shoulder * v.elbow + v.elbow**2), v.shoulder**2)
    weight = ca.vertcat(
        (p.m1 / 2 + p.m2) * g * l1 * ca.cos(q.shoulder) + p.m2 * g * l2 / 2 * ca.cos(leaned),
        p.m2 * g * l2 / 2 * ca.cos(leaned),
    )
    acceleration = ca.solve(inertia, ca.vertcat(u.M1, u.M2) - turning - weight)
    return {"shoulder": acceleration[0], "elbow": acceleration[1]}


def problem(horizon: fp.Horizon) -> fp.Problem:
    """Both joints swing."""
    plant = fp.Plant(
        dict.fromkeys(JOINTS, "rad"),
        {"M1": "N m", "M2": "N m"},
        {"m1": fp.Parameter(2.0, 2.0, "kg"), "m2": fp.Parameter(1.2, 1.2, "kg")},
        rods,
    )
    return fp.Problem(
        plant=plant,
        reality=mujoco_body(BODY, plant, period=PERIOD),
        reference=fp.Trajectory(lambda t: {"shoulder": 0.8 * (1 - ca.cos(2 * t)), "elbow": -0.5 * (1 - ca.cos(3 * t))}),
        start=dict.fromkeys(JOINTS, 0.0),
        period=PERIOD,
        duration=3.0,
        measure_from=1.0,
        limits=fp.Limits(inputs={"M1": (-80.0, 80.0), "M2": (-40.0, 40.0)}),
        horizon=horizon,
        cost=fp.Quadratic(
            states={"shoulder": 1e3, "elbow": 1e3, "shoulder'": 1.0, "elbow'": 1.0}, deviation={"M1": 1e-3, "M2": 1e-3}
        ),
    )


def growing(stages: int, factor: float) -> fp.Horizon:
    """Stages that grow from one cycle by a factor each."""
    return fp.Horizon(stages, PERIOD, lengths=tuple(factor**k for k in range(stages)))


OPTIMISER = fp.FixedPoint(iterations=1, tolerance=1e-3)
WAYS = {"RHC": fp.RecedingHorizon(OPTIMISER)}
WAYS["RHC+FPI"] = replace(WAYS["RHC"], deformation=fp.ModelReferenced(fp.Affine(gain=-1.0)))
HORIZONS = {
    "60 of 2 ms": fp.Horizon(60, PERIOD),
    "20 of 20 ms, a plan per stage": fp.Horizon(20, 2e-2),
    "20 of 20 ms, a plan per cycle": fp.Horizon(20, 2e-2, replan="cycle"),
    "20 of 6 ms, a plan per cycle": fp.Horizon(20, 6e-3, replan="cycle"),
    "20 growing by 1.1": growing(20, 1.1),
    "20 growing by 1.2": growing(20, 1.2),
    "12 growing by 1.2": growing(12, 1.2),
}


def main() -> None:
    """Print the table."""
    base: dict[str, np.ndarray] = {}
    first = 0.0
    for name, horizon in HORIZONS.items():
        texts = []
        for way, controller in WAYS.items():
            task = problem(horizon)
            run = fp.simulate(task, controller, seed=0)
            measured = fp.measure(task, run)
            errors = 1e3 * np.array([measured.rms_error[j] for j in JOINTS])
            ratio = errors / base.setdefault(way, errors)
            texts.append(f"{way} {errors[0]:.3f} {errors[1]:.3f} mrad ({ratio[0]:.2f} {ratio[1]:.2f})")
        cycle = measure_cycle(task, stepper_to_time(task, controller, compiled=True), run)
        assert cycle is not None
        first = first or cycle.planning
        texts.append(f"a plan {cycle.planning:.0f} us ({cycle.planning / first:.2f})")
        print(f"{name:30s} {1e3 * horizon.nodes[-1]:4.0f} ms  {'  '.join(texts)}", flush=True)


if __name__ == "__main__":
    main()
