"""Results of two different studies are never mixed: whatever decides a number stands in the head of its file."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import fpirhc as fp
from fpirhc.content import digest
from fpirhc.errors import FpirhcError, OutputError
from fpirhc.problem_files.problem_file import Task
from fpirhc.studies.scenarios.bench import Conditions
from fpirhc.studies.scenarios.fingerprint import fingerprint
from fpirhc.studies.scenarios.scenario_study import compare_scenarios
from fpirhc.studies.sweep import Axis, sweep
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
CONDITIONS = Conditions(seed=0, use=0, percent=20.0, compiled=False)


@pytest.fixture
def task(tmp_path, monkeypatch) -> Task:
    """A cart whose response is in a module beside its file."""
    monkeypatch.chdir(tmp_path)
    Path("helper.py").write_text(HELPER)
    Path("cart.py").write_text(CART)
    return fp.load_problem("cart.py")


def compared(task: Task, folder: str = "out", **more: Any) -> object:
    settings: dict[str, Any] = {"count": 2, "percent": 20.0, "seed": 0, "compiled": False, **more}
    return compare_scenarios(task, folder=Path(folder), **settings)


def with_reference(task: Task, size: float) -> Task:
    """The same but for a number that the formula has from around it."""
    course = fp.Trajectory(lambda t: {"x": size * t})
    return replace(task, problem=replace(task.problem, reference=course))


def with_spread(task: Task) -> Task:
    plant = task.problem.plant
    wide = replace(plant.parameters["m"], spread=fp.Uniform(relative=0.9))
    return replace(
        task, problem=replace(task.problem, plant=replace(plant, parameters={**plant.parameters, "m": wide}))
    )


def with_metric(task: Task) -> Task:
    return replace(task, metrics=[*task.metrics[:-1], replace(task.metrics[-1], function=lambda problem, run: 0.25)])


@pytest.mark.parametrize(
    "change", [lambda task: with_reference(task, 0.2), with_spread, with_metric], ids=["formula", "spread", "metric"]
)
def test_a_task_with_another_formula_gets_no_results_of_the_first(change: Callable[[Task], Task], task):
    """Neither name nor setting of it is another one."""
    compared(task)
    with pytest.raises(OutputError, match="results are never mixed"):
        compared(change(task))


def test_a_module_beside_the_file_counts_as_the_file(task):
    """Not a formula of it changed: what else the module has may be read by a metric."""
    compared(task)
    Path("helper.py").write_text(HELPER + "# said otherwise\n")
    with pytest.raises(OutputError, match="modules beside the file was"):
        compared(fp.load_problem("cart.py"))


def test_processes_refuse_a_task_that_is_not_its_file(task):
    with pytest.raises(FpirhcError, match="use one process for a task that is not in a file"):
        compared(with_reference(task, 0.2), count=4, processes=2)


def test_a_map_of_another_reference_is_refused(task):
    axes = [Axis("exact.m", (0.8, 1.0))]
    sweep(task, axes, folder=Path("map"), compiled=False)
    with pytest.raises(OutputError, match="formulas and spreads was"):
        sweep(with_reference(task, 0.2), axes, folder=Path("map"), compiled=False)


def test_a_search_in_another_span_is_another_search(task):
    tune(task, trials=1, seed=0, folder=Path("trials"), compiled=False)
    other = replace(task, tuning={"CTC": {"tracking.rate": fp.LogSpan(50.0, 100.0)}})
    with pytest.raises(OutputError, match="tuning was"):
        tune(other, trials=2, seed=0, folder=Path("trials"), compiled=False)


def test_the_facts_are_the_same_in_every_process(task):
    """Whatever order sets have there, and whatever has run before."""
    compared(task)
    code = (
        "import json, fpirhc as fp\n"
        "from fpirhc.studies.scenarios.bench import Conditions\n"
        "from fpirhc.studies.scenarios.fingerprint import fingerprint\n"
        f"print(json.dumps(fingerprint(fp.load_problem('cart.py'), {CONDITIONS!r})))"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "7", "PYTHONPATH": os.pathsep.join(sys.path)}
    there = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert json.loads(there.stdout) == json.loads(json.dumps(fingerprint(task, CONDITIONS)))


def test_content_is_that_of_formulas_and_not_of_objects():
    """Two closures over equal numbers are one; a number around a function, and one that its module has, count."""

    def made(size: float, shared: list[float]) -> Callable[[float], float]:
        return lambda t: size * t + shared[0]

    assert digest(made(1.0, [2.0])) == digest(made(1.0, [2.0]))
    assert len({digest(made(*given)) for given in ((1.0, [2.0]), (3.0, [2.0]), (1.0, [3.0]))}) == 3
    assert digest({"one", "two", "three"}) == digest({"three", "one", "two"})
    assert len({digest(one) for one in (1, 1.0, True, "1", [1], (1,), [1.0], fp.Status(1), fp.Status(0))}) == 9


def test_content_of_a_value_that_holds_itself_has_an_end():
    loop: list[object] = [1]
    loop.append(loop)
    assert digest(loop) != digest([1])


def test_a_figure_that_judges_runs_needs_results_that_have_it(task):
    """Records without the signals that judge a run stay without them."""
    planned = replace(
        task.problem,
        horizon=fp.Horizon(stages=3, step=2e-2),
        cost=fp.Quadratic(states={"x": 1.0}, deviation={"F": 1e-3}),
    )
    task = replace(task, problem=planned)
    compared(task)
    with pytest.raises(OutputError, match="judged was false, is true"):
        compared(task, count=3, headline="cost.total")
    compared(task, "other", count=1, headline="cost.total")
    compared(task, "other", count=2, headline="cost.total")


def test_a_folder_that_is_refused_begins_no_cluster(task, monkeypatch):
    """It would stay: nobody closes what never answered."""
    compared(task)
    monkeypatch.setattr(
        "fpirhc.studies.scenarios.scenario_study.Cluster", lambda *_: pytest.fail("a cluster has begun")
    )
    with pytest.raises(OutputError, match="seed was 0, is 1"):
        compared(task, seed=1, cluster="local")
