"""Problem files: a shipped one is found by its name, a user's one by its path.

A problem file defines `problem` (a Problem) and `controllers` ({name: Controller}). The first line of its docstring is its title.
It may also define
- `headline`, a pair (controller without adaptation, controller with adaptation) for the verdict,
- `tuning`, {controller: {path of a setting: Span or LogSpan}}, the ranges in which `fpirhc tune` searches,
- `metrics`, a sequence of `Metric` for all tables, files and baselines of the problem, in addition to the shipped ones,
- `pictures`, a sequence of pictures for the report, in addition to the usual ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import ClassVar

from fpirhc.by_name import FoundByName
from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import named_in_task
from fpirhc.errors import FpirhcError, Mistakes, ProblemFileError
from fpirhc.fields.checked import checked_call
from fpirhc.fields.given import call_of, described
from fpirhc.problem_files.importing import imported
from fpirhc.problem_files.importing import line_of as _at
from fpirhc.problem_files.settings import TuningSpans, check_tuning
from fpirhc.problem_files.shipped import find_problem
from fpirhc.simulation.metrics import Metric, known_metrics, with_own_metrics
from fpirhc.simulation.pictures.base import Picture
from fpirhc.summary import line, table
from fpirhc.task.problem import Problem, problem_facts


@dataclass(frozen=True, eq=False)
class Task(FoundByName):
    """A loaded problem file.

    Args:
        name: of the file, without the suffix; the problem has the same name.
        path: of the file.
        title: first line of the file's docstring.
        description: the other lines.
        problem: the file's problem.
        controllers: by name; runs of them have this name.
        headline: names of the controllers without and with adaptation that the verdict compares.
        tuning: ranges of settings by controller.
        metrics: all metrics of the problem's runs.
        pictures: further pictures for the report.
    """

    _LOADED: ClassVar[str] = "fp.load_problem({})"
    """How a value of a name or a file is written, with the name as {}: for who gives the name alone."""

    name: str
    path: Path
    title: str
    description: str
    problem: Problem
    controllers: Mapping[str, Controller]
    headline: tuple[str, str] | None = None
    tuning: Mapping[str, TuningSpans] = field(default_factory=dict)
    metrics: Sequence[Metric] = field(default_factory=known_metrics)
    pictures: tuple[Picture, ...] = ()

    def __post_init__(self) -> None:
        if self.problem.name != self.name:
            object.__setattr__(self, "problem", replace(self.problem, name=self.name))
        named = {name: named_in_task(controller, name) for name, controller in self.controllers.items()}
        object.__setattr__(self, "controllers", named)
        super().__post_init__()

    def __repr__(self) -> str:
        return line(self, self.name, self.title, f"{len(self.controllers)} controllers")

    def _repr_html_(self) -> str:
        """The controllers as a table, for notebooks."""
        pair = dict(zip(self.headline or (), ("without adaptation", "with adaptation"), strict=False))
        rows = [
            (name, type(one).__name__, type(one.deformation).__name__, pair.get(name, ""))
            for name, one in self.controllers.items()
        ]
        notes = [*self.description.split("\n\n")[:1], f"Problem: {', '.join(problem_facts(self.problem))}."]
        return table(f"{self.name}: {self.title}", ("controller", "kind", "deformation", "headline"), rows, notes)


@checked_call
def load_problem(name_or_path: str) -> Task:
    """Import a problem file and check its definitions.

    Raises:
        ProblemFileError: the file raises an error on import (the message shows the line), or a definition is missing or wrong.
    """
    path = find_problem(name_or_path)
    module = imported(path)
    mistakes = Mistakes(f"problem file '{path.name}'")
    problem, controllers = _problem(module, mistakes), _controllers(module, mistakes)
    headline = _headline(module, controllers, mistakes)
    tuning, own = getattr(module, "tuning", {}), getattr(module, "metrics", ())
    if not isinstance(own, Sequence) or not all(isinstance(metric, Metric) for metric in own):
        mistakes.add(
            f"{_at(module, 'metrics')}metrics must be a sequence of fpirhc.Metric, metrics = (fpirhc.Metric(...),)"
        )
    pictures = getattr(module, "pictures", ())
    if not isinstance(pictures, Sequence):
        mistakes.add(f"{_at(module, 'pictures')}expected a sequence of pictures, got {described(pictures)}")
        pictures = ()
    _check_pictures(tuple(pictures), controllers, mistakes)
    if not isinstance(tuning, Mapping):
        expected = "{'controller': {'deformation.gain': Span(low, high)}}"
        mistakes.add(f"{_at(module, 'tuning')}expected {expected}, got {described(tuning)}")
    try:
        mistakes.raise_if_any()
        check_tuning(tuning, controllers)
        metrics = with_own_metrics(own)
    except FpirhcError as error:
        raise ProblemFileError(str(error)) from None
    assert problem is not None
    title, _, description = (module.__doc__ or path.stem).strip().partition("\n")
    return Task(
        path.stem, path, title, description.strip(), problem, controllers, headline, tuning, metrics, tuple(pictures)
    )


def _problem(module: ModuleType, mistakes: Mistakes) -> Problem | None:
    problem = getattr(module, "problem", None)
    if isinstance(problem, Problem):
        return problem
    others = [name for name, value in vars(module).items() if isinstance(value, Problem)]
    named = f"; '{others[0]}' is one, so call it 'problem'" if others else ""
    outside = ", outside every function"
    got = f", got {described(problem)}" if hasattr(module, "problem") else "" if others else outside
    mistakes.add(f"{_at(module, 'problem')}it must define problem = fpirhc.Problem(...){got}{named}")
    return None


def _controllers(module: ModuleType, mistakes: Mistakes) -> Mapping[str, Controller]:
    controllers = getattr(module, "controllers", None)
    where = _at(module, "controllers")
    if not isinstance(controllers, Mapping) or not controllers:
        got = f", got {described(controllers)}" if hasattr(module, "controllers") else _called_otherwise(module)
        mistakes.add(f"{where}it must define controllers = {{'name': fpirhc.ComputedTorque(...), ...}}{got}")
        return {}
    for name, controller in controllers.items():
        if not isinstance(name, str) or not name:
            mistakes.add(f"{where}the name of a controller must be a text, got {described(name)}")
        if not isinstance(controller, Controller):
            mend = f"; write {call_of(controller)}" if isinstance(controller, type) else ""
            mistakes.add(f"{where}controllers['{name}'] must be a controller, got {described(controller)}{mend}")
    return controllers


def _called_otherwise(module: ModuleType) -> str:
    """A mapping of controllers under another name."""
    for name, value in vars(module).items():
        if isinstance(value, Mapping) and value and all(isinstance(one, Controller) for one in value.values()):
            return f"; '{name}' is such a mapping, so call it 'controllers'"
    return ""


def _headline(module: ModuleType, controllers: Mapping[str, Controller], mistakes: Mistakes) -> tuple[str, str] | None:
    headline = getattr(module, "headline", None)
    if headline is None:
        return None
    if not isinstance(headline, Sequence) or isinstance(headline, str) or len(headline) != 2:
        mistakes.add(
            f"{_at(module, 'headline')}headline must be a pair of names (without adaptation, with), got {described(headline)}"
        )
        return None
    mistakes.unknown(f"{_at(module, 'headline')}headline: controller", headline, controllers)
    return headline[0], headline[1]


def _check_pictures(pictures: tuple[object, ...], controllers: Mapping[str, object], mistakes: Mistakes) -> None:
    for picture in pictures:
        if not isinstance(picture, Picture):
            mistakes.add(f"pictures must hold pictures such as Portrait(...), got {picture!r}")
        else:
            mistakes.unknown(f"picture '{picture.title}': controller", picture.controllers, controllers)
