"""The view of paired scenarios: the verdict, the table of the controllers, the origin of their settings, and the facts."""

from __future__ import annotations

import math
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

from fpirhc.simulation.metrics.columns import Column as Number
from fpirhc.studies.scenarios.paired import Summary, percent, signed
from fpirhc.studies.view import View, status_shares
from fpirhc.summary import Column, Table, written_out

if TYPE_CHECKING:
    from fpirhc.studies.scenarios.scenario_study import ScenarioComparison

_MEANING = (
    "Errors are rms errors divided by the range of the reference, root mean square over the judged coordinates. Every scenario "
    "has the same noise, disturbances and drawn parameters for all controllers; differences are taken within scenarios, and their "
    "intervals are 95 % percentile bootstrap intervals of the median. A run whose error exceeds the reference's range has "
    "diverged; a run that ended early counts as worse than every other run."
)
_UNTUNED = "No file of tuned settings was given: all settings are those of the problem file."


def scenario_view(comparison: ScenarioComparison) -> View:
    """Return what is said of paired scenarios."""
    conditions = (
        f"{comparison.count} scenarios of seed {comparison.seed}, exact parameters within {comparison.percent:g} % of the "
        f"problem's, errors from t = {comparison.measure_from:g} {comparison.time_unit} on."
    )
    outcomes = [
        one.outcome for one in comparison.summaries[1:]
    ]  # the first sentences are about the rivals, in their order
    return View(
        title=comparison.title,
        about=comparison.description,
        sentences=tuple(zip_longest(comparison.verdict, outcomes)),
        conditions=f"{conditions} {_MEANING}",
        tables=(_controllers(comparison, f"{comparison.problem}: {conditions}"),),
        lists={"Tuning": [f"{name}: {note}" for name, note in comparison.tuning.items()] or [_UNTUNED]},
        skipped=comparison.skipped,
        settings=comparison.settings,
        versions=comparison.versions,
        command=comparison.command,
        elapsed=comparison.elapsed,
        facts=_facts(comparison),
    )


def _controllers(comparison: ScenarioComparison, title: str) -> Table:
    heads = (
        Column("controller"),
        Column("median error", "median"),
        Column("difference (95 %)"),
        Column("ratio"),
        Column("smaller in", None),
        *(Column(f"median {c.short}", None) for c in comparison.columns),
        Column("worst"),
        Column("in scenario", None),
        Column("failures"),
        Column("status", None, left=True),
    )
    table = Table(title, heads)
    for one in comparison.summaries:
        beside = ["baseline", "", ""]
        if one.difference is not None:
            d = one.difference
            apart = f"{signed(d.median)} ({signed(d.low)} to {signed(d.high)})"
            beside = [apart, written_out(one.ratio), str(one.better)]
        failed = ", ".join(f"{n} {outcome}" for outcome, n in one.outcomes.items() if outcome != "finished")
        medians = [_median(c, one) for c in comparison.columns]
        worst = [percent(one.worst), str(one.worst_scenario), failed or "0"]
        table.add([one.name, percent(one.median), *beside, *medians, *worst, status_shares(one.statuses)])
    return table


def _median(column: Number, one: Summary) -> str:
    value = one.metrics.get(column.metric.name, {}).get(column.element)
    return column.metric.text(value) if value is not None and math.isfinite(value) else "none"


def _facts(comparison: ScenarioComparison) -> dict[str, Any]:
    return {
        "problem": comparison.problem,
        "scenarios": comparison.count,
        "seed": comparison.seed,
        "mismatch": comparison.percent,
        "versions": comparison.versions,
        "verdict": comparison.verdict,
        "controllers": {one.name: _summary(one) for one in comparison.summaries},
        "skipped": comparison.skipped,
        "tuning": comparison.tuning,
    }


def _summary(one: Summary) -> dict[str, Any]:
    d = one.difference
    return {
        "median_error": one.median,
        "difference": None if d is None else {"median": d.median, "low": d.low, "high": d.high},
        "ratio": one.ratio,
        "better": one.better,
        "worst_error": one.worst,
        "worst_scenario": one.worst_scenario,
        "rms_error": one.rms_error,
        "metrics": one.metrics,
        "outcomes": one.outcomes,
        "statuses": one.statuses,
        "errors": one.errors.tolist(),
        "mismatch": one.mismatch.tolist(),
    }
