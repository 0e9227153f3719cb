"""Pages of `fpirhc export --to lab`: the data in them, and the runs of Python that they are to equal."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import fpirhc as fp
from fpirhc.__main__ import main


def exported(folder: Path, of: str, controller: str) -> tuple[Path, Any]:
    """The page of a controller, and its data."""
    assert main(["export", of, controller, "--to", "lab", "--out", str(folder)]) == 0
    [page] = folder.glob("*-lab.html")
    text = page.read_text(encoding="utf-8")
    begin = text.index("const DATA=") + len("const DATA=")
    return page, json.loads(text[begin : text.index(";\n", begin)])


def run(of: str, controller: str, moved: dict[str, float], live: list[str]) -> fp.Run:
    """The run of a controller with other numbers: parameters of the plant and of the model, and live settings."""
    task = fp.load_problem(of)
    ready = fp.simulator(task.problem, task.controllers[controller], compiled=False, live=live)
    parameters = dict(task.problem.plant.parameters)
    for path, value in moved.items():
        side, _, name = path.partition(".")
        if side in ("exact", "approximate"):
            parameters[name] = replace(parameters[name], **{side: value})
    variant = replace(task.problem, plant=replace(task.problem.plant, parameters=parameters))
    changes = {path: value for path, value in moved.items() if path in live}
    return ready.run(seed=0, variant=variant, settings=changes)


def same_curves(data: Any, columns: list[list[float]], of: fp.Run) -> None:
    """Every curve that is drawn is that of the run, to 1e-12 of its largest number."""
    [loop] = data["loops"]
    for chart in data["charts"]:
        wanted = np.ravel(of[chart["column"]])[:: loop["every"]]
        apart = np.abs(np.array(columns[chart["places"][0]]) - wanted).max()
        assert apart <= 1e-12 * max(1.0, np.abs(wanted).max()), chart["column"]
