"""Numbers inside frozen values by dotted path: 'deformation.gain', 'cost.states.q1', 'inputs.Q1.1'.

A path leads through fields of dataclasses, keys of mappings and places of tuples.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import TypeVar, cast

from fpirhc.errors import InvalidName, nearest

T = TypeVar("T")
Copy = Callable[[object, Mapping[str, object]], object]  # (dataclass, changes by field) -> the changed copy


def names_in(value: object) -> list[str]:
    """Return the names with which a path can go on."""
    if is_dataclass(value) and not isinstance(value, type):
        return [f.name for f in fields(value) if f.init]
    if isinstance(value, Mapping):
        return [str(key) for key in value]
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [str(k) for k in range(len(value))]
    return []


def mapped(value: object, name: str) -> object:
    """The map inside a wrapper that has no field of this name: 'deformation.gain' is that of the map."""
    while is_dataclass(value) and name not in names_in(value) and "map" in names_in(value):
        value = getattr(value, "map")  # noqa: B009
    return value


def entry(value: object, name: str) -> object:
    """Return the content of a field, the value of a key, or the item at a place."""
    if isinstance(value, Mapping):
        return value[name]
    return value[int(name)] if isinstance(value, Sequence) else getattr(value, name)


def content_at(owner: object, path: str, what: str = "the controller") -> object:
    """Return what stands at a path."""
    value = owner
    done: list[str] = []
    for name in path.split("."):
        value = mapped(value, name)
        valid = names_in(value)
        if name not in valid:
            where = f"'{'.'.join(done)}' of {what}" if done else what
            kind = "" if isinstance(value, Mapping | Sequence) else f" ({type(value).__name__})"
            below = [".".join((*done, one)) for one in paths_to(name, value)]
            hint = f" Did you mean '{below[0]}'?" if below else nearest(name, valid)
            if not valid:
                others = [one for one in names_in(owner) if names_in(entry(owner, one))]
                hint = (
                    f" It has no settings; {what} has settings in: {', '.join(others)}."
                    if others
                    else " It has no settings."
                )
            raise InvalidName(f"setting '{path}': {where}{kind} has no '{name}'.{hint}")
        value = entry(value, name)
        done.append(name)
    return value


def paths_to(name: str, value: object, depth: int = 4) -> Iterator[str]:
    """Yield the paths inside a value that end with a name."""
    for one in names_in(value) if depth else ():
        if one == name:
            yield one
        else:
            yield from (f"{one}.{rest}" for rest in paths_to(name, entry(value, one), depth - 1))


def validated(value: object, changes: Mapping[str, object]) -> object:
    """Return a dataclass with other contents of some fields, checked as a new one is."""
    return replace(value, **changes)  # type: ignore[type-var]  # only dataclasses have fields


def copied(value: T, changes: Mapping[str, object]) -> T:
    """Return a frozen dataclass with other contents of some fields, without validation and without cached facts."""
    copy = object.__new__(type(value))
    for one in fields(value):  # type: ignore[arg-type]  # mypy does not narrow type variables
        object.__setattr__(copy, one.name, changes.get(one.name, getattr(value, one.name)))
    return copy


def changed_at(value: T, path: str, content: object, copy: Copy = validated) -> T:
    """Return the value with another content at a path.

    Args:
        value: the value; it stays as it is.
        copy: function (dataclass, changes by field) -> the changed copy; the default one validates.
    """
    name, _, rest = path.partition(".")
    if mapped(value, name) is not value:
        return cast(T, copy(value, {"map": changed_at(entry(value, "map"), path, content, copy)}))
    inner = changed_at(entry(value, name), rest, content, copy) if rest else content
    if isinstance(value, Mapping):
        return cast(T, {**value, name: inner})
    if isinstance(value, Sequence):
        return cast(T, (*value[: int(name)], inner, *value[int(name) + 1 :]))
    return cast(T, copy(value, {name: inner}))
