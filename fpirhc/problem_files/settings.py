"""Settings of a controller by dotted path."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any

from fpirhc.controllers.base import Controller
from fpirhc.errors import InvalidName, InvalidValue, nearest
from fpirhc.fields.checked import expects_whole_number

Values = Mapping[str, float]


def with_settings(controller: Controller, values: Values) -> Controller:
    """Return the controller with other values of some settings.

    Args:
        controller: the controller; it stays as it is.
        values: path -> number. A path leads through fields, keys of mappings and places of tuples, with dots in between:
            'deformation.gain', 'cost.states.q1'.

    Raises:
        InvalidName: no such setting; the nearest one is offered.
        InvalidValue: the setting is not a number, or does not accept this one.
    """
    changed: Any = controller
    for path, value in values.items():
        current_setting(controller, path)
        changed = _changed(changed, path.split("."), value)
    assert isinstance(changed, Controller)
    return changed


def current_setting(controller: Controller, path: str) -> float:
    """Return the number at a path.

    Raises:
        InvalidName: no such setting; the nearest one is offered.
        InvalidValue: the setting is not a number.
    """
    value: Any = controller
    done: list[str] = []
    for name in path.split("."):
        valid = _names(value)
        if name not in valid:
            where = f"'{'.'.join(done)}' of the controller" if done else "the controller"
            raise InvalidName(
                f"setting '{path}': {where} ({type(value).__name__}) has no '{name}'.{nearest(name, valid)}"
            )
        value = _entry(value, name)
        done.append(name)
    if isinstance(value, bool) or not isinstance(value, int | float):
        hint = (
            " give it a number first" if value is None else f" go on with one of: {', '.join(_names(value)) or 'none'}"
        )
        raise InvalidValue(f"setting '{path}' is {value!r}, not a number;{hint}")
    return value


def is_whole(controller: Controller, path: str) -> bool:
    """Whether the setting at a path is declared as a whole number."""
    *parents, name = path.split(".")
    owner: Any = controller
    for parent in parents:
        owner = _entry(owner, parent)
    return is_dataclass(owner) and expects_whole_number(type(owner), name)


def _names(value: Any) -> list[str]:
    if is_dataclass(value) and not isinstance(value, type):
        return [f.name for f in fields(value) if f.init]
    if isinstance(value, Mapping):
        return [str(k) for k in value]
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [str(k) for k in range(len(value))]
    return []


def _entry(value: Any, name: str) -> Any:
    if isinstance(value, Mapping):
        return value[name]
    return value[int(name)] if isinstance(value, Sequence) else getattr(value, name)


def _changed(value: Any, path: Sequence[str], number: float) -> Any:
    if not path:
        return number
    name, *rest = path
    inner = _changed(_entry(value, name), rest, number)
    if isinstance(value, Mapping):
        return {**value, name: inner}
    if isinstance(value, Sequence):
        return (*value[: int(name)], inner, *value[int(name) + 1 :])
    return replace(value, **{name: inner})
