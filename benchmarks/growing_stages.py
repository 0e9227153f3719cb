"""Stages and plans side by side, on a two-joint arm that MuJoCo simulates and whose model is wrong.

The body has rotor inertia, joint damping, dry friction and a tool of 1 kg; the model is two uniform rods without any of them.
A cycle lasts 2 ms. Each row is a horizon: errors of RHC and of RHC+FPI after the first second, and their ratio to those of 60
stages of 2 ms; then the time of a cycle of RHC+FPI that plans, and its ratio.

    .venv/bin/python benchmarks/growing_stages.py          # needs mujoco: pip install -e '.[outside]'
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import fpirhc as fp
from fpirhc.studies.comparison.timing import measure_cycle, stepper_to_time

PERIOD, JOINTS = 2e-3, ("shoulder", "elbow")


def problem(horizon: fp.Horizon) -> fp.Problem:
    """The shipped arm with another horizon, for three seconds."""
    return replace(fp.load_problem("mujoco_arm").problem, horizon=horizon, duration=3.0)


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
    "2 and 8 ms, then 18 of 20 ms": fp.Horizon(20, PERIOD, lengths=(1.0, 4.0, *(10.0,) * 18)),
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
