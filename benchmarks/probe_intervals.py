"""How often the intervals of a probe contain the truth: bodies whose gain, dead time, lag and noise are drawn.

.venv/bin/python benchmarks/probe_intervals.py                          # 100 draws: four minutes
Options: --draws COUNT --first SEED --cycles COUNT

A body is q'' = lambda lag(u, d cycles late) - .5 q' - 2 sin q + sin(1.3 t), a third of them with dry friction; the model is
q'' = u. lambda is .3 to 3, d 0 to 8, the lag 0 or 1 to 10 cycles, the noise of the response .02 to .5 m/s^2, the record 300 cycles.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import dataclass

import casadi as ca
import numpy as np

import fpirhc as fp
from fpirhc.probing.identification import Channel, Interval, identify
from fpirhc.probing.recording import excited

PERIOD, FINER = 1e-2, 10
RATE, SAFE = 4.0, 0.2  # 1/s, and the largest product of the rate, the gain and what is late


@dataclass
class Body:
    """A body with what the probe has to find, and friction, m/s^2."""

    gain: float
    dead: int
    lag: float
    noise: float
    friction: float

    def reset(self, seed: int) -> np.ndarray:
        """Begin at rest."""
        self.random, self.queue = np.random.default_rng(seed), [0.0] * self.dead
        self.q = self.v = self.acting = 0.0
        return np.zeros(3)

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        """Hold the command for a cycle."""
        self.queue.append(float(command[0]))
        now, h = self.queue.pop(0), PERIOD / FINER
        for i in range(FINER):
            self.acting = now + (self.acting - now) * (np.exp(-h / self.lag) if self.lag else 0.0)
            rubbing = self.friction * np.sign(self.v)
            a = self.gain * self.acting - 0.5 * self.v - 2 * np.sin(self.q) + np.sin(1.3 * (time + i * h)) - rubbing
            self.q, self.v = self.q + h * self.v + h * h / 2 * a, self.v + h * a
        return np.array([self.q, self.v, a + self.noise * self.random.standard_normal()])


def drawn(seed: int) -> Body:
    """Return the body of a seed."""
    random = np.random.default_rng(seed)
    lag = float(random.integers(2)) * PERIOD * 10 ** random.uniform(0, 1)
    friction = float(random.integers(3) == 0) * random.uniform(0.0, 0.5)
    gain, noise = 10 ** random.uniform(np.log10(0.3), np.log10(3)), 10 ** random.uniform(np.log10(0.02), np.log10(0.5))
    return Body(float(gain), int(random.integers(9)), lag, float(noise), friction)


def found(body: Body, cycles: int, seed: int) -> Channel:
    """Return what one excited record says of the body."""
    model = fp.Plant(
        {"q": "m"}, {"u": "m/s^2"}, {"b": fp.Parameter(1.0, 1.0, "1")}, lambda q, v, u, p: {"q": p.b * u.u}
    )
    problem = fp.Problem(
        plant=model,
        reality=fp.ExternalPlant(body, measures={"q": "m", "q'": "m/s", "q''": "m/s^2"}),
        reference=fp.Trajectory(lambda t: {"q": 1 - ca.cos(2 * t)}),
        start={"q": 0.0},
        period=PERIOD,
        duration=cycles * PERIOD,
        measure_from=0.0,
    )
    late = (body.dead + 1) * PERIOD + body.lag
    law = fp.ComputedTorque(fp.Exponential(rate=min(RATE, SAFE / (body.gain * late))))  # a loop that is safe
    record = excited(problem, law, cycles=cycles, amplitude=None, seed=seed)
    return identify(record.measured, record.modelled, PERIOD, record.usable)[0]


def holds(interval: Interval, truth: float) -> bool:
    """Return whether the interval contains the truth, to rounding."""
    return interval.low - 1e-12 <= truth <= interval.high + 1e-12


def held(seeds: range, cycles: int = 300) -> Counter[str]:
    """Return how many intervals of each estimate hold, and of how many bodies all of them do."""
    counts: Counter[str] = Counter()
    for seed in seeds:
        body = drawn(seed)
        one = found(body, cycles, seed)
        right = {
            "gain": holds(one.gains[0], body.gain),
            "dead time": holds(one.dead_time, body.dead),
            "lag": holds(one.lag, body.lag),
        }
        counts.update(name for name, yes in {**right, "all": all(right.values())}.items() if yes)
        if not all(right.values()):
            print(f"{seed}: {body}\n    {one.gains[0]}, {one.dead_time}, {one.lag}", flush=True)
    return counts


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--cycles", type=int, default=300)
    asked = parser.parse_args()
    counts = held(range(asked.first, asked.first + asked.draws), asked.cycles)
    print(", ".join(f"{name} {counts[name]} of {asked.draws}" for name in ("gain", "dead time", "lag", "all")))


if __name__ == "__main__":
    main()
