"""Problem files: a shipped one is found by its name, a user's one by its path."""

from __future__ import annotations

import ast
import contextlib
import importlib.util
import linecache
import sys
import textwrap
import traceback
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import named_in_task
from fpirhc.errors import FpirhcError, InvalidField, InvalidName, Mistakes, ProblemFileError, nearest
from fpirhc.fields.checked import FoundByName, checked_call
from fpirhc.fields.kinds import call_of, described
from fpirhc.fields.user_code import explained
from fpirhc.problem_files.pairs import not_a_pair
from fpirhc.problem_files.settings import (
    TuningSpans,
    as_declared,
    check_tuning,
    current_setting,
    is_own,
    of_problem,
    with_numbers,
    with_settings,
)
from fpirhc.problem_files.shipped import find_problem
from fpirhc.simulation.metrics import RELATIVE_ERROR, Metric, known_metrics, with_own_metrics
from fpirhc.simulation.pictures.base import Picture
from fpirhc.summary import line, table
from fpirhc.task.cases import Cases
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
        cases: named cases of the problem; None: there are none.
        headline_metric: number by which controllers are compared and tuned; None: the relative error.
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
    cases: Cases | None = None
    headline_metric: str | None = None

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
def load_problem(name_or_path: str | Path) -> Task:
    """Import a problem file and check its definitions.

    A problem file defines `problem` (a Problem) and `controllers` ({name: Controller}). The first line of its docstring is its
    title.
    It may also define

    - `headline`, a pair (controller without adaptation, the same one with it) for the verdict,
    - `cases`, a `Cases`: named cases for `fpirhc compare --cases`,
    - `headline_metric`, the name of the number by which controllers are compared and tuned, 'in_band' or 'rms_error.q1',
    - `tuning`, {controller: {path of a setting: Span or LogSpan}}, the ranges in which `fpirhc tune` searches,
    - `metrics`, a sequence of `Metric` for all tables, files and baselines of the problem, in addition to the shipped ones,
    - `pictures`, a sequence of pictures for the report, in addition to the usual ones,
    - `why`, a sentence about why the best controller is the best, for the page of all shipped problems,
    - `keeps_rule`, a tuple of the names of the controllers that keep the problem's own rule, where not all do, for the same page.

    Args:
        name_or_path: name of a shipped problem, or path of a file.

    Raises:
        ProblemFileError: the file raises an error on import (the message shows the line), or a definition is missing or wrong.
    """
    path = find_problem(str(name_or_path))
    module = _imported(path)
    mistakes = Mistakes(f"problem file '{path.name}'")
    problem, controllers = _problem(module, mistakes), _controllers(module, mistakes)
    headline = _headline(module, controllers, mistakes)
    tuning, own = getattr(module, "tuning", {}), getattr(module, "metrics", ())
    if not isinstance(own, Sequence) or not all(isinstance(metric, Metric) for metric in own):
        mistakes.add(
            f"{_line_of(module, 'metrics')}metrics must be a sequence of fpirhc.Metric, metrics = (fpirhc.Metric(...),)"
        )
    main = getattr(module, "headline_metric", None)
    if main is not None and not isinstance(main, str):
        mistakes.add(f"{_line_of(module, 'headline_metric')}expected the name of a metric, got {described(main)}")
    cases = getattr(module, "cases", None)
    if cases is not None and not isinstance(cases, Cases):
        form = "cases = fpirhc.Cases({'heavy': {'exact.mass': 2.0}})"
        mistakes.add(f"{_line_of(module, 'cases')}expected {form}, got {described(cases)}")
    pictures = getattr(module, "pictures", ())
    if not isinstance(pictures, Sequence):
        mistakes.add(f"{_line_of(module, 'pictures')}expected a sequence of pictures, got {described(pictures)}")
        pictures = ()
    _check_pictures(tuple(pictures), controllers, mistakes)
    if not isinstance(tuning, Mapping):
        expected = "{'controller': {'deformation.gain': Span(low, high)}}"
        mistakes.add(f"{_line_of(module, 'tuning')}expected {expected}, got {described(tuning)}")
    try:
        mistakes.raise_if_any()
        check_tuning(tuning, controllers)
        metrics = with_own_metrics(own)
        if (
            main is not None
            and main != RELATIVE_ERROR
            and not any(f"{main}.".startswith(f"{m.name}.") for m in metrics)
        ):
            known = nearest(main, [RELATIVE_ERROR, *(m.name for m in metrics)])
            raise InvalidName(f"{_line_of(module, 'headline_metric')}metric '{main}' is unknown.{known}")
        assert problem is not None
        if cases is not None:
            cases.check(problem)
    except FpirhcError as error:
        raise ProblemFileError(str(error)) from None
    title, _, description = (module.__doc__ or path.stem).strip().partition("\n")
    facts = (problem, controllers, headline, tuning, metrics, tuple(pictures), cases, main)
    return Task(path.stem, path, title, description.strip(), *facts)


def in_case(task: Task, name: str) -> Task:
    """Return the task with the problem in one of its cases."""
    if task.cases is None:
        raise InvalidName(f"problem '{task.name}' has no cases; add cases = fpirhc.Cases({{...}}) to its file")
    return replace(task, problem=task.cases.problem(name, task.problem))


def with_numbers_of_all(task: Task, values: Mapping[str, Any], names: Collection[str] | None = None) -> Task:
    """Return the task with other numbers: of every named controller that has the setting, and else of the problem.

    A number that a controller and the problem have is the controller's own; for the others it is the problem's.

    Args:
        names: of controllers; None: all.
    """
    chosen = {name: one for name, one in task.controllers.items() if not names or name in names}
    shared = {path for path in values if of_problem(task.problem, path)}
    read = {path for path in shared if not chosen or not all(is_own(one, path) for one in chosen.values())}
    problem, controllers = with_numbers(task.problem, {path: values[path] for path in values if path in read}), {}
    lacking: dict[str, list[InvalidName]] = {path: [] for path in values if path not in shared}
    for name, controller in chosen.items():
        has = {path: values[path] for path in shared if is_own(controller, path)}
        for path, lacked in lacking.items():
            try:
                current_setting(controller, path)
                has[path] = values[path]
            except InvalidName as error:
                lacked.append(error)
        controllers[name] = with_settings(controller, as_declared(controller, has))
    for path, lacked in lacking.items():
        if chosen and len(lacked) == len(chosen):
            if path in task.problem.moved.parameters:
                raise InvalidName(
                    f"setting '{path}': write exact.{path} for the plant, approximate.{path} for the model"
                )
            raise max(lacked, key=lambda error: "Did you mean" in str(error))
    return replace(task, problem=problem, controllers={**task.controllers, **controllers})


def _problem(module: ModuleType, mistakes: Mistakes) -> Problem | None:
    problem = getattr(module, "problem", None)
    if isinstance(problem, Problem):
        return problem
    others = [name for name, value in vars(module).items() if isinstance(value, Problem)]
    named = f"; '{others[0]}' is one, so call it 'problem'" if others else ""
    outside = ", outside every function"
    got = f", got {described(problem)}" if hasattr(module, "problem") else "" if others else outside
    mistakes.add(f"{_line_of(module, 'problem')}it must define problem = fpirhc.Problem(...){got}{named}")
    return None


def _controllers(module: ModuleType, mistakes: Mistakes) -> Mapping[str, Controller]:
    controllers = getattr(module, "controllers", None)
    where = _line_of(module, "controllers")
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
            f"{_line_of(module, 'headline')}headline must be a pair of names (without adaptation, with), got {described(headline)}"
        )
        return None
    pair, line = (headline[0], headline[1]), _line_of(module, "headline")
    if controllers:  # else that there are none is the mistake
        mistakes.unknown(f"{line}headline: controller", pair, controllers)
    if mistakes.none and (wrong := not_a_pair(controllers, pair)):
        mistakes.add(f"{line}{wrong}")
    return pair


def _check_pictures(pictures: tuple[object, ...], controllers: Mapping[str, object], mistakes: Mistakes) -> None:
    for picture in pictures:
        if not isinstance(picture, Picture):
            mistakes.add(f"pictures must hold pictures such as Portrait(...), got {picture!r}")
        else:
            mistakes.unknown(f"picture '{picture.title}': controller", picture.controllers, controllers)


def _imported(path: Path) -> ModuleType:
    """Return the module of a problem file."""
    module = _empty(path)
    try:
        with _neighbours(path):
            # Bytecode would be that of the last second: it is told apart by the file's size and whole seconds.
            exec(compile(path.read_bytes(), str(path), "exec", dont_inherit=True), vars(module))
    except SyntaxError as error:
        source, name = (error.text or "").strip(), Path(error.filename or path).name
        raise ProblemFileError(f"{name}, line {error.lineno}: {error.msg}\n    {source}") from None
    except SystemExit as error:
        raise ProblemFileError(_message(path, error, "the file ends the program; leave the exit out")) from None
    except Exception as error:  # noqa: BLE001 -- every error of a user's file is shown with its line
        raise ProblemFileError(_message(path, error, _cause_of(error))) from None
    return module


def _line_of(module: ModuleType, name: str) -> str:
    """Return "line 12: " of the last assignment of a name in a module's file; empty where there is none."""
    try:
        tree = ast.parse(Path(module.__file__ or "").read_text(encoding="utf-8"))
    except (OSError, SyntaxError, ValueError):
        return ""
    lines = [
        target.lineno
        for node in tree.body
        for target in (node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)])
        if isinstance(target, ast.Name) and target.id == name
    ]
    return f"line {lines[-1]}: " if lines else ""


def _empty(path: Path) -> ModuleType:
    """The module of a file before its first line."""
    spec = importlib.util.spec_from_file_location(f"fpirhc_problem_{path.stem}", path)
    if spec is None:
        raise ProblemFileError(f"'{path}' is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    return module


@contextlib.contextmanager
def _neighbours(path: Path) -> Iterator[None]:
    """Let a file import the modules beside it, as a program can; libraries come first.

    The modules are forgotten afterwards: another folder may have others of the same name.
    """
    folder, before = str(path.resolve().parent), set(sys.modules)
    sys.path.append(folder)
    try:
        yield
    finally:
        sys.path.remove(folder)
        for name in set(sys.modules) - before:
            file = getattr(sys.modules[name], "__file__", None)
            if file and Path(file).parent == Path(folder) and not name.startswith("fpirhc_problem_"):
                del sys.modules[name]


def _message(path: Path, error: BaseException, cause: str) -> str:
    """Return "file.py, line 12: source" of the innermost line of the file in the traceback, and the cause below it."""
    line = _line(path, error)
    return f"{_place(path, line) if line else path.name}\n{_indented(cause)}"


def _indented(cause: str) -> str:
    return textwrap.indent(cause, "    ")


def _cause_of(error: Exception) -> str:
    """What an error says, without the place, and with what to write instead."""
    if isinstance(error, InvalidField):
        return textwrap.dedent(error.text.strip("\n"))
    if isinstance(error, FpirhcError):
        return str(error)
    cause = explained(error)
    if not cause.startswith(type(error).__name__):
        return cause
    # Python's own last line also has the nearest name that it knows.
    return "".join(traceback.TracebackException.from_exception(error).format_exception_only()).strip()


def _line(path: Path, error: BaseException) -> int | None:
    """The innermost line of the file in the traceback."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if Path(f.filename).resolve() == path.resolve()]
    return frames[-1].lineno if frames else None


def _place(path: Path, line: int) -> str:
    return f"{path.name}, line {line}: {linecache.getline(str(path), line).strip()}"
