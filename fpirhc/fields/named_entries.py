"""Numbers by name, as a machine gives them from cycle to cycle: settings and set-points."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from fpirhc.errors import InvalidField
from fpirhc.fields.given import described

Value = TypeVar("Value")


def named_entries(what: str, entries: Mapping[str, Value]) -> Mapping[str, Value]:
    """Return the entries as they are, by name; `what` names them: "settings".

    Raises:
        InvalidField: no mapping, or names that are no texts.
    """
    if not isinstance(entries, Mapping):
        raise InvalidField([f"{what}: expected a mapping {{name: number}}, got {described(entries)}"])
    strange = [name for name in entries if not isinstance(name, str)]
    if strange:
        raise InvalidField([f"{what}: expected names as texts, got the name {described(one)}" for one in strange])
    return entries
