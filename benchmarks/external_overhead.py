"""What a cycle with a body outside costs beside the controller and the body: a trivial body and a trivial controller.

Processor time per cycle of the run with the body outside, that of its loop's step alone, and the difference: the overhead. With a
deadline the body is called by a thread of its own.

    .venv/bin/python benchmarks/external_overhead.py
"""

from __future__ import annotations

import time
from collections.abc import Callable

import casadi as ca
import numpy as np

import fpirhc as fp
from fpirhc.simulation.simulate import simulator

CYCLES, REPEATS = 5000, 7


class Still:
    """A body that answers the same always."""

    def __init__(self) -> None:
        self.answer = np.zeros(3)

    def reset(self, seed: int) -> np.ndarray:
        """The answer."""
        del seed
        return self.answer

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        """The answer."""
        del time, command
        return self.answer


def least(function: Callable[[], object]) -> float:
    """Least processor time of a cycle, s."""
    times = []
    for _ in range(REPEATS):
        begin = time.process_time()
        function()
        times.append(time.process_time() - begin)
    return min(times) / CYCLES


def main() -> None:
    """Print the three times in microseconds, without and with a deadline."""
    for deadline in (None, 1.0):
        print(f"deadline {deadline}: {overhead(deadline)}")


def overhead(deadline: float | None) -> str:
    """The three times."""
    plant = fp.Plant({"y": "m"}, {"u": "N"}, {"m": fp.Parameter(1.0, 1.0, "kg")}, lambda _q, _v, u, p: {"y": u.u / p.m})
    outside = fp.ExternalPlant(Still(), measures={"y": "m", "y'": "m/s", "y''": "m/s^2"}, deadline=deadline)
    task = fp.Problem(
        plant=plant,
        reality=outside,
        reference=fp.Trajectory(lambda t: {"y": 0.1 * ca.sin(t)}),
        start={"y": 0.0},
        period=1e-3,
        duration=CYCLES * 1e-3,
    )
    ready = simulator(task, fp.ComputedTorque(fp.Exponential(rate=6.0), fp.ModelReferenced(fp.Affine(gain=-0.3))))
    whole = least(lambda: ready.run(seed=0))
    alone = least(lambda: [ready.evaluator.failure() for _ in range(CYCLES)])
    return f"cycle {1e6 * whole:.1f} us, its step alone {1e6 * alone:.1f} us, overhead {1e6 * (whole - alone):.1f} us"


if __name__ == "__main__":
    main()
