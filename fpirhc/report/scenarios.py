"""Paired scenarios on a terminal, as JSON, as a figure, and as one HTML file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fpirhc.report.outcomes import css_class
from fpirhc.report.page import page, picture, text, wide_table, write_page
from fpirhc.simulation.drawing import PALETTE
from fpirhc.simulation.metrics.columns import Column as Metric
from fpirhc.studies.scenarios.paired import Summary, percent, signed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fpirhc.studies.scenarios.scenario_study import ScenarioComparison

_GROUPS = 6  # of scenarios with similar mismatch, whose medians are joined by a line
_CAPTION = (
    "One point per scenario and controller; lines join medians of scenarios with similar mismatch, crosses at the upper edge "
    "are runs that ended early. Mismatch: rms over the parameters of the relative distance between the model and the drawn "
    "plant. Error: rms error divided by the reference's range, root mean square over the coordinates."
)
_MEANING = (
    "Errors are rms errors divided by the range of the reference, root mean square over the judged coordinates. Every scenario "
    "has the same noise, disturbances and drawn parameters for all controllers; differences are taken within scenarios, and their "
    "intervals are 95 % percentile bootstrap intervals of the median. A run whose error exceeds the reference's range has "
    "diverged; a run that ended early counts as worse than every other run."
)


def mismatch_figure(comparison: ScenarioComparison) -> Figure:
    """Return the figure of the error of every scenario against its mismatch, one colour per controller."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4.8), layout="constrained")
    figure.suptitle(f"{comparison.problem}: error against mismatch, {comparison.count} scenarios", fontsize=11)
    axis = figure.subplots()
    finite = np.concatenate([s.errors[np.isfinite(s.errors)] for s in comparison.summaries])
    edge = 200 * float(finite.max(initial=1e-3))
    for k, one in enumerate(comparison.summaries):
        colour, ended = PALETTE[k % len(PALETTE)], ~np.isfinite(one.errors)
        x, y = 100 * one.mismatch, 100 * one.errors
        axis.semilogy(x[~ended], y[~ended], "o", color=colour, ms=3, alpha=0.5)
        axis.semilogy(x[ended], np.full(ended.sum(), edge), "x", color=colour, ms=6)
        axis.semilogy(*_medians(x[~ended], y[~ended]), "-", color=colour, lw=1.5, label=one.name)
    axis.set_xlabel("mismatch between model and plant [%]")
    axis.set_ylabel("rms error [% of the reference's range]")
    axis.grid(visible=True, alpha=0.25)
    axis.legend(fontsize=8, framealpha=0.8)
    return figure


def _medians(x: np.ndarray, y: np.ndarray) -> tuple[list[float], list[float]]:
    order = np.argsort(x)
    groups = [g for g in np.array_split(order, min(_GROUPS, max(1, x.size // 3))) if g.size]
    return [float(np.median(x[g])) for g in groups], [float(np.median(y[g])) for g in groups]


def write_scenarios(comparison: ScenarioComparison, path: Path) -> None:
    """Write the report, atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    write_page(render_scenarios(comparison), path)


def render_scenarios(comparison: ScenarioComparison) -> str:
    """Return the page's text."""
    first, *others = comparison.verdict
    outcome = next((s.outcome for s in comparison.summaries[1:]), None)  # the first sentence is about the first rival
    rest = "".join(f"<li>{text(s)}</li>" for s in others)
    about = f"<p class='about'>{text(comparison.description)}</p>" if comparison.description else ""
    chart = picture(mismatch_figure(comparison), "Error against mismatch", _CAPTION) if comparison.summaries else ""
    parts = [
        f"<header><h1>{text(comparison.title)}</h1></header>",
        f"<section id='verdict'><p class='headline {css_class(outcome)}'>{text(first)}</p><ul>{rest}</ul>{about}</section>",
        _table(comparison),
        f"<section><h2>Error against mismatch</h2>{chart}</section>",
        _tuning(comparison),
        _settings(comparison),
    ]
    return page(comparison.title, ("report.css",), "\n".join(parts))


def _table(comparison: ScenarioComparison) -> str:
    heads = ["controller", *_heads(comparison), "statuses (cycles)"]
    rows = ""
    for one in comparison.summaries:
        cells = "".join(f"<td>{text(c)}</td>" for c in _cells(comparison, one))
        statuses = ", ".join(f"{n} {name}" for name, n in sorted(one.statuses.items()))
        rows += f"<tr><th scope='row'>{text(one.name)}</th>{cells}<td class='words'>{text(statuses)}</td></tr>"
    for name, why in comparison.skipped.items():
        rows += (
            f"<tr><th scope='row'>{text(name)}</th>"
            f"<td class='words' colspan='{len(heads) - 1}'>not run: {text(why)}</td></tr>"
        )
    return (
        f"<section><h2>Controllers</h2><p>{text(_conditions(comparison))} {text(_MEANING)}</p>"
        f"{wide_table(heads, rows, 'controllers and their metrics')}</section>"
    )


def _conditions(comparison: ScenarioComparison) -> str:
    return (
        f"{comparison.count} scenarios of seed {comparison.seed}, exact parameters within {comparison.percent:g} % of the "
        f"problem's, errors from t = {comparison.measure_from:g} {comparison.time_unit} on."
    )


def _heads(comparison: ScenarioComparison) -> list[str]:
    medians = [f"median {c.short}" for c in comparison.columns]
    return ["median error", "difference (95 %)", "ratio", "smaller in", *medians, "worst", "in scenario", "failures"]


def _cells(comparison: ScenarioComparison, one: Summary) -> list[str]:
    difference, ratio, better = "baseline", "", ""
    if one.difference is not None:
        d = one.difference
        difference = f"{signed(d.median)} ({signed(d.low)} to {signed(d.high)})"
        ratio, better = f"{one.ratio:.3g}", str(one.better)
    failures = ", ".join(f"{n} {outcome}" for outcome, n in one.outcomes.items() if outcome != "finished")
    medians = [_median(c, one) for c in comparison.columns]
    return [
        percent(one.median),
        difference,
        ratio,
        better,
        *medians,
        percent(one.worst),
        str(one.worst_scenario),
        failures or "0",
    ]


def _median(column: Metric, one: Summary) -> str:
    value = one.metrics.get(column.metric.name, {}).get(column.element)
    return column.metric.text(value) if value is not None and np.isfinite(value) else "none"


def _tuning(comparison: ScenarioComparison) -> str:
    if not comparison.tuning:
        words = "No file of tuned settings was given: all settings are those of the problem file."
        return f"<section><h2>Tuning</h2><p>{words}</p></section>"
    items = "".join(f"<li><b>{text(name)}</b>: {text(note)}</li>" for name, note in comparison.tuning.items())
    return f"<section><h2>Tuning</h2><ul>{items}</ul></section>"


def _settings(comparison: ScenarioComparison) -> str:
    dumps = "".join(
        f"<details><summary>{text(name)}</summary><pre>{text(json.dumps(settings, indent=1))}</pre></details>"
        for name, settings in comparison.settings.items()
    )
    versions = ", ".join(f"{k} {v}" for k, v in comparison.versions.items())
    command = (
        f"<p>This report is reproduced by</p><pre class='command'>{text(comparison.command)}</pre>"
        if comparison.command
        else ""
    )
    return (
        f"<section><h2>Settings</h2>{dumps}<p>{text(versions)}; took {comparison.elapsed:.1f} s.</p>{command}</section>"
    )


def show_scenarios(comparison: ScenarioComparison, report: Path) -> None:
    """Print the verdict, the table, and the path of the report."""
    from rich.console import Console

    from fpirhc.report.folding import Column, Folding
    from fpirhc.report.terminal import say

    console = Console()
    for line in (comparison.title, *(f"- {sentence}" for sentence in comparison.verdict)):
        say(console, line)
    heads = ("controller", "median", "difference (95 %)", "ratio", "worst", "failed")
    table = Folding(f"{comparison.problem}: {_conditions(comparison)}", [Column(head) for head in heads])
    for one in comparison.summaries:
        cells = _cells(comparison, one)
        table.add([one.name, *cells[:3], percent(one.worst), str(one.failures)])
    table.show(console)
    for name, note in comparison.tuning.items():
        say(console, f"{name}: {note}")
    for name, why in comparison.skipped.items():
        say(console, f"skipped {name}: {why}")
    say(console, f"report: {report}", wrap=False)


def scenarios_json(comparison: ScenarioComparison) -> str:
    """Return the comparison as JSON text; numbers that are not finite become null."""
    facts = {
        "problem": comparison.problem,
        "scenarios": comparison.count,
        "seed": comparison.seed,
        "mismatch": comparison.percent,
        "versions": dict(comparison.versions),
        "verdict": list(comparison.verdict),
        "controllers": {one.name: _facts(one) for one in comparison.summaries},
        "skipped": dict(comparison.skipped),
        "tuning": dict(comparison.tuning),
    }
    return json.dumps(facts, indent=2, allow_nan=False)


def _facts(one: Summary) -> dict[str, object]:
    d = one.difference
    return {
        "median_error": _number(one.median),
        "difference": None if d is None else {n: _number(getattr(d, n)) for n in ("median", "low", "high")},
        "ratio": _number(one.ratio),
        "better": one.better,
        "worst_error": _number(one.worst),
        "worst_scenario": one.worst_scenario,
        "rms_error": {c: _number(v) for c, v in one.rms_error.items()},
        "metrics": {n: {e: _number(v) for e, v in numbers.items()} for n, numbers in one.metrics.items()},
        "outcomes": dict(one.outcomes),
        "statuses": dict(one.statuses),
        "errors": [_number(v) for v in one.errors],
        "mismatch": [float(v) for v in one.mismatch],
    }


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
