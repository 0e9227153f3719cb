"""Named cases of a problem: under each name, what is different from the problem there.

A path says what a case changes: 'exact.NAME', 'approximate.NAME' and 'known.NAME' a parameter, 'start.NAME' the first value of a
state, and any other one a field of the problem or a number inside it, 'limits.inputs.Q1.1', 'dead_time.measurement', 'reality'.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar, cast

import numpy as np

from fpirhc.errors import FpirhcError, InvalidName, InvalidProblem, InvalidValue, Mistakes, nearest
from fpirhc.fields.checked import Checked, checked_call, expects_whole_number
from fpirhc.fields.kinds import described, finite_number
from fpirhc.fields.user_code import users_folder
from fpirhc.plant.plant import Parametric
from fpirhc.summary import line
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.paths import changed_at, content_at
from fpirhc.task.problem import Problem

EVERY = "all"  # the pattern of every case
_GROUP, _SEED, _CASE = "group", "seed", "case"  # what a case has beside its changes; the column of the names
_EXACT, _APPROXIMATE, _KNOWN, START = "exact", "approximate", "known", "start"
PARAMETERS = {
    _EXACT: "what moves",
    _APPROXIMATE: "what the controllers know",
    _KNOWN: "both: what moves has it, and the controllers know it",
}
# Fields of a problem that no path begins with: parameters and the start have words of their own.
_OWN = ("plant", "start", "name")


@dataclass(frozen=True, eq=False)
class Cases(Checked):
    """Named cases of one problem; every controller of a comparison runs in every case.

        cases = fp.Cases({"heavy": {"exact.mass": 2.0, "start.angle": 0.3}, "late": {"dead_time.measurement": 0.01}})
        cases = fp.Cases.from_csv("patients.csv")

    A run in a case is that of `problem(name, ...)`. A gain beyond its limit there is refused in a single run; a comparison shows
    what it does. Controllers know of a case's changes as of everything in a problem, except exact parameters and the reality.

    Args:
        changes: by name of the case and path. The path is 'exact.NAME' (the parameter of what moves), 'approximate.NAME' (of the
            controllers' model), 'known.NAME' (of both), 'start.NAME', or begins with another field of the problem: 'reference',
            'reality', 'signals', 'dead_time.inputs.Q1', 'limits.inputs.Q1' (a pair) or 'limits.inputs.Q1.1' (its upper end).
            'group' is a text by which cases are summed up, 'seed' the seed of the case's noise.
        places: where cases stand in a file, by name, for messages.

    Raises:
        InvalidProblem: all mistakes together: no case, a name that is no text, changes that are no mapping, a wrong group or seed,
            a number that a case sets twice.
    """

    _where: ClassVar[str] = "cases"  # first words of a message

    changes: Mapping[str, Mapping[str, object]]
    places: Mapping[str, str] = field(default_factory=dict, kw_only=True, metadata={"setting": False})

    def __post_init__(self) -> None:
        mistakes = Mistakes(self._where)
        if not self.changes:
            mistakes.add('there is none; expected {"heavy": {"exact.mass": 2.0}}')
        for name, changes in self.changes.items():
            for why in _form(name, changes):
                mistakes.add(f"{self._place(name)}: {why}")
        mistakes.raise_if_any()

    def __repr__(self) -> str:
        groups = tuple(dict.fromkeys(filter(None, map(self.group, self.names))))
        return line(self, f"{len(self.names)} cases", *([f"groups {', '.join(groups)}"] if groups else []))

    @classmethod
    @checked_call
    def from_csv(
        cls,
        path: str | Path,
        *,
        needed: Sequence[str] = (),
        words: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
        bounds: Mapping[str, tuple[float, float]] = MappingProxyType({}),
    ) -> Cases:
        """Return the cases of a table: a row each, named in the column 'case', with a path as the head of every other column.

        Cells hold numbers; where one is empty, the case leaves the problem as it is. There may be columns 'group' and 'seed'. A
        line that begins with '#' is a remark.

        Args:
            path: of the file; a relative one begins at the folder of the file that calls this.
            needed: heads of columns that must be there, filled in every row.
            words: by head of a column, the words of its cells and the number that each means: {"exact.sex": {"m": 0, "f": 1}}.
            bounds: by head of a column, the least and the largest number of its cells, for a file that computes with them before
                a problem checks them.

        Raises:
            InvalidProblem: the file cannot be read, or all mistakes in its form together, each with row and column.
        """
        place = Path(path)
        return _read(cls, place if place.is_absolute() else users_folder() / place, needed, words, bounds)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cases."""
        return tuple(self.changes)

    def group(self, name: str) -> str:
        """Return the group of a case; '' where it has none."""
        return str(self.changes[name].get(_GROUP, ""))

    def seed(self, name: str) -> int | None:
        """Return the seed of a case's noise; None where the study chooses it."""
        return cast(int | None, self.changes[name].get(_SEED))

    @checked_call
    def matching(self, patterns: Sequence[str]) -> tuple[str, ...]:
        """Return the names of the cases that a pattern names, in their order: 'all', 'adult*', or the pattern of a group.

        Raises:
            InvalidName: a pattern without a case.
        """
        texts = {name: (name, self.group(name)) for name in self.names}
        matching: set[str] = set()
        for pattern in patterns:
            new = {n for n, own in texts.items() if pattern == EVERY or any(fnmatchcase(t, pattern) for t in own if t)}
            if not new:
                valid = dict.fromkeys((EVERY, *filter(None, map(self.group, self.names)), *self.names))
                raise InvalidName(f"no case matches '{pattern}'.{nearest(pattern, valid)}")
            matching |= new
        return tuple(name for name in self.names if name in matching)

    @checked_call
    def problem(self, name: str, problem: Problem) -> Problem:
        """Return the problem in a case.

        Raises:
            InvalidName: an unknown case.
            InvalidProblem: a change that the problem does not accept.
        """
        return self.exactly(name, self.build(name, problem))

    def build(self, name: str, problem: Problem) -> Problem:
        """Return the problem with all changes of a case but those of exact parameters, which are data of a loop.

        Whichever case is asked first, the mistakes of all are told together.
        """
        if name not in self.changes:
            raise InvalidName(f"case '{name}' is unknown.{nearest(name, self.names)}")
        _CHECKED.of((self, problem), (), lambda: self.check(problem))
        try:
            return _changed(problem, self.changes[name])
        except FpirhcError as error:
            raise InvalidProblem(f"{self._place(name)}: {error}") from None

    def exactly(self, name: str, built: Problem) -> Problem:
        """Return what `build` returned, with the exact parameters of a case."""
        before = {name: one.exact for name, one in built.moved.parameters.items()}
        exact = {**before, **_exact_of(self.changes[name], before)}
        if exact == before:
            return built
        try:
            return built.with_exact(np.array(list(exact.values())))
        except FpirhcError as error:
            raise InvalidProblem(f"{self._place(name)}: {error}") from None

    def key(self, name: str, data: Container[str] = ()) -> tuple[object, ...]:
        """Return what decides the build of a case; cases with equal keys have one build.

        Args:
            name: of the case.
            data: paths whose contents are data of the build.
        """
        return tuple(
            (path, value if isinstance(value, int | float | str) else id(value))
            for path, value in sorted(self.changes[name].items())
            if path not in (_GROUP, _SEED) and path not in data and not path.startswith(f"{_EXACT}.")
        )

    def numbers(self, problem: Problem) -> tuple[str, ...]:
        """Return the paths of numbers of the problem, or of intervals, that some case changes and that may be live.

        A dead time may where the problem states its longest one.
        """
        paths = dict.fromkeys(path for changes in self.changes.values() for path in changes)
        inside = [path for path in paths if "." in path and _word(path) not in _WORDS]
        queued = problem.dead_time.longest
        roomy = [path for path in inside if _word(path) != "dead_time" or path.rpartition(".")[2] in queued]
        return tuple(path for path in roomy if _finite(_content(problem, path)))

    def check(self, problem: Problem) -> None:
        """Raise where a path or a number does not fit the problem.

        Raises:
            InvalidProblem: all mistakes together, each with its case and path, or its row and column.
        """
        mistakes, unknown = Mistakes(self._where), set[str]()
        for name, changes in self.changes.items():
            for path in (p for p in changes if p not in (*unknown, _GROUP, _SEED)):
                try:
                    _check_change(problem, changes, path)
                except InvalidName as error:  # a wrong path is one mistake, in however many cases it stands
                    unknown.add(path)
                    mistakes.add(f"{self._place(name, path, head=True)}: {error}")
                except FpirhcError as error:
                    mistakes.add(f"{self._place(name, path)}: {error}")
        mistakes.raise_if_any()

    def _place(self, name: str, path: str = "", *, head: bool = False) -> str:
        """Where a case stands, or one of its numbers: by name and path, or by row and column of a file."""
        row = self.places.get(name, "")
        if not row:
            return f"case {name!r}" + (f", {path!r}" if path else "")
        return (row.partition(",")[0] if head else f"{row} ({name})") + (f", column '{path}'" if path else "")


_CHECKED: Latest[None] = Latest(8)  # cases with the problem that they fit


def _changed(problem: Problem, changes: Mapping[str, object]) -> Problem:
    """The problem with all changes but those of exact parameters."""
    of_fields = {path: value for path, value in changes.items() if _word(path) not in (*_WORDS, _GROUP, _SEED)}
    for path, value in _joined(problem, of_fields).items():
        problem = changed_at(problem, path, _number_of(problem, path, value))
    model = {name: value for word in (_APPROXIMATE, _KNOWN) for name, value in _named(changes, word).items()}
    start = _named(changes, START)
    if model:
        parameters = {
            name: replace(one, approximate=float(model[name])) if name in model else one
            for name, one in problem.plant.parameters.items()
        }
        problem = replace(problem, plant=replace(problem.plant, parameters=parameters))
    return replace(problem, start={**problem.start, **start}) if start else problem


def _joined(problem: Problem, changes: Mapping[str, object]) -> dict[str, object]:
    """The changes with both ends of an interval as one, because one of them may be valid with the other alone."""
    joined: dict[str, object] = {}
    for path, value in changes.items():
        parent, _, place = path.rpartition(".")
        both = f"{parent}.0" in changes and f"{parent}.1" in changes and place in ("0", "1")
        if both and isinstance(content_at(problem, parent, "the problem"), tuple):
            joined[parent] = (changes[f"{parent}.0"], changes[f"{parent}.1"])
        else:
            joined[path] = value
    return joined


def _number_of(problem: Problem, path: str, value: object) -> object:
    """A number of a file as the field declares it."""
    parent, _, name = path.rpartition(".")
    owner = content_at(problem, parent, "the problem") if parent else problem
    whole = is_dataclass(owner) and expects_whole_number(type(owner), name)
    return int(value) if whole and isinstance(value, float) and value.is_integer() else value


def _word(path: str) -> str:
    return path.partition(".")[0]


def _named(changes: Mapping[str, object], word: str) -> dict[str, float]:
    """The numbers below a word, by the name behind it."""
    return {
        path.partition(".")[2]: cast(float, value) for path, value in changes.items() if path.startswith(f"{word}.")
    }


def _exact_of(changes: Mapping[str, object], moved: Container[str]) -> dict[str, float]:
    """The exact parameters that a case changes; what is known has its exact value where the plant that moves has it too."""
    known = {name: value for name, value in _named(changes, _KNOWN).items() if name in moved}
    return {name: float(value) for name, value in {**known, **_named(changes, _EXACT)}.items()}


def _form(name: str, changes: Mapping[str, object]) -> Iterator[str]:
    """What is wrong with a case whatever its problem is."""
    if not name.strip():
        yield "the name of a case is a text that is not empty"
    if name == EVERY:
        yield f"'{EVERY}' means every case; choose another name"
    group, seed = changes.get(_GROUP, ""), changes.get(_SEED)
    if not isinstance(group, str):
        yield f"'{_GROUP}' is a text, got {described(group)}"
    if seed is not None and (isinstance(seed, bool) or not isinstance(seed, int) or seed < 0):
        yield f"'{_SEED}' is a whole number of at least 0, got {described(seed)}"
    for path in changes:
        word, _, rest = path.partition(".")
        both = [f"{_KNOWN}.{rest}"] if word in (_EXACT, _APPROXIMATE) else []
        above = [path[:at] for at, mark in enumerate(path) if mark == "."]
        for other in (one for one in (*both, *above) if one in changes):
            yield f"'{other}' and '{path}' set the same number; leave one of them out"


def _check_change(problem: Problem, changes: Mapping[str, object], path: str) -> None:
    """Raise where one change does not fit."""
    word, _, name = path.partition(".")
    if word in _WORDS and not name:
        what = "state" if word == START else "parameter"
        raise InvalidName(f"'{word}' alone names no {what}; write one entry for each, '{word}.NAME'")
    if word == START:
        _check_name(f"'{START}.NAME' has a state", name, problem.plant.state.elements)
        _check_number(changes[path], problem.plant.ranges.get(name))
        return
    if word in PARAMETERS:
        settable = {n: one for n, one in _parametric(problem, changes, word).parameters.items() if not one.outside}
        if not settable and problem.foreign is not None and word == _EXACT:
            raise InvalidName(
                f"what moves is outside and has no parameter '{name}'; state it: "
                f"ExternalPlant(make=lambda parameters, seed: body, parameters={{'{name}': ...}})"
            )
        _check_name(f"'{word}.NAME' has a parameter of {PARAMETERS[word]}", name, settable)
        _check_number(changes[path], settable[name].bounds, settable[name].unit)
        return
    paths = [f.name for f in fields(problem) if f.name not in _OWN]
    if word not in paths:
        meant = _meant(problem, path.rpartition(".")[2]) or nearest(word, [*_WORDS, *paths])
        raise InvalidName(f"the problem has no '{path}'.{meant}")
    parent, _, last = path.rpartition(".")
    if parent == "dead_time.inputs" and last not in problem.dead_time.inputs:
        _check_name(f"'{parent}.NAME' has an input", last, problem.plant.inputs)
        stated = {**problem.dead_time.inputs, last: 0.0}
        raise InvalidName(
            f"the problem states no dead time of '{last}'; write dead_time=fp.DeadTime(inputs={stated}) there"
        )
    if isinstance(content_at(problem, path, "the problem"), int | float):
        _check_number(changes[path])


def _parametric(problem: Problem, changes: Mapping[str, object], word: str) -> Parametric:
    """Whose parameter a case changes; a case with a reality of its own means that one."""
    if word != _EXACT:
        return problem.plant
    return changed_at(problem, "reality", changes["reality"]).moved if "reality" in changes else problem.moved


def _meant(problem: Problem, path: str) -> str:
    """What to write for the name of a parameter, a state or an input alone."""
    if path in problem.plant.parameters or path in problem.moved.parameters:
        return (
            " It is a parameter: " + ", ".join(f"'{word}.{path}' is {what}" for word, what in PARAMETERS.items()) + "."
        )
    if path in problem.plant.state.elements:
        return f" It is a state: '{START}.{path}' is its first value."
    return f" It is an input: 'limits.inputs.{path}' are its limits." if path in problem.plant.inputs else ""


def _check_name(what: str, name: str, valid: Iterable[str]) -> None:
    names = list(valid)
    if name not in names:
        raise InvalidName(f"{what}, and there is no '{name}'.{nearest(name, names)}")


def _content(problem: Problem, path: str) -> object:
    try:
        return content_at(problem, path, "the problem")
    except InvalidName:
        return None


def _finite(content: object) -> bool:
    return all(map(finite_number, content)) if isinstance(content, tuple) else finite_number(content)


def _check_number(value: object, bounds: tuple[float, float] | None = None, unit: str = "") -> None:
    if not finite_number(value):
        raise InvalidValue(f"expected a finite number, got {described(value)}")
    low, high = bounds or (-math.inf, math.inf)
    if not low <= float(value) <= high:  # type: ignore[arg-type]  # it is a number
        raise InvalidValue(f"expected {low:g} to {high:g}{f' {unit}' if unit not in ('', '1') else ''}, got {value:g}")


def _read(
    make: Callable[..., Cases],
    path: Path,
    needed: Sequence[str],
    words: Mapping[str, Mapping[str, float]],
    bounds: Mapping[str, tuple[float, float]],
) -> Cases:
    """The cases of a file; places of mistakes are its rows and columns, counted from 1."""
    lines = _lines(path)
    mistakes = Mistakes(path.name)
    first, cells_of_head = lines[0] if lines else (1, [])
    head = [cell.strip() for cell in cells_of_head]
    _check_head(f"row {first}", head, needed, mistakes)
    if not lines[1:]:
        mistakes.add(f"row {first}: no row follows; expected one for every case")
    changes: dict[str, dict[str, object]] = {}
    places: dict[str, str] = {}
    for number, row in lines[1:]:
        cells = dict(zip(head, map(str.strip, row), strict=False))
        name = cells.pop(_CASE, "")
        if len(row) != len(head):
            mistakes.add(f"row {number}: it has {len(row)} cells, expected {len(head)}, one for every column")
        elif not name:
            mistakes.add(f"row {number}, column '{_CASE}': it is empty; expected the name of the case")
        elif name in changes:
            mistakes.add(f"row {number}, column '{_CASE}': '{name}' stands in {places[name].partition(', ')[2]} too")
        else:
            changes[name], places[name] = {}, f"{path.name}, row {number}"
            for column, cell in cells.items():
                try:
                    filled = cell or column in needed
                    changes[name] |= {column: _cell(column, cell, words.get(column))} if filled else {}
                    if filled and column in bounds:
                        _check_number(changes[name][column], bounds[column])
                except ValueError as error:
                    mistakes.add(f"row {number} ({name}), column '{column}': {error}")
    mistakes.raise_if_any()
    return make(changes, places=places)


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """The cells of a file by row, without remarks and empty rows."""
    try:
        text = path.read_bytes().decode("utf-8-sig")
        rows = list(csv.reader(io.StringIO(text, newline="")))
    except UnicodeDecodeError as error:
        row, byte = error.object[: error.start].count(b"\n") + 1, error.object[error.start]
        raise InvalidProblem(f"{path.name}: row {row}: expected text in UTF-8, got the byte 0x{byte:02x}") from None
    except (OSError, csv.Error) as error:
        raise InvalidProblem(f"cases: cannot read '{path}': {getattr(error, 'strerror', None) or error}") from None
    return [(k, row) for k, row in enumerate(rows, 1) if any(row) and not row[0].startswith("#")]


def _check_head(row: str, head: Sequence[str], needed: Sequence[str], mistakes: Mistakes) -> None:
    other = next((mark for mark in ";\t| " if head and _CASE in map(str.strip, head[0].split(mark))), "")
    if not head:
        mistakes.add(f"{row}: it is empty; expected '{_CASE}' and the heads of the other columns")
    elif other and _CASE not in head:
        mistakes.add(f"{row}: expected columns that are separated by commas, got {other!r}")
    mistakes.raise_if_any()
    if _CASE not in head:
        mistakes.add(f"{row}: there is no column '{_CASE}' with the names of the cases.{nearest(_CASE, head)}")
    for column in (c for c in needed if c not in head):
        mistakes.add(f"{row}: there is no column '{column}', which every case needs.{nearest(column, head)}")
    for column in dict.fromkeys(head):
        if not column or head.count(column) > 1:
            mistakes.add(
                f"{row}: column '{column}' stands {head.count(column)} times"
                if column
                else f"{row}: a column has no name"
            )
    mistakes.raise_if_any()


_FORMS = {
    _GROUP: (str, "the name of a group"),
    _SEED: (int, "a whole number of at least 0"),
}  # cells of other columns are numbers


def _cell(column: str, cell: str, words: Mapping[str, float] | None) -> object:
    if words is not None:
        if cell not in words:
            raise ValueError(f"expected {' or '.join(map(repr, words))}, got '{cell}'")
        return words[cell]
    form, what = _FORMS.get(column, (float, "a number, such as 3.5"))
    if not cell:  # of a column that is needed
        raise ValueError(f"it is empty; expected {what}")
    try:
        return form(cell)
    except ValueError:
        raise ValueError(f"expected {what}, got '{cell}'") from None


_WORDS = (*PARAMETERS, START)
