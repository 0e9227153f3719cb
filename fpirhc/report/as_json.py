"""A comparison as one JSON object."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fpirhc.simulation.metrics import Metrics
    from fpirhc.studies.comparison.compare import Comparison
    from fpirhc.studies.comparison.entry import Entry
    from fpirhc.studies.comparison.null_test import NullTest
    from fpirhc.studies.comparison.outcome import Finding


def to_json(comparison: Comparison) -> str:
    """Return the comparison as JSON text; numbers that are not finite become null."""
    facts = {
        "problem": comparison.problem,
        "seed": comparison.seed,
        "versions": dict(comparison.versions),
        "verdict": list(comparison.verdict),
        "outcome": str(comparison.outcome),
        "information": list(comparison.information),
        "findings": [_finding(f) for f in comparison.findings],
        "null_test": None if comparison.null is None else _null_test(comparison.null),
        "null_tests": [_null_test(test) for test in comparison.nulls],
        "controllers": {e.name: _entry(e) for e in comparison.entries},
        "skipped": dict(comparison.skipped),
    }
    return json.dumps(_finite(facts), indent=2)


def _finding(finding: Finding) -> dict[str, Any]:
    return {
        "text": finding.text,
        "outcome": None if finding.outcome is None else str(finding.outcome),
        "pair": None if finding.pair is None else list(finding.pair),
        "ratios": dict(finding.ratios),
    }


def _null_test(null: NullTest) -> dict[str, Any]:
    return {
        "passed": null.passed,
        "harmful": null.harmful,
        "outcome": str(null.outcome),
        "pair": list(null.pair),
        "rms_error": {"before": dict(null.before), "after": dict(null.after)},
        "cycles": null.cycles,
        "elapsed_s": null.elapsed,
        "text": null.text,
    }


def _entry(entry: Entry) -> dict[str, Any]:
    metrics, cycle = entry.metrics, entry.cycle
    return {
        **_numbers(metrics),
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
        "optimality": None
        if entry.optimality is None
        else {"median": entry.optimality.median, "worst": entry.optimality.worst, "plans": entry.optimality.plans},
        "price_us": None
        if entry.price is None
        else {"beside": entry.price.beside, "difference": entry.price.difference, "noise": entry.price.noise},
        "notes": list(entry.notes),
        "measures": list(entry.information.uses) if entry.information else None,
        "acts": entry.information.rate if entry.information else None,
        "stop": entry.run.stop,
        "compiled": entry.run.compiled,
    }


def _numbers(metrics: Metrics) -> dict[str, Any]:
    """Every metric by name, null or empty where the run has no such number; metrics of a group stand inside it."""
    facts: dict[str, Any] = {}
    for name, metric in metrics.entries.items():
        numbers: Any = dict(metrics[name]) if metric.by else metrics[name].get("")
        group, _, rest = name.partition(".")
        if not rest:
            facts[name] = numbers
        elif numbers is not None:
            facts[group] = {**(facts.get(group) or {}), rest: numbers}
        else:
            facts.setdefault(group, None)
    return facts


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
