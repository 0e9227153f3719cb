"""Named cases of a problem: under each name, what is different from the problem there.

A path says what a case changes: 'exact.NAME' and 'approximate.NAME' a parameter, 'start.NAME' the first value of a state,
and any other one a field of the problem or a number inside it, 'limits.inputs.Q1.1', 'dead_time.measurement', 'reality'.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import cast

import numpy as np

from fpirhc.errors import InvalidName, InvalidValue, Mistakes, nearest
from fpirhc.fields.checked import Checked, checked_call, expects_whole_number
from fpirhc.fields.kinds import described, finite_number
from fpirhc.summary import line
from fpirhc.symbolic.dotted import changed_at, content_at, mapped
from fpirhc.task.problem import Problem

EVERY = "all"  # names every case
_GROUP = "group"  # what a case has beside its changes
_EXACT, _APPROXIMATE, _START = "exact", "approximate", "start"
WORDS = {_EXACT: "parameter of what moves", _APPROXIMATE: "parameter of what the controllers know", _START: "state"}
_OWN = ("plant", "start", "name")  # fields of a problem that no path begins with: they have words of their own


@dataclass(frozen=True, eq=False)
class Cases(Checked):
    """Named cases of one problem; every controller of a study runs in every case.

        cases = fp.Cases({"heavy": {"exact.mass": 2.0, "start.angle": 0.3}, "late": {"dead_time.measurement": 0.01}})
        cases = fp.Cases(pandas.read_csv("patients.csv", index_col="case").to_dict("index"))

    A run in a case is that of `problem(name, ...)`. Controllers know of a case's changes as of everything in a problem, except
    exact parameters and the reality.

    Args:
        changes: by name of the case and path. The path is 'exact.NAME' (the parameter of what moves), 'approximate.NAME' (of the
            controllers' model), 'start.NAME', or begins with another field of the problem: 'reference',
            'reality', 'signals', 'dead_time.inputs.Q1', 'limits.inputs.Q1' (a pair) or 'limits.inputs.Q1.1' (its upper end).
            'group' is a text by which cases are summed up.

    Raises:
        InvalidProblem: all mistakes together: no case, a name that is no text, changes that are no mapping, a wrong group, a
            number that a case sets twice.
    """

    changes: Mapping[str, Mapping[str, object]]

    def __post_init__(self) -> None:
        mistakes = Mistakes("cases")
        if not self.changes:
            mistakes.add('there is none; expected {"heavy": {"exact.mass": 2.0}}')
        for name, changes in self.changes.items():
            for why in _form(name, changes):
                mistakes.add(f"case {name!r}: {why}")
        mistakes.raise_if_any()

    def __repr__(self) -> str:
        groups = tuple(dict.fromkeys(filter(None, map(self.group, self.names))))
        return line(self, f"{len(self.names)} cases", *([f"groups {', '.join(groups)}"] if groups else []))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cases."""
        return tuple(self.changes)

    def group(self, name: str) -> str:
        """Return the group of a case; '' where it has none."""
        return str(self.changes[name].get(_GROUP, ""))

    @checked_call
    def matching(self, wanted: Sequence[str]) -> tuple[str, ...]:
        """Return the names of cases that are wanted, in their order: 'all', names of cases and of groups.

        Raises:
            InvalidName: a name of neither.
        """
        valid = dict.fromkeys((EVERY, *filter(None, map(self.group, self.names)), *self.names))
        for one in (one for one in wanted if one not in valid):
            raise InvalidName(f"case '{one}' is unknown.{nearest(one, valid)}")
        return tuple(name for name in self.names if {EVERY, name, self.group(name)} & {*wanted})

    @checked_call
    def problem(self, name: str, problem: Problem) -> Problem:
        """Return the problem in a case.

        Raises:
            InvalidName: an unknown case.
            InvalidProblem: changes that the problem does not accept, each with its path.
        """
        return self.exactly(name, self.build(name, problem))

    def build(self, name: str, problem: Problem) -> Problem:
        """Return the problem with all changes of a case but those of exact parameters, which are data of a loop."""
        if name not in self.changes:
            raise InvalidName(f"case '{name}' is unknown.{nearest(name, self.names)}")
        self.check(problem, name)
        mistakes = Mistakes(f"case {name!r}")
        with mistakes.caught():
            problem = _changed(problem, self.changes[name])
        mistakes.raise_if_any()
        return problem

    def check(self, problem: Problem, *names: str) -> None:
        """Raise with all mistakes where a path or a number of some cases, or of all, does not fit the problem."""
        mistakes = Mistakes("cases")
        for name in names or self.names:
            for path in (p for p in self.changes[name] if p != _GROUP):
                with mistakes.caught(f"case {name!r}, '{path}': "):
                    check_change(problem, self.changes[name], path)
        mistakes.raise_if_any()

    def exactly(self, name: str, built: Problem) -> Problem:
        """Return what `build` returned, with the exact parameters of a case."""
        before = {name: one.exact for name, one in built.moves.parameters.items()}
        exact = {n: float(value) for n, value in {**before, **_named(self.changes[name], _EXACT)}.items()}
        return built if exact == before else built.with_exact(np.array(list(exact.values())))

    def key(self, name: str) -> tuple[object, ...]:
        """Return what decides the build of a case; cases with equal keys have one build."""
        return tuple(
            (path, value if isinstance(value, int | float | str) else id(value))
            for path, value in sorted(self.changes[name].items())
            if path != _GROUP and not path.startswith(f"{_EXACT}.")
        )


def _changed(problem: Problem, changes: Mapping[str, object]) -> Problem:
    """The problem with all changes but those of exact parameters."""
    for path, value in changes.items():
        if path.partition(".")[0] not in (*WORDS, _GROUP):
            problem = changed_at(problem, path, as_declared(problem, path, value))
    model, start = _named(changes, _APPROXIMATE), _named(changes, _START)
    if model:
        parameters = {
            name: replace(one, approximate=float(model[name])) if name in model else one
            for name, one in problem.plant.parameters.items()
        }
        problem = replace(problem, plant=replace(problem.plant, parameters=parameters))
    return replace(problem, start={**problem.start, **start}) if start else problem


def is_whole(owner: object, path: str) -> bool:
    """Whether the number at a path of a problem or a controller is declared as a whole one."""
    parent, _, name = path.rpartition(".")
    part = mapped(content_at(owner, parent) if parent else owner, name)
    return is_dataclass(part) and expects_whole_number(type(part), name)


def as_declared(owner: object, path: str, value: object) -> object:
    """Return a number of a table or a command as the field at its path declares it."""
    return int(value) if isinstance(value, float) and value.is_integer() and is_whole(owner, path) else value


def _named(changes: Mapping[str, object], word: str) -> dict[str, float]:
    """The numbers below a word, by the name behind it."""
    return {p.partition(".")[2]: cast(float, value) for p, value in changes.items() if p.startswith(f"{word}.")}


def _form(name: str, changes: Mapping[str, object]) -> Iterator[str]:
    """What is wrong with a case whatever its problem is."""
    if not name.strip() or name == EVERY:
        yield f"the name of a case is a text that is not empty; '{EVERY}' means every case"
    if not isinstance(group := changes.get(_GROUP, ""), str):
        yield f"'{_GROUP}' is a text, got {described(group)}"
    for path in changes:
        above = [path[:at] for at, mark in enumerate(path) if mark == "."]
        for other in (one for one in above if one in changes):
            yield f"'{other}' and '{path}' set the same number; leave one of them out"


def check_change(problem: Problem, changes: Mapping[str, object], path: str) -> None:
    """Raise where one change does not fit."""
    word, _, name = path.partition(".")
    if word in WORDS:
        # A case with a reality of its own means the parameters of that one.
        there = settable(changed_at(problem, "reality", changes["reality"]) if "reality" in changes else problem, word)
        if name not in there:
            raise InvalidName(f"no {WORDS[word]} is called '{name}'.{nearest(name, there)}")
        _check_number(changes[path], *there[name][1:])
    else:
        paths = [f.name for f in fields(problem) if f.name not in _OWN]
        if word not in paths:
            meant = _meant(problem, word) or _meant(problem, path.rpartition(".")[2]) or nearest(word, [*WORDS, *paths])
            raise InvalidName(f"the problem has no '{path}'.{meant}")
        if isinstance(content_at(problem, path, "the problem"), int | float):
            _check_number(changes[path])


def settable(problem: Problem, word: str) -> dict[str, tuple[float, tuple[float, float] | None, str]]:
    """Return number, range and unit of everything that is named behind a word, by name."""
    if word == _START:
        state, ranges = problem.plant.state, problem.plant.ranges
        facts = zip(state.elements, problem.start_state.tolist(), state.entry_units, strict=True)
        return {name: (first, ranges.get(name), unit) for name, first, unit in facts}
    stated = (problem.moves if word == _EXACT else problem.plant).parameters
    return {name: (float(getattr(one, word)), one.bounds, one.unit) for name, one in stated.items() if not one.outside}


def unit_of_setting(path: str, problem: Problem) -> str:
    """Return the unit of a setting of a controller or of the problem, '' where its kind does not say it."""
    word, _, name = path.partition(".")
    if word in WORDS:
        return settable(problem, word)[name][2]
    if word in ("dead_time", "duration", "measure_from", "period"):
        return problem.time_unit
    name = name.removeprefix("inputs.").removeprefix("states.") if word == "limits" else name
    signals = (problem.plant.state, problem.plant.input) if word == "limits" else ()
    units = {n: u for one in signals for n, u in zip(one.elements, one.entry_units, strict=True)}
    return units.get(name) or units.get(name.rpartition(".")[0], "")  # 'Q1.1' is an end of Q1


def _meant(problem: Problem, name: str) -> str:
    """What to write for the name of a parameter, a state or an input alone."""
    paths = [f"'{word}.{name}' ({what})" for word, what in WORDS.items() if name in settable(problem, word)]
    paths += [f"'limits.inputs.{name}' (its limits)"] * (name in problem.plant.inputs)
    return f" Write {' or '.join(paths)}." if paths else ""


def _check_number(value: object, bounds: tuple[float, float] | None = None, unit: str = "") -> None:
    if not finite_number(value):
        raise InvalidValue(f"expected a finite number, got {described(value)}")
    low, high = bounds or (-math.inf, math.inf)
    if not low <= float(value) <= high:  # type: ignore[arg-type]  # it is a number
        raise InvalidValue(f"expected {low:g} to {high:g}{f' {unit}' if unit not in ('', '1') else ''}, got {value:g}")
