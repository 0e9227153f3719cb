"""A comparison as one JSON object."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fpirhc.studies.comparison.compare import Comparison, Entry


def to_json(comparison: Comparison) -> str:
    """Return the comparison as JSON text; numbers that are not finite become null."""
    facts = {
        "problem": comparison.problem,
        "seed": comparison.seed,
        "versions": dict(comparison.versions),
        "verdict": list(comparison.verdict),
        "controllers": {e.name: _entry(e) for e in comparison.entries},
        "skipped": dict(comparison.skipped),
    }
    return json.dumps(_finite(facts), indent=2)


def _entry(entry: Entry) -> dict[str, Any]:
    metrics, cycle = entry.metrics, entry.cycle
    contraction = entry.contraction
    return {
        "rms_error": dict(metrics.rms_error),
        "max_error": dict(metrics.max_error),
        "iae": dict(metrics.iae),
        "settling": dict(metrics.settling),
        "effort": dict(metrics.effort),
        "clipped_share": metrics.clipped_share,
        "cost": dict(metrics.cost),
        "cycle_us": None
        if cycle is None
        else {
            "median": cycle.median,
            "p99": cycle.p99,
            "max": cycle.maximum,
            "first": cycle.first,
            "planning": cycle.planning,
        },
        "statuses": dict(metrics.statuses),
        "solve": dict(metrics.solve),
        "optimality": None
        if entry.optimality is None
        else {"median": entry.optimality.median, "worst": entry.optimality.worst, "plans": entry.optimality.plans},
        "contraction": None
        if contraction is None
        else {"predicted": contraction.predicted, "measured": contraction.measured},
        "notes": list(entry.notes),
        "stop": entry.run.stop,
        "compiled": entry.run.compiled,
    }


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
