"""Reads a baseline and refuses files that are truncated, edited by hand, newer or incomplete."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from fpirhc.baselines.bands import BANDED, EXACT, KINDS, Expected, Metric
from fpirhc.baselines.baseline import FORMAT, Baseline, Settings, fingerprint, settings_hash
from fpirhc.baselines.measuring import FINISHED, SOURCES, metric_of
from fpirhc.errors import BaselineError, InvalidName
from fpirhc.members import FORMER
from fpirhc.simulation import metrics as run_metrics

_LARGEST = 20_000_000  # bytes; a baseline has some tens of thousands


def read_baseline(path: Path, metrics: Sequence[run_metrics.Metric] | None = None) -> Baseline:
    """Return the baseline in a file.

    Args:
        path: path of the file.
        metrics: metrics of the problem's runs; None: names are not checked.

    Raises:
        BaselineError: the file is missing, damaged, edited by hand, of a newer format, of another problem, or compares
            nothing.
    """
    try:
        if path.stat().st_size > _LARGEST:
            raise BaselineError(f"'{path.name}' is larger than {_LARGEST / 1e6:.0f} MB and no baseline; {_ACCEPT}")
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise BaselineError(
            f"there is no baseline '{path.name}'; write one: fpirhc accept PROBLEM --reason ..."
        ) from None
    except OSError as error:
        raise BaselineError(f"'{path.name}' cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise BaselineError(f"'{path.name}' is no text ({error.reason}); restore it, or {_ACCEPT}") from None
    return read_text(text, path, metrics)


def read_text(text: str, path: Path, metrics: Sequence[run_metrics.Metric] | None = None) -> Baseline:
    """Return the baseline in a text that is, or will be, in the file at `path`.

    Raises:
        BaselineError: see `read_baseline`.
    """
    facts = _parsed(text, path)
    file_format = facts.get("format")
    if isinstance(file_format, int) and not isinstance(file_format, bool) and file_format > FORMAT:
        raise BaselineError(
            f"'{path.name}' has format {file_format}, this version reads {FORMAT}: it was written by a newer fpirhc; upgrade"
        )
    checksum = facts.pop("checksum", None)
    if file_format != FORMAT or checksum is None:
        raise BaselineError(f"'{path.name}' is not a baseline of format {FORMAT}; {_ACCEPT}")
    if checksum != fingerprint(facts):
        raise BaselineError(f"'{path.name}' was edited by hand, its checksum does not fit; restore it, or {_ACCEPT}")
    try:
        baseline = _baseline(facts)
        for key in {key for one in baseline.controllers.values() for key in one.metrics} if metrics is not None else ():
            metric_of(key, metrics)
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as error:
        reason = error if isinstance(error, BaselineError | InvalidName) else f"it lacks or misshapes {error}"
        raise BaselineError(f"'{path.name}': {reason}; {_ACCEPT}") from None
    if baseline.problem != path.stem:
        raise BaselineError(f"'{path.name}' is the baseline of '{baseline.problem}', not of '{path.stem}'; {_ACCEPT}")
    return baseline


_ACCEPT = "measure it again with: fpirhc accept PROBLEM --reason ..."


def _parsed(text: str, path: Path) -> dict[str, Any]:
    try:
        facts = json.loads(text, object_pairs_hook=_without_doubles, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise BaselineError(f"'{path.name}' is no complete JSON ({error}); restore it, or {_ACCEPT}") from None
    if not isinstance(facts, dict):
        raise BaselineError(f"'{path.name}' is no baseline: expected an object, got {type(facts).__name__}; {_ACCEPT}")
    return facts


def _without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entries = dict(pairs)
    if len(entries) != len(pairs):
        raise ValueError("a key stands in it twice")
    return entries


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no number")


def _baseline(facts: dict[str, Any]) -> Baseline:
    settings = Settings(
        dict(facts["settings"]["problem"]), {k: dict(v) for k, v in facts["settings"]["controllers"].items()}
    )
    if facts["settings"]["hash"] != settings_hash(settings):
        raise BaselineError("the hash of its settings does not fit them")
    controllers = {name: _expected(name, one) for name, one in facts["controllers"].items()}
    if not controllers:
        raise BaselineError("it holds no controller and would compare nothing")
    if set(controllers) != set(settings.controllers):
        raise BaselineError("its controllers and their settings differ")
    settings, renamed = new_settings(settings)
    for name, one in controllers.items():
        controllers[name], also = new_metrics(one)
        renamed |= also
    for name in ("problem", "reason", "date"):
        if not isinstance(facts[name], str) or not facts[name].strip():
            raise BaselineError(f"it has no {name}")
    if not isinstance(facts["seed"], int) or facts["seed"] < 0:
        raise BaselineError("its seed is no whole number of at least 0")
    return Baseline(
        facts["problem"],
        facts["reason"],
        facts["date"],
        facts["seed"],
        {str(k): str(v) for k, v in facts["versions"].items()},
        {str(k): [str(n) for n in v] for k, v in facts["varied"].items()},
        settings,
        controllers,
        renamed,
    )


def _expected(name: str, facts: dict[str, Any]) -> Expected:
    outcomes = tuple(str(o) for o in facts["outcomes"])
    metrics = {metric: _metric(f"{name}: {metric}", one) for metric, one in facts["metrics"].items()}
    skipped = {str(k): str(v) for k, v in facts["not_compared"].items()}
    if not outcomes:
        raise BaselineError(f"controller '{name}' has no outcome")
    if outcomes == (FINISHED,) and not any(m.kind == BANDED for m in metrics.values()):
        raise BaselineError(f"controller '{name}' has no metric with a band")
    return Expected(outcomes, metrics, skipped)


def _metric(where: str, facts: dict[str, Any]) -> Metric:
    kind, value = facts["kind"], facts["value"]
    if kind not in KINDS:
        raise BaselineError(f"{where} has class '{kind}'; expected one of {', '.join(KINDS)}")
    if not (value is None or isinstance(value, str) or _is_number(value)):
        raise BaselineError(f"{where} has the value {str(value)[:40]!r}; expected a finite number, a word or null")
    if kind == EXACT:
        return Metric(kind, value, 0.0, {})
    if not _is_number(value):
        raise BaselineError(f"{where} is {kind} and has no number")
    band, spread = facts.get("band"), facts.get("spread")
    if not isinstance(band, int | float) or not _is_number(band) or band <= 0:
        raise BaselineError(f"{where} is {kind} and has no band")
    if not isinstance(spread, dict) or not all(s in SOURCES and _is_number(v) for s, v in spread.items()):
        raise BaselineError(f"{where} has no spread by {', '.join(SOURCES)}")
    return Metric(kind, value, float(band), spread)


def _is_number(value: Any) -> bool:
    try:
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # a whole number beyond all floats
        return False


METRICS = {"cost.correction": "cost.deviation"}
# A setting's parent stands before it, so that a coordinate of a user's may have any name.
_SETTINGS = {
    r"((?:^|\bcontroller\.)(?:controller\.)*)nominal(?=\.)": r"\1replanning",
    r"\boptimiser\.bend(?=\.|$)": "optimiser.hessian",
    r"\bcost\.correction(?=\.|$)": "cost.deviation",
    r"\bcost\.terminal_cost(?=\.|$)": "cost.terminal",
}


def new_settings(settings: Settings) -> tuple[Settings, dict[str, str]]:
    """Return the settings with the names of today, and the new name of each old one."""
    changed: dict[str, str] = {}
    problem = _flat(settings.problem, changed)
    return Settings(problem, {name: _flat(one, changed) for name, one in settings.controllers.items()}), changed


def new_metrics(expected: Expected) -> tuple[Expected, dict[str, str]]:
    """Return the expectations of a controller with the names of today, and the new name of each old one."""
    changed = {k: METRICS[k] for k in (*expected.metrics, *expected.not_compared) if k in METRICS}
    metrics = {METRICS.get(k, k): one for k, one in expected.metrics.items()}
    skipped = {METRICS.get(k, k): why for k, why in expected.not_compared.items()}
    return replace(expected, metrics=metrics, not_compared=skipped), changed


def _flat(flat: Mapping[str, Any], changed: dict[str, str]) -> dict[str, Any]:
    renamed = {}
    for key, value in flat.items():
        name = key
        for pattern, today in _SETTINGS.items():
            name = re.sub(pattern, today, name)
        if name != key:
            changed[_without_entry(key)] = _without_entry(name)
        is_class = name == "is" or name.endswith(".is")
        if is_class and value in FORMER:
            changed[value] = FORMER[value]
        renamed[name] = FORMER.get(value, value) if is_class else value
    return renamed


def _without_entry(key: str) -> str:
    """The setting without the entry inside it, so that one rename is reported once: 'cost.correction'."""
    parts = key.split(".")
    old = {"nominal", "replanning", "bend", "hessian", "correction", "deviation", "terminal_cost", "terminal"}
    last = max(k for k, part in enumerate(parts) if part in old)
    return ".".join(parts[max(0, last - 1) : last + 1])
