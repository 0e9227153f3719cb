"""Which form of the iteration: plain, increment and model-referenced side by side on all shipped problems.

    python benchmarks/which_form.py [names of problems]     prints tables with their rows; --write writes the page

Each problem keeps its controller, horizon, limits and measuring time; only the deformation is exchanged: eq (6) with the gains
-0.5, -1.5, -2.5 in each of the three forms. Five conditions:

    exact       the model has the plant's parameters, nothing disturbs; by how much the deformation changes the motion all the same
    as shipped  the wrong model, the sensors, dead time and disturbances of the problem
    noise       the same, and the measured response has white noise of 5 % of the desired response's rms
    dead time   the same, and commands arrive 5 cycles late; all forms are told (plain: Paired)
    lag         the same, and the response is the velocity's difference through a low-pass of 5 cycles

An error is that of a run with deformation relative to the one without in the same condition: the geometric mean over the judged
coordinates of the ratios of their rms errors.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import fpirhc as fp
from fpirhc.controllers.base import Controller
from fpirhc.controllers.check import check_gain_sign
from fpirhc.controllers.contract import resolved
from fpirhc.deformation.base import Deformation
from fpirhc.errors import FpirhcError
from fpirhc.problem_files.shipped import shipped_problems
from fpirhc.review.questions.right_model import recommended_form
from fpirhc.simulation.run import Run
from fpirhc.task.problem import Problem

sys.path.insert(0, str(Path(__file__).resolve().parent))
from table import write_table

PAGE = Path(__file__).resolve().parents[1] / "docs" / "which-form.md"
GAINS = (-0.5, -1.5, -2.5)
MOST = 4000  # cycles that are measured
LATE = 5  # cycles, of dead time and of the low-pass
NOISE = 0.05  # of the desired response's rms
NEAR = 1.1  # times the best: as good as it

Form = Callable[[Problem, Deformation], Deformation]


def plain(problem: Problem, map: Deformation) -> Deformation:
    """The map; with a dead time, on the pair."""
    late = problem.dead_time.measurement or any(problem.dead_time.inputs.values())
    return fp.Paired(map, cycles=problem.response_delay) if late else map


def increment(problem: Problem, map: Deformation) -> Deformation:
    """The increment, leaky where there is a delay."""
    return fp.Increment(map, cycles=problem.response_delay)


def referenced(problem: Problem, map: Deformation) -> Deformation:
    """Model-referenced, told of the dead time."""
    late = problem.dead_time
    cycles = max(late.inputs.values(), default=0.0) / problem.period
    return fp.ModelReferenced(map, cycles=cycles, measurement=late.measurement / problem.period)


FORMS: dict[str, Form] = {"plain": plain, "increment": increment, "model-referenced": referenced}


@dataclass(frozen=True, eq=False)
class Task:
    """A problem and its adaptive controller."""

    name: str
    problem: Problem
    controller: Controller

    def runs(self, deformation: Deformation) -> Run | None:
        """The run with another deformation; None where it is refused or ends early."""
        try:
            run = fp.simulate(self.problem, self.controller.with_deformation(deformation), seed=0, compiled=False)
        except FpirhcError:
            return None
        return run if run.stop is None else None

    def map(self, gain: float) -> Deformation:
        """Eq (6) with this gain, in the direction and with the scale of the controller's own deformation."""
        own: Any = resolved(self.problem, self.controller).deformation
        sign = -1.0 if own.effective_gain() < 0 else 1.0
        while hasattr(own, "map"):
            own = own.map
        scale = own.scale if isinstance(own, fp.Sigmoid) else 50.0
        return fp.Sigmoid(gain=sign * gain, shift=sign * 0.3, scale=scale)


def task(name: str) -> Task:
    """A shipped problem with the adaptive controller of its headline, short enough to be run many times."""
    module = fp.load_problem(name)
    problem = module.problem
    end = problem.measure_from + MOST * problem.period
    return Task(name, replace(problem, duration=min(problem.duration, end)), module.controllers[module.headline[1]])


def exact(one: Task) -> Task | None:
    """The model is the plant, nothing disturbs, sensors are not noisy."""
    known = {n: replace(p, approximate=p.exact) for n, p in one.problem.plant.parameters.items()}
    sensors = {n: replace(s, noise=None, dropout=0.0) for n, s in one.problem.sensing.sensors.items()}
    problem = replace(
        one.problem,
        plant=replace(one.problem.plant, parameters=known),
        disturbances={},
        sensing=replace(one.problem.sensing, sensors=sensors),
    )
    return replace(one, problem=problem)


def noisy(one: Task) -> Task | None:
    """White noise on the measured response; None where it is not measured."""
    run = one.runs(fp.Identity())
    if run is None or not one.problem.sensing.ideal or "desired" not in run.layout or hasattr(one.controller, "slots"):
        return None
    late = run.time >= one.problem.measure_from
    sizes = np.sqrt(np.mean(run["desired"][late] ** 2, axis=0))
    orders = one.problem.plant.response_orders
    sensors = {
        name + "'" * orders[name]: fp.Sensor(noise=fp.Noise(NOISE * float(size)))
        for name, size in zip(one.problem.plant.controlled_names, sizes, strict=True)
    }
    return replace(one, problem=replace(one.problem, sensing=fp.Sensing(sensors)))


def late(one: Task) -> Task | None:
    """Commands arrive late; None where they do anyway."""
    if any(one.problem.dead_time.inputs.values()) or one.problem.dead_time.measurement:
        return None
    wait = dict.fromkeys(one.problem.plant.inputs, LATE * one.problem.period)
    return replace(one, problem=replace(one.problem, dead_time=fp.DeadTime(inputs=wait)))


def lagging(one: Task) -> Task | None:
    """The response through a low-pass; None where it is estimated anyway."""
    if not one.problem.sensing.ideal:
        return None
    estimator = fp.LowPassDifference(time_constant=LATE * one.problem.period)
    return replace(one, problem=replace(one.problem, sensing=fp.Sensing(estimator=estimator)))


CONDITIONS: dict[str, Callable[[Task], Task | None]] = {
    "exact": exact,
    "as shipped": lambda one: one,
    "noise": noisy,
    "dead time": late,
    "lag": lagging,
}


def change(problem: Problem, run: Run, without: Run) -> float:
    """Largest change of the state, relative to its largest value."""
    del problem
    name = "plant_state" if "plant_state" in run.layout else "state"
    return float(np.abs(run[name] - without[name]).max() / np.abs(without[name]).max())


def error(problem: Problem, run: Run, without: Run) -> float:
    """Error relative to that without deformation."""
    mine, other = (np.array(list(fp.measure(problem, r).rms_error.values())) for r in (run, without))
    return float(np.exp(np.mean(np.log(mine / other))))


def measured(one: Task, judge: Callable[[Problem, Run, Run], float]) -> list[float]:
    """Numbers of all forms and gains; NaN where there is no run."""
    without = one.runs(fp.Identity())
    rows = []
    for form in FORMS.values():
        for gain in GAINS:
            run = one.runs(form(one.problem, one.map(gain))) if without is not None else None
            rows.append(judge(one.problem, run, without) if run is not None and without is not None else float("nan"))
    return rows


def shown(name: str, values: list[float], *, mark: bool) -> list[str]:
    """A row of the table with every number that is as good as the best in bold."""
    best = np.nanmin(values) if np.isfinite(values).any() else np.nan
    cells = ["–" if np.isnan(v) else f"{v:.2g}" for v in values]
    if mark:
        cells = [f"**{c}**" if v <= NEAR * best and v < 1 else c for c, v in zip(cells, values, strict=True)]
    return [name, *cells]


def adaptive() -> list[str]:
    """Names of the shipped problems whose headline has a deformation of any form; an iteration on targets pairs by itself."""
    names = []
    for name in shipped_problems():
        one = task(name)
        try:
            one.controller.with_deformation(fp.Identity())
            ready = resolved(one.problem, one.controller)
            check_gain_sign(one.problem, ready.deformation)
        except (TypeError, FpirhcError):
            continue
        names += [name] if ready.deforms != "target" else []
    return sorted(names)


def main() -> None:
    """Measure and print the rows of each problem, and count the wins of all rows."""
    heads = ["problem", *(f"{form} {gain:g}" for form in FORMS for gain in GAINS)]
    known = adaptive()
    for name in [a for a in sys.argv[1:] if not a.startswith("-")] or known:
        one = task(name)
        for condition, alter in CONDITIONS.items():
            altered = alter(one)
            values = [] if altered is None else measured(altered, change if condition == "exact" else error)
            row = [shown(name, values, mark=condition != "exact")] if np.isfinite(values).any() else []
            write_table(f"forms {condition}", heads, renewed(f"forms {condition}", name, row, known), PAGE)
        advice = renewed("forms review", name, [[name, *_advice(one)]], known)
        write_table("forms review", ["problem", "as shipped", "dead time", "lag"], advice, PAGE)
    summary = [[form, *(str(wins(condition)[form]) for condition in CONDITIONS)] for form in FORMS]
    write_table("forms wins", ["best or within 10 % of the best", *CONDITIONS], summary, PAGE)


def renewed(table: str, name: str, own: list[list[str]], known: list[str]) -> list[list[str]]:
    """The rows of known problems that the page has, sorted, with a problem's own in place of its old one."""
    return sorted([row for row in written(table) if row[0] in known and row[0] != name] + own)


def written(table: str) -> list[list[str]]:
    """The rows of a table of the page."""
    text = PAGE.read_text(encoding="utf-8").partition(f"<!-- begin {table} -->")[2].partition("<!-- end")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]
    return rows[2:]


def _advice(one: Task) -> list[str]:
    """What a review recommends in three of the conditions."""
    tasks = [one, late(one), lagging(one)]
    return ["–" if t is None else recommended_form(t.problem)[0] for t in tasks]


def wins(condition: str) -> dict[str, int]:
    """Rows of the page that a form wins with its best gain; with an exact model, which it is not to change, with its worst."""
    won, pick = dict.fromkeys(FORMS, 0), np.nanmax if condition == "exact" else np.nanmin
    for _, *cells in written(f"forms {condition}"):
        groups = np.array([float(c.strip("*").replace("–", "nan")) for c in cells]).reshape(len(FORMS), len(GAINS))
        scores = [float(pick(g)) if np.isfinite(g).any() else np.inf for g in groups]
        for form, score in zip(FORMS, scores, strict=True):
            won[form] += score <= max(NEAR * min(scores), 1e-9)
    return won


if __name__ == "__main__":
    main()
