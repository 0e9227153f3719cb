"""When does an iteration beat offset-free predictive control? Maps of winners on a mass whose model is wrong, at equal rate.

The plant is y'' = b u + w: the model has b = 1 and no w, which drifts as a random walk of known density. All rows are the same
receding horizon; filters know the deviations of drift and noise, and the iteration has the gain that is best for b = 1. Maps:

    noise     b over the noise of the response; that of the velocity stays
    latency   b over cycles by which commands arrive later than anybody knows

.venv/bin/python benchmarks/winners.py            # prints both maps: a minute
.venv/bin/python benchmarks/winners.py --write    # writes them into docs/study.md
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np

import fpirhc as fp
from fpirhc.controllers.contract import Controller, believing
from fpirhc.simulation.simulate import simulator

PAGE = Path(__file__).parents[1] / "docs" / "study.md"
PERIOD, DRIFT, VELOCITY, POSITION = 1e-2, 1.0, 1e-2, 1e-3  # s, m/s^2.5, m/s, m
MEMORY, SEEDS, TIE = 20.0, (0, 1), 1.05  # s; of the drift; ratio of errors that are called equal
MOST = 5.0  # largest b, for which the gentle iteration is tuned
GAINS = (0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0)
SHARES = (0.01, 0.1, 0.5, 1.0, 2.0, 10.0, 100.0)  # s_f^2 T^0.5 / (2 D s_v)
LATENCIES = (0, 1, 2, 3, 5, 8)  # cycles
ROWS = {
    "-": "no correction",
    "F": "the iteration, model-referenced, on the measured response",
    "G": f"the same with a gain that bears b up to {MOST:g}",
    "R": "offset-free, on the measured response",
    "V": "offset-free, on the velocity",
    "B": "offset-free, on both",
}


def response_noise(share: float) -> float:
    """The deviation s_f with which a measured response tells as much as the velocity where the share is 1."""
    return math.sqrt(share * 2 * DRIFT * VELOCITY / math.sqrt(PERIOD))


def problem(noise: float) -> fp.Problem:
    """The mass with this noise of the response."""
    plant = fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "m/s^2"},
        parameters={"b": fp.Parameter(1.0, 1.0, "1")},
        response=lambda q, v, u, p: {"y": p.b * u.u},
    )
    sensors = {name: fp.Sensor(fp.Noise(size)) for name, size in (("y", POSITION), ("y'", VELOCITY), ("y''", noise))}
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"y": ca.sin(t)}),
        start={"y": 0.0, "y'": 1.0},
        period=PERIOD,
        duration=20.0,
        measure_from=5.0,
        disturbances={"y": fp.ColouredNoise(DRIFT * math.sqrt(MEMORY / 2), MEMORY)},
        sensing=fp.Sensing(sensors),
        horizon=fp.Horizon(stages=20, step=5e-2, replan="cycle"),
        cost=fp.Quadratic(states={"y": 100.0, "y'": 5.0}, deviation={"u": 1.0}),
    )


def controllers(task: fp.Problem, noise: float) -> dict[str, Controller]:
    """The rows by letter."""
    plain = fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-2))
    known = {r.measured: r for r in fp.compare_information(task, drift={"y": DRIFT}).rows}
    told = {"R": {"y''": noise}, "V": {"y'": VELOCITY}, "B": {"y''": noise, "y'": VELOCITY}}
    filters = {k: fp.DisturbanceKalman({"y": DRIFT}, {**one, "y": POSITION}) for k, one in told.items()}
    gain = known["y''"].gain  # of the iteration, half of the map's
    return {
        "-": plain,
        "F": replace(plain, deformation=fp.ModelReferenced(fp.Affine(gain=-2 * gain))),
        "G": replace(plain, deformation=fp.ModelReferenced(fp.Affine(gain=-2 * min(gain, 1 / MOST)))),
        **{name: fp.Estimating(plain, one, at_once=True) for name, one in filters.items()},
    }


def errors(
    share: float, gains: Iterable[float], latencies: Sequence[int], rows: str = "-FGRVB", seeds: Sequence[int] = SEEDS
) -> dict[tuple[float, int], dict[str, float]]:
    """Rms errors of y by (gain, latency) and row; infinite where a run ended early."""
    noise, found = response_noise(share), {}
    late = max(latencies) * PERIOD
    task = problem(noise)
    known = controllers(task, noise)
    for letter in rows:
        room = replace(task, dead_time=fp.DeadTime({"u": 0.0}, longest={"u": late})) if late else task
        live = ("dead_time.inputs.u",) if late else ()
        loop = simulator(room, believing(task, known[letter]), compiled=None, live=live)
        for gain in gains:
            for cycles in latencies:
                times = replace(room.dead_time, inputs={"u": cycles * PERIOD}) if late else room.dead_time
                variant = replace(room, dead_time=times).with_exact(np.array([gain]))
                runs = [loop.run(seed=seed, variant=variant) for seed in seeds]
                sizes = [fp.measure(variant, run).rms_error["y"] if run.stop is None else math.inf for run in runs]
                found.setdefault((gain, cycles), {})[letter] = float(np.mean(sizes))
    return found


def best(of: Mapping[str, float]) -> str:
    """The letters of the rows within 5 % of the best, and how many times smaller its error is than without correction."""
    least = min(of.values())
    if math.isinf(least):
        return "none"
    winners = "".join(name for name, size in of.items() if size <= TIE * least)
    return f"{winners} {of['-'] / least:.3g}"


def noise_map() -> tuple[list[str], dict[str, dict[str, float]]]:
    """The lines of the first map, and its errors by 'share gain'."""
    lines, every = [_head("s_f^2 T^.5 / 2 D s_v", GAINS), _rule(GAINS)], {}
    for share in SHARES:
        found = errors(share, GAINS, (0,))
        lines.append(_line(f"{share:g}", (best(found[g, 0]) for g in GAINS)))
        every |= {f"{share:g} {g:g}": found[g, 0] for g in GAINS}
    return lines, every


def latency_map() -> tuple[list[str], dict[str, dict[str, float]]]:
    """The lines of the second map, with the response measured as well as the velocity, and its errors by 'cycles gain'."""
    lines, found = [_head("latency, cycles", GAINS), _rule(GAINS)], errors(1.0, GAINS, LATENCIES)
    lines += [_line(f"{n}", (best(found[g, n]) for g in GAINS)) for n in LATENCIES]
    return lines, {f"{n} {g:g}": found[g, n] for n in LATENCIES for g in GAINS}


def _head(corner: str, columns: Sequence[float]) -> str:
    return _line(corner, (f"b = {g:g}" for g in columns))


def _rule(columns: Sequence[float]) -> str:
    return "|" + "---|" * (len(columns) + 1)


def _line(first: str, cells: Iterable[str]) -> str:
    return "| " + " | ".join([first, *cells]) + " |"


def main() -> None:
    """Print the maps, or write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write docs/study.md")
    asked = parser.parse_args()
    text = PAGE.read_text(encoding="utf-8") if asked.write else ""
    for name, (lines, _) in (("noise", noise_map()), ("latency", latency_map())):
        print("\n".join([name, *lines, ""]), flush=True)
        marks = f"<!-- begin {name} -->", f"<!-- end {name} -->"
        text = re.sub(f"{marks[0]}.*?{marks[1]}", "\n".join([marks[0], *lines, marks[1]]), text, flags=re.DOTALL)
    if asked.write:
        PAGE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
