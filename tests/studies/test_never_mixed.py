"""Results of two different studies are never mixed: whatever decides a number stands in the head of its file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import fpirhc as fp
from fpirhc.errors import OutputError
from fpirhc.problem_files.problem_file import Task
from fpirhc.studies.tune import tune

HELPER = "def response(q, v, u, p):\n    return {'x': (u.F - p.k * q.x) / p.m}\n"
CART = """
import fpirhc as fp
from helper import response

parameters = {
    "m": fp.Parameter(1.2, 1.0, "kg", spread=fp.Uniform(relative=0.3)),
    "k": fp.Parameter(2.0, 2.5, "N/m", spread=fp.Uniform(relative=0.3)),
}
plant = fp.Plant({"x": "m"}, {"F": "N"}, parameters, response, order=2)
problem = fp.Problem(plant, fp.Trajectory(lambda t: {"x": 0.1 * t}), {"x": 0.2}, period=1e-2, duration=0.2)
controllers = {"CTC": fp.ComputedTorque(fp.Exponential(rate=6.0))}
tuning = {"CTC": {"tracking.rate": fp.LogSpan(2.0, 20.0)}}
metrics = (fp.Metric("share", lambda problem, run: 0.5),)
"""


@pytest.fixture
def task(tmp_path, monkeypatch) -> Task:
    """A cart whose response is in a module beside its file."""
    monkeypatch.chdir(tmp_path)
    Path("helper.py").write_text(HELPER)
    Path("cart.py").write_text(CART)
    return fp.load_problem("cart.py")


def test_a_search_in_another_span_is_another_search(task):
    tune(task, trials=1, seed=0, folder=Path("trials"), compiled=False)
    other = replace(task, tuning={"CTC": {"tracking.rate": fp.LogSpan(50.0, 100.0)}})
    with pytest.raises(OutputError, match="tuning was"):
        tune(other, trials=2, seed=0, folder=Path("trials"), compiled=False)
