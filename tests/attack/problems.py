"""The small problem of the attacks on files, processes and command lines."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

import fpirhc as fp
from fpirhc.controllers.contract import Controller

LINE = '''"""A mass on a line with a wrong gain."""
import casadi as ca
import fpirhc as fp

plant = fp.Plant(
    coordinates={"y": "m"},
    inputs={"u": "N"},
    parameters={
        "b": fp.Parameter(approximate=1.0, exact=1.6, unit="1/kg", bounds=(0.5, 2.4)),
        "k": fp.Parameter(2.0, 5.0, "1/s^2"),
    },
    response=lambda q, v, u, p: {"y": p.b * u.u - p.k * q.y},
)
problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"y": ca.sin(2 * t)}),
    start={"y": 0.5},
    period=5e-3,
    duration=0.2,
    measure_from=0.05,
    limits=fp.Limits(inputs={"u": (-50.0, 50.0)}),
    disturbances={"u": fp.Noise(0.1)},
)
tracking = fp.Exponential(rate=6.0)
controllers = {
    "CTC": fp.ComputedTorque(tracking),
    "CTC+FPI": fp.ComputedTorque(tracking, fp.Sigmoid(gain=-0.5)),
}
'''


def line_task() -> tuple[fp.Problem, Mapping[str, Controller]]:
    """The problem and its controllers."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "line.py"
        path.write_text(LINE, encoding="utf-8")
        task = fp.load_problem(str(path))
    return task.problem, task.controllers
