"""Settings of a problem and its controllers as flat data, by which a stale baseline is recognised and explained.

Functions appear by their names alone: a changed formula appears in the metrics, not here.
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
    """Flat settings.

    Args:
        problem: settings of the problem.
        controllers: settings of every controller, by name.
    """

    problem: Flat
    controllers: Mapping[str, Flat]

    def without(self, absent: set[str]) -> Settings:
        """Return the settings without some controllers."""
        return Settings(self.problem, {k: v for k, v in self.controllers.items() if k not in absent})


def settings_of(task: Task) -> Settings:
    """Return the settings of a task."""
    return Settings(_flat(task.problem), {name: _flat(controller) for name, controller in task.controllers.items()})


def fingerprint(value: Any) -> str:
    """Return a hash of plain data; the order of keys does not matter."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return "sha256:" + hashlib.sha256(text.encode()).hexdigest()


def differences(where: str, before: Flat, now: Flat) -> list[str]:
    """Return a sentence for every setting that differs: 'where: name was ..., is ...'."""
    missing = object()
    sentences = []
    for name in sorted({*before, *now}):
        old, new = before.get(name, missing), now.get(name, missing)
        if fingerprint(None if old is missing else [old]) != fingerprint(None if new is missing else [new]):
            was = "was not there" if old is missing else f"was {json.dumps(old)}"
            now_is = "is gone" if new is missing else f"is {json.dumps(new)}"
            sentences.append(f"{where}: {name} {was}, {now_is}")
    return sentences


def _flat(value: Any) -> dict[str, Any]:
    settings: dict[str, Any] = {}
    _collect(describe(value), "", settings)
    return settings


def _collect(value: Any, path: str, settings: dict[str, Any]) -> None:
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            _collect(inner, f"{path}.{key}" if path else key, settings)
    elif isinstance(value, list) and any(isinstance(v, dict) for v in value):
        for k, inner in enumerate(value):
            _collect(inner, f"{path}[{k}]", settings)
    elif isinstance(value, list) and len(json.dumps(value)) > 8 * _LONG:
        settings[path] = f"{len(value)} entries, {fingerprint(_plain(value))}"
    else:
        settings[path] = _plain(value)


def _plain(value: Any) -> Any:
    """The value for JSON, which has neither infinity nor NaN: they become words."""
    if isinstance(value, list):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value
