"""How far lost samples take the command from the run without faults.

    python benchmarks/lost_samples.py            prints a table; --write puts it into docs/performance.md

A stepper in a loop with the plant loses 1, 5, 20 or 50 samples at three instants. The figure is the largest deviation of the
command from that of the run without faults, in units of the command, over the gap and all later cycles, and the largest of the
three. Beside it stands the same for a controller that is given the missing samples afterwards, on the line between those around
the gap; its commands for them are dropped. The normal movement is the median change of the command per cycle.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import fpirhc as fp

sys.path.insert(0, str(Path(__file__).resolve().parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from lossy import Lossy
from table import write_table

GAPS = (1, 5, 20, 50)
INSTANTS = (300, 600, 1000)  # cycles
AFTER = 150
MASSES, ARM = fp.load_problem("two_mass"), fp.load_problem("three_link_arm")
ESTIMATORS = {
    "position differences": fp.PositionDifference(),
    "Savitzky-Golay": fp.SavitzkyGolay(window=11, degree=4),
    "filter": fp.StateVariableFilter(bandwidth=300.0),
    "velocity differences": fp.VelocityDifference(),
    "low-passed velocity differences": fp.LowPassDifference(time_constant=0.003),
}


def loops() -> dict[str, Lossy]:
    """The loops by name."""
    adaptive = MASSES.controllers["CTC+FPI (eq 6)"]
    result = {"two_mass, everything measured, CTC+FPI (eq 6)": Lossy(MASSES.problem, adaptive)}
    for name, estimator in ESTIMATORS.items():
        problem = replace(MASSES.problem, sensing=fp.Sensing(estimator=estimator))
        result[f"two_mass, {name}, CTC+FPI (eq 6)"] = Lossy(problem, adaptive)
    force = fp.DisturbanceKalman({"q1": 30.0, "q2": 30.0}, dict.fromkeys(MASSES.problem.plant.state.elements, 1e-3))
    filtered = fp.Estimating(MASSES.controllers["CTC"], force)
    result["two_mass, everything measured, CTC with a disturbance filter"] = Lossy(MASSES.problem, filtered)
    for name in ("CT+FPI", "Slotine-Li"):
        result[f"three_link_arm as shipped, {name}, without quanta"] = Lossy(ARM.problem, ARM.controllers[name])
    return result


def row(name: str, own: Lossy) -> list[str]:
    """Name, normal movement, deviations with lost and with interpolated samples."""
    clean = own.run(max(INSTANTS) + max(GAPS) + AFTER)
    movement = np.median(np.abs(np.diff(clean, axis=0)).max(axis=1))
    cells = []
    for how in ("lost", "interpolated"):
        for gap in GAPS:
            away = []
            for first in INSTANTS:
                cycles = first + gap + AFTER
                away.append(np.abs(own.run(cycles, range(first, first + gap), how) - clean[:cycles]).max())
            cells.append(f"{max(away):.2g}")
    return [name, f"{movement:.2g}", *cells]


def main() -> None:
    """Measure and print."""
    rows = [row(name, own) for name, own in loops().items()]
    heads = ("loop", "normal movement", *(f"{g} lost" for g in GAPS), *(f"{g} interpolated" for g in GAPS))
    write_table("lost samples", heads, rows)


if __name__ == "__main__":
    main()
