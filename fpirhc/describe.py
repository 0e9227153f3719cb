"""Settings of a value as plain data, for reports, files and comparisons of settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np


def describe(value: Any) -> Any:
    """Return `value` as data for JSON; a dataclass becomes {"is": its class, field: ...}, a function its name.

    A dataclass field with the metadata {"setting": False} is left out: it names the value and changes nothing.
    """
    if is_dataclass(value) and not isinstance(value, type):
        facts = {f.name: describe(getattr(value, f.name)) for f in fields(value) if f.metadata.get("setting", True)}
        return {"is": type(value).__name__, **facts}
    if isinstance(value, Mapping):
        return {str(k): describe(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [describe(v) for v in value]
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return getattr(value, "__name__", type(value).__name__)
