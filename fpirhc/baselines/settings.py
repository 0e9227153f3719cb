"""Settings of a problem and its controllers as flat data, by which a stale baseline is recognised and explained.

Functions appear by their names alone: a changed formula shows in the metrics, not here.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fpirhc.describe import describe
from fpirhc.problem_files.problem_file import Task

Flat = Mapping[str, Any]

_LONG = 16  # entries of a list from which on its hash stands for it


@dataclass(frozen=True)
class Settings:
    """Flat settings of the problem, and of every controller by name."""

    problem: Flat
    controllers: Mapping[str, Flat]

    def without(self, absent: set[str]) -> Settings:
        """The same without some controllers."""
        return Settings(self.problem, {k: v for k, v in self.controllers.items() if k not in absent})


def settings_of(task: Task) -> Settings:
    """Return the settings of a task."""
    return Settings(_flat(task.problem), {name: _flat(controller) for name, controller in task.controllers.items()})


def fingerprint(value: Any) -> str:
    """Hash of plain data; the order of keys does not matter."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return "sha256:" + hashlib.sha256(text.encode()).hexdigest()


def differences(where: str, before: Flat, now: Flat) -> list[str]:
    """Say which settings differ: 'where: name was ..., is ...'."""
    missing = object()
    said = []
    for name in sorted({*before, *now}):
        old, new = before.get(name, missing), now.get(name, missing)
        if fingerprint(None if old is missing else [old]) != fingerprint(None if new is missing else [new]):
            was = "was not there" if old is missing else f"was {json.dumps(old)}"
            now_is = "is gone" if new is missing else f"is {json.dumps(new)}"
            said.append(f"{where}: {name} {was}, {now_is}")
    return said


def _flat(value: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    _collect(describe(value), "", found)
    return found


def _collect(value: Any, path: str, found: dict[str, Any]) -> None:
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            _collect(inner, f"{path}.{key}" if path else key, found)
    elif isinstance(value, list) and any(isinstance(v, dict) for v in value):
        for k, inner in enumerate(value):
            _collect(inner, f"{path}[{k}]", found)
    elif isinstance(value, list) and len(json.dumps(value)) > 8 * _LONG:
        found[path] = f"{len(value)} entries, {fingerprint(_plain(value))}"
    else:
        found[path] = _plain(value)


def _plain(value: Any) -> Any:
    """Infinity and NaN have no place in JSON; a bound that is not there is infinite."""
    if isinstance(value, list):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value
