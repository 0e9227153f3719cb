"""A baseline: a readable JSON file with one metric per line, and a checksum that shows edits by hand.

    {"format": 1, "problem", "reason", "date", "seed", "versions", "varied",
     "settings": {"hash", "problem", "controllers"}, "controllers": {name: {"outcomes", "metrics", "not_compared"}},
     "checksum"}

The checksum is over the content: white space and the order of keys do not matter. It is no signature.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from fpirhc.baselines.bands import Expected
from fpirhc.describe import describe
from fpirhc.problem_files.problem_file import Task

FORMAT = 1
_WIDTH = 118  # of a line that holds a whole object


@dataclass(frozen=True)
class Baseline:
    """The expected results of a problem, and how they were measured."""

    problem: str  # name of the problem
    reason: str  # why this baseline was accepted
    date: str  # time of its acceptance, UTC
    seed: int  # seed of the nominal run
    versions: Mapping[str, str]  # versions of fpirhc and of what its numbers depend on
    varied: Mapping[str, Sequence[str]]  # variants in words, by source
    settings: Settings  # settings of the problem and its controllers
    controllers: Mapping[str, Expected]  # expectations by controller
    # new names by old names of the file; a file that is written has no old names
    renamed: Mapping[str, str] = field(default_factory=dict)


def to_text(baseline: Baseline) -> str:
    """Return the file's text; its controllers are sorted by name, whatever the order of the measurements."""
    settings = asdict(baseline.settings)
    settings["controllers"] = dict(sorted(settings["controllers"].items()))
    facts = {
        "format": FORMAT,
        "problem": baseline.problem,
        "reason": baseline.reason,
        "date": baseline.date,
        "seed": baseline.seed,
        "versions": dict(baseline.versions),
        "varied": {source: list(names) for source, names in baseline.varied.items()},
        "settings": {"hash": settings_hash(baseline.settings), **settings},
        "controllers": {name: _entry(one) for name, one in sorted(baseline.controllers.items())},
    }
    facts["checksum"] = fingerprint(facts)
    return _written(facts, "", keep_open=True) + "\n"


def settings_hash(settings: Settings) -> str:
    """Return the hash of all settings."""
    return fingerprint(asdict(settings))


def _entry(one: Expected) -> dict[str, Any]:
    metrics = {name: _metric_facts(asdict(metric)) for name, metric in one.metrics.items()}
    return {"outcomes": list(one.outcomes), "metrics": metrics, "not_compared": dict(one.not_compared)}


def _metric_facts(facts: dict[str, Any]) -> dict[str, Any]:
    """An exact metric has neither band nor spread."""
    return facts if facts["band"] else {"kind": facts["kind"], "value": facts["value"]}


def _written(value: Any, indent: str, *, keep_open: bool = False) -> str:
    """JSON in which every object that fits on a line stands on one."""
    line = json.dumps(value, ensure_ascii=True, allow_nan=False)
    if not isinstance(value, dict) or not value or (len(indent) + len(line) <= _WIDTH and not keep_open):
        return line
    deeper = indent + "  "
    inside = ",\n".join(f"{deeper}{json.dumps(k)}: {_written(v, deeper)}" for k, v in value.items())
    return "{\n" + inside + f"\n{indent}}}"


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
