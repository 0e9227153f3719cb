"""Names of older versions that a baseline may hold, with the names of today.

Only names change here, never a number: a baseline with old names is compared with its own numbers, and a note lists the names.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from fpirhc.baselines.bands import Expected
from fpirhc.baselines.settings import Settings
from fpirhc.members import FORMER

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
