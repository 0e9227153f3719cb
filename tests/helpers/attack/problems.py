"""The small problem of the attacks on files, processes and command lines."""

import tempfile
from collections.abc import Mapping
from pathlib import Path

import fpirhc as fp
from fpirhc.contracts import Controller
from helpers.line import line_text

LINE = line_text(
    "period=5e-3, duration=0.2, measure_from=0.05, limits=fp.Limits(inputs={'u': (-50.0, 50.0)}), "
    "disturbances={'u': fp.Noise(0.1)}",
    bounds="(0.5, 2.4)",
)


def line_task() -> tuple[fp.Problem, Mapping[str, Controller]]:
    """The problem and its controllers."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "line.py"
        path.write_text(LINE, encoding="utf-8")
        task = fp.load_problem(str(path))
    return task.problem, task.controllers
