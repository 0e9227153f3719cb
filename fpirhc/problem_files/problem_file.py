"""Problem files: a shipped one is found by its name, a user's one by its path."""

from __future__ import annotations

import ast
import contextlib
import json
import sys
import textwrap
import traceback
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import named_in_task, without_deformation
from fpirhc.describe import describe, identity
from fpirhc.errors import FpirhcError, InvalidField, InvalidName, Mistakes, NotSupported, ProblemFileError
from fpirhc.fields.checked import FoundByName, checked_call, mistakes_in
from fpirhc.fields.kinds import accepts, expected_by
from fpirhc.fields.user_code import explained
from fpirhc.problem_files.settings import (
    TuningSpans,
    current_setting,
    is_own,
    number_of_case,
    of_problem,
    with_numbers,
    with_settings,
)
from fpirhc.problem_files.shipped import find_problem
from fpirhc.simulation.metrics import RELATIVE_ERROR, Metric, known_metrics, with_own_metrics
from fpirhc.simulation.pictures import Picture
from fpirhc.summary import line
from fpirhc.task.cases import Cases, as_declared
from fpirhc.task.problem import Problem


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

    _WRITTEN: ClassVar[str] = "fp.load_problem({})"
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

    @property
    def place(self) -> str:
        """File and line of the problem, "arm.py, line 12: "; empty where there is no file."""
        line = _line_of(self.path, "problem") if self.path.is_file() else ""
        return f"{self.path.name}, {line}" * bool(line)

    def __repr__(self) -> str:
        return line(self, self.name, self.title, f"{len(self.controllers)} controllers")


@checked_call
def load_problem(name_or_path: str | Path) -> Task:
    """Import a problem file and check its definitions.

    A problem file defines `problem` (a Problem) and `controllers` ({name: Controller}). The first line of its docstring is its
    title.
    It may also define

    - `headline`, a pair (controller without adaptation, the same one with it) for the verdict,
    - `cases`, a `Cases`: named cases for `fpirhc study --cases`,
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
    try:
        mistakes = Mistakes(f"problem file '{path.name}'")
        facts = _defined(module, mistakes)
        mistakes.raise_if_any()
        _check_together(module, facts, mistakes)
        mistakes.raise_if_any()
    except FpirhcError as error:
        raise ProblemFileError(str(error)) from None
    title, _, description = (module.__doc__ or path.stem).strip().partition("\n")
    return Task(path.stem, path, title, description.strip("\n"), **facts)


_RHC = "{'RHC': fpirhc.RecedingHorizon(fpirhc.FixedPointSolver()), ...}"
_NEEDED = {"problem": "fpirhc.Problem(...)", "controllers": _RHC}
_KINDS = {
    "problem": expected_by(Problem),
    "controllers": expected_by(Mapping[str, Controller]),
    "headline": expected_by(tuple[str, str]),
    "tuning": expected_by(Mapping[str, TuningSpans]),
    "metrics": expected_by(Sequence[Metric]),
    "pictures": expected_by(Sequence[Picture]),
    "cases": expected_by(Cases),
    "headline_metric": expected_by(str),
}


def _defined(module: ModuleType, mistakes: Mistakes) -> dict[str, Any]:
    """What a file defines for its task, by name, with the mistakes in each value by itself."""
    facts = {name: value for name in _KINDS if (value := getattr(module, name, None)) is not None}
    for name, form in _NEEDED.items():
        if name not in facts or (isinstance(facts[name], Mapping) and not facts[name]):
            others = [other for other, value in vars(module).items() if accepts(_KINDS[name], value) and value]
            mend = f"; '{others[0]}' is one, so call it '{name}'" if others else ", outside every function"
            mistakes.add(f"it must define {name} = {form}{mend}")
    for name, value in facts.items():
        for mistake in mistakes_in(_KINDS[name], name, value):
            mistakes.add(f"{_line_of(module, name)}{mistake}")
    return {n: tuple(value) if n in ("headline", "pictures") else value for n, value in facts.items()}


def _check_together(module: ModuleType, facts: dict[str, Any], mistakes: Mistakes) -> None:
    """Add the mistakes of values that do not fit each other; the metrics become all those of the problem."""
    controllers, headline = facts["controllers"], facts.get("headline", ())
    where = _line_of(module, "headline") if headline else ""
    mistakes.unknown(f"{where}headline: controller", headline, controllers)
    pairs = [(pair_of(controllers, name), name) for name, one in controllers.items() if one.deformation.adapts]
    if headline and not mistakes and headline not in pairs:
        mend = ", ".join(str(pair) for pair in pairs if pair[0]) or "none is here, so leave headline out"
        told = (json.dumps(describe(without_deformation(controllers[n])), indent=1).split("\n") for n in headline)
        two = next(((a.strip(" ,"), b.strip(" ,")) for a, b in zip(*told, strict=False) if a != b), ())
        mend = f"{' against '.join(two)}{'; ' * bool(two)}{mend}"
        mistakes.add(f"{where}headline {headline} is no pair of a controller and the same one with adaptation: {mend}")
    for picture in facts.get("pictures", ()):
        mistakes.unknown(f"picture '{picture.title}': controller", picture.controllers, controllers)
    spans = facts.get("tuning", {})
    mistakes.unknown("tuning: controller", spans, controllers)
    for owner in (name for name in spans if name in controllers):
        for path in spans[owner]:
            word, own = path.partition(".")[0], controllers[owner]
            with mistakes.caught(f"tuning: controller '{owner}': "):
                if not is_own(own, path) and number_of_case(facts["problem"], path) is not None:
                    mend = f"; give this one its own, {word}=problem.{word}" if hasattr(own, word) else ""
                    raise InvalidName(f"setting '{path}' is the problem's; a search changes controllers alone{mend}")
                current_setting(own, path)
    with mistakes.caught():
        facts["metrics"] = with_own_metrics(facts.get("metrics", ()))
        names = [RELATIVE_ERROR, *(metric.name for metric in facts["metrics"])]
        main = facts.get("headline_metric", RELATIVE_ERROR)
        if not any(f"{main}.".startswith(f"{name}.") for name in names):
            mistakes.unknown(f"{_line_of(module, 'headline_metric')}metric", [main], names)
    if "cases" in facts:
        with mistakes.caught():
            facts["cases"].check(facts["problem"])


def pair_of(controllers: Mapping[str, Controller], name: str) -> str | None:
    """Return the controller with the same settings and no adaptation; None without one."""
    try:
        wanted = without_deformation(controllers[name])
    except NotSupported:
        return None
    plain = {n: c for n, c in controllers.items() if not c.deformation.adapts}
    # One whose formulas are the same too comes before one whose settings are.
    return next((n for said in (identity, describe) for n, c in plain.items() if said(c) == said(wanted)), None)


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
    shared = {path for path in values if of_problem(path)}
    read = {path: values[path] for path in shared if not chosen or not all(is_own(c, path) for c in chosen.values())}
    problem, controllers = with_numbers(task.problem, read), dict(task.controllers)
    lacked: dict[str, list[InvalidName]] = {path: [] for path in values}
    for name, controller in chosen.items():
        own: dict[str, Any] = {}
        for path in (path for path in values if path not in shared or is_own(controller, path)):
            try:
                current_setting(controller, path)
                own[path] = as_declared(controller, path, values[path])
            except InvalidName as error:
                lacked[path].append(error)
        controllers[name] = with_settings(controller, own)
    for path, errors in lacked.items():
        if chosen and len(errors) == len(chosen):
            if (name := path.partition(".")[0]) in task.problem.moves.parameters:
                mend = f"write exact.{name} for the plant, approximate.{name} for the model"
                raise InvalidName(f"setting '{path}': {mend}")
            raise max(errors, key=lambda error: str(error).partition("Did you mean")[2].count("'"))
    return replace(task, problem=problem, controllers=controllers)


def _imported(path: Path) -> ModuleType:
    """Return the module of a problem file."""
    module = ModuleType(f"fpirhc_problem_{path.stem}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module
    try:
        with _neighbours(path):
            # Bytecode would be that of the last second: it is told apart by the file's size and whole seconds.
            exec(compile(path.read_bytes(), str(path), "exec", dont_inherit=True), vars(module))
    except SyntaxError as error:
        source, name = (error.text or "").strip(), Path(error.filename or path).name
        raise ProblemFileError(f"{name}, line {error.lineno}: {error.msg}\n    {source}") from None
    except SystemExit as error:
        raise _at_its_line(path, error, "the file ends the program; leave the exit out") from None
    except Exception as error:  # noqa: BLE001 -- every error of a user's file is shown with its line
        raise _at_its_line(path, error, _cause_of(error)) from None
    return module


def _line_of(module: ModuleType | Path, name: str) -> str:
    """Return "line 12: " of the last assignment of a name in a module's file; empty where there is none."""
    tree = ast.parse(Path(getattr(module, "__file__", module)).read_bytes())
    assigned = (one for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign) for one in ast.walk(node))
    names = [one for one in assigned if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store)]
    lines = [one.lineno for one in names if one.id == name]
    return f"line {lines[-1]}: " if lines else ""


@contextlib.contextmanager
def _neighbours(path: Path) -> Iterator[None]:
    """Let a file import the modules beside it after libraries; they are forgotten, as another folder has others of the name."""
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


def _at_its_line(path: Path, error: BaseException, cause: str) -> ProblemFileError:
    """Return the error "file.py, line 12: source" of the innermost line of the file, with the cause below it."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if Path(f.filename).resolve() == path.resolve()]
    place = f"{path.name}, line {frames[-1].lineno}: {frames[-1].line}" if frames else path.name
    return ProblemFileError(f"{place}\n{textwrap.indent(cause, '    ')}")


def _cause_of(error: Exception) -> str:
    """What an error says, without the place, and with what to write instead."""
    if isinstance(error, InvalidField):
        return textwrap.dedent(str(InvalidField(error.mistakes)).strip("\n"))
    if isinstance(error, FpirhcError):
        return str(error)
    cause = explained(error)
    if not cause.startswith(type(error).__name__):
        return cause
    # Python's own last line also has the nearest name that it knows.
    return "".join(traceback.TracebackException.from_exception(error).format_exception_only()).strip()
