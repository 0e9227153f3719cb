"""Numbers inside frozen values by dotted path: 'deformation.gain', 'cost.states.q1', 'inputs.Q1.1'.

A path leads through fields of dataclasses, keys of mappings and places of tuples.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import TypeVar, cast

from fpirhc.errors import InvalidName, nearest

T = TypeVar("T")


def names_in(value: object) -> list[str]:
    """Return the names with which a path can go on."""
    if is_dataclass(value) and not isinstance(value, type):
        return [f.name for f in fields(value) if f.init]
    if isinstance(value, Mapping):
        return [str(key) for key in value]
    return [str(k) for k in range(len(value))] if isinstance(value, Sequence) and not isinstance(value, str) else []


def levels(value: object) -> Iterator[object]:
    """Yield a value and all that it wraps, the outermost first."""
    yield value
    if (field := _wraps(value)) is not None:
        yield from levels(entry(value, field))


def mapped(value: object, name: str) -> object:
    """The outermost level that has a field of this name: 'deformation.gain' is that of the map in all wrappers."""
    found = [*levels(value)]
    return next((one for one in found if name in names_in(one)), found[-1])


def _wraps(value: object) -> str | None:
    return next((one for one in ("map", "controller") if is_dataclass(value) and one in names_in(value)), None)


def entry(value: object, name: str) -> object:
    """Return the content of a field, the value of a key, or the item at a place."""
    if isinstance(value, Mapping):
        return value[name]
    return value[int(name)] if isinstance(value, Sequence) else getattr(value, name)


def content_at(owner: object, path: str, what: str = "the controller") -> object:
    """Return what stands at a path."""
    value, names = owner, path.split(".")
    for k, name in enumerate(names):
        every, value = [*levels(value)], mapped(value, name)
        if name not in names_in(value):
            where = f"'{'.'.join(names[:k])}' of {what}" if k else what
            kinds = " around ".join(type(one).__name__ for one in every)
            kind = "" if isinstance(value, Mapping | Sequence) else f" ({kinds})"
            valid = [*dict.fromkeys(own for level in every for own in names_in(level))]
            hint = meant(".".join((*names[:k], one, *names[k + 1 :])) for one in paths_to(name, value))
            if not valid:
                others = ", ".join(one for one in names_in(owner) if names_in(entry(owner, one)))
                hint = f" It has no settings{f'; {what} has settings in: {others}' if others else ''}."
            raise InvalidName(f"setting '{path}': {where}{kind} has no '{name}'.{hint or nearest(name, valid)}")
        value = entry(value, name)
    return value


def meant(paths: Iterable[str]) -> str:
    """Return ' Did you mean 'a' or 'b'?' of paths; empty where there are none."""
    quoted = " or ".join(f"'{one.replace('.map.', '.')}'" for one in paths)  # a path passes through wrappers by itself
    return f" Did you mean {quoted}?" if quoted else ""


def paths_to(name: str, value: object, depth: int = 4) -> Iterator[str]:
    """Yield the paths inside a value that end with a name."""
    for one in names_in(value) if depth else ():
        if one == name:
            yield one
        else:
            yield from (f"{one}.{rest}" for rest in paths_to(name, entry(value, one), depth - 1))


def copied(value: T, changes: Mapping[str, object]) -> T:
    """Return a frozen dataclass with other contents of some fields, without validation and without cached facts."""
    copy = object.__new__(type(value))
    for one in fields(value):  # type: ignore[arg-type]  # mypy does not narrow type variables
        object.__setattr__(copy, one.name, changes.get(one.name, getattr(value, one.name)))
    return copy


def changed_at(value: T, path: str, content: object) -> T:
    """Return the value with another content at a path."""

    def with_(name: str, new: object) -> T:
        return replace(value, **{name: new})  # type: ignore[type-var]

    name, _, rest = path.partition(".")
    if name not in names_in(value) and (field := _wraps(value)) is not None:
        return with_(field, changed_at(entry(value, field), path, content))
    inner = changed_at(entry(value, name), rest, content) if rest else content
    if isinstance(value, Mapping):
        return cast(T, {**value, name: inner})
    if isinstance(value, Sequence):
        return cast(T, (*value[: int(name)], inner, *value[int(name) + 1 :]))
    return with_(name, inner)
