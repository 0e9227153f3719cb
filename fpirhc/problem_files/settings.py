"""Settings of a controller by dotted path."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import is_dataclass
from typing import Any

from fpirhc.controllers.base import Controller
from fpirhc.errors import InvalidValue
from fpirhc.fields.checked import expects_whole_number
from fpirhc.symbolic.paths import changed_at, content_at, names_in

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
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InvalidValue(f"setting '{path}': expected a number, got {value!r}")
        if is_whole(controller, path) and not isinstance(value, int):
            raise InvalidValue(f"setting '{path}': expected a whole number, got {value!r}")
        changed = changed_at(changed, path, value)
    assert isinstance(changed, Controller)
    return changed


def current_setting(controller: Controller, path: str) -> float:
    """Return the number at a path.

    Raises:
        InvalidName: no such setting; the nearest one is offered.
        InvalidValue: the setting is not a number.
    """
    value = content_at(controller, path)
    if isinstance(value, bool) or not isinstance(value, int | float):
        hint = (
            " give it a number first"
            if value is None
            else f" go on with one of: {', '.join(names_in(value)) or 'none'}"
        )
        raise InvalidValue(f"setting '{path}' is {value!r}, not a number;{hint}")
    return value


def is_whole(controller: Controller, path: str) -> bool:
    """Whether the setting at a path is declared as a whole number."""
    parent, _, name = path.rpartition(".")
    owner: Any = content_at(controller, parent) if parent else controller
    return is_dataclass(owner) and expects_whole_number(type(owner), name)
