"""One self-contained HTML file for a comparison: verdict first, then the table, linked charts, pictures, settings."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fpirhc.report.contraction_figure import contraction_figure
from fpirhc.report.figures import lyapunov_figure, pair_figures
from fpirhc.report.outcomes import css_class
from fpirhc.report.page import asset as _asset
from fpirhc.report.page import page, wide_table, write_page
from fpirhc.report.page import picture as _picture
from fpirhc.report.page import text as _text
from fpirhc.report.series import chart_data
from fpirhc.report.wanted import wanted_pictures
from fpirhc.simulation.drawing import BANDS, PALETTE
from fpirhc.simulation.metrics.columns import Column, columns
from fpirhc.studies.comparison.optimality import gap

if TYPE_CHECKING:
    from fpirhc.studies.comparison.compare import Comparison
    from fpirhc.studies.comparison.entry import Entry

_CAPTIONS = {
    "Trajectory tracking": "Nominal (dashed) and realised motion over time.",
    "Phase trajectories": "First derivative against coordinate.",
    "Tracking error": "Nominal minus realised.",
    "Command": "After clipping.",
    "Second derivatives": "With adaptation the realised acceleration lies on the desired one, although the deformed request "
    "is far from both: the wrong model needs this request.",
}

_MISSING, _NONE = "&ndash;", "<span class='none'>none</span>"
_STUDIED = ("cycle median [us]", "p99", "max", "first", "plan median [us]", "cost above optimum: median", "worst")


def write_report(comparison: Comparison, path: Path) -> None:
    """Write the report, atomically: the file is complete or not there.

    Raises:
        OutputError: the file cannot be written.
    """
    write_page(render(comparison), path)


def render(comparison: Comparison) -> str:
    """Return the page's text."""
    pair = headline_pair(comparison)
    series = {**chart_data(comparison, PALETTE), "bands": BANDS, "begin": [e.name for e in pair] if pair else []}
    data = json.dumps(series, separators=(",", ":")).replace("<", "\\u003c")
    parts = [
        f"<header><h1>{_text(comparison.title)}</h1></header>",
        _verdict(comparison),
        _table(comparison),
        _charts(comparison),
        *_pictures(comparison),
        wanted_pictures(comparison),
        _contraction(comparison),
        _lyapunov(comparison),
        _in_force(comparison),
        _settings(comparison),
    ]
    scripts = (_asset("uPlot.iife.min.js"), f"const DATA={data};\n{_asset('report.js')}")
    return page(comparison.title, ("uPlot.min.css", "report.css"), "\n".join(parts), scripts)


def _verdict(comparison: Comparison) -> str:
    (first, outcome), *others = comparison.sentences
    rest = "".join(f"<li class='{css_class(one)}'>{_text(s)}</li>" for s, one in others)
    about = f"<p class='about'>{_text(comparison.description)}</p>" if comparison.description else ""
    return f"<section id='verdict'><p class='headline {css_class(outcome)}'>{_text(first)}</p><ul>{rest}</ul>{about}</section>"


def _number(value: float | None) -> str:
    if value is None:
        return _MISSING
    if math.isnan(value):
        return _NONE
    return f"{value:.3g}"


def _table(comparison: Comparison) -> str:
    entries = comparison.entries
    if not entries:
        return "<section><p>No controller finished.</p></section>"
    shown = columns([e.metrics for e in entries])
    heads = ["controller", *(c.heading for c in shown), *_STUDIED, "statuses (cycles)"]
    best = {c: c.best([c.number(e.metrics) for e in entries if e.run.stop is None]) for c in shown if c.metric.headline}
    rows = "".join(_row(e, shown, best) for e in entries)
    skipped = "".join(
        f"<tr><th scope='row'>{_text(n)}</th><td class='words' colspan='{len(heads) - 1}'>not run: {_text(w)}</td></tr>"
        for n, w in comparison.skipped.items()
    )
    marked = ", ".join(
        dict.fromkeys(c.metric.heading for c in shown if c.metric.headline and c.metric.better != "neither")
    )
    caption = f"Errors, effort and cost from t = {comparison.measure_from:g} {comparison.time_unit} on; seed {comparison.seed}."
    return (
        f"<section><h2>Controllers</h2><p>{caption} Marked are the best of: {_text(marked)}.</p>"
        f"{wide_table(heads, rows + skipped, 'controllers and their metrics')}{_information(comparison)}</section>"
    )


def _information(comparison: Comparison) -> str:
    """What the controllers are given, use, and when they act."""
    if not comparison.information:
        return ""
    lines = "".join(f"<li>{_text(line)}</li>" for line in comparison.information)
    return f"<p>What they measure, and how often:</p><ul id='information'>{lines}</ul>"


def _row(entry: Entry, shown: Sequence[Column], best: Mapping[Column, float | None]) -> str:
    cells = ""
    for column in shown:
        value = column.number(entry.metrics)
        mark = " class='best'" if value is not None and value == best.get(column) else ""
        cells += f"<td{mark}>{column.text(value, missing=_MISSING, none=_NONE)}</td>"
    cells += "".join(f"<td>{v}</td>" for v in _studied(entry))
    words = ", ".join(f"{k.lower().replace('_', ' ')} {v}" for k, v in entry.metrics.statuses.items())
    if entry.run.stop:
        words = f"ended early: {entry.run.stop}"
    notes = "".join(f"<br><small>{_text(n)}</small>" for n in entry.notes)
    return f"<tr><th scope='row'>{_text(entry.name)}{notes}</th>{cells}<td class='words'>{_text(words)}</td></tr>"


def _studied(entry: Entry) -> list[str]:
    """Numbers that were measured after the run: times of a cycle, and the cost of plans above the optimum."""
    cycle, excess = entry.cycle, entry.optimality
    times = (cycle.median, cycle.p99, cycle.maximum, cycle.first) if cycle else (None,) * 4
    planning = cycle.planning if cycle and entry.metrics.solve else None
    gaps = [gap(v, 2) for v in (excess.median, excess.worst)] if excess else [_MISSING] * 2
    return [*(_number(v) for v in (*times, planning)), *gaps]


def _charts(comparison: Comparison) -> str:
    return (
        "<section><h2>Signals over time</h2><p>Drag across a chart to zoom all of them, double-click to return. Lines show "
        f"the extremes of each short interval, so no peak is lost.{_predicted(comparison)}</p>{_bands(comparison)}"
        "<div id='controllers' role='group' aria-label='controllers shown'></div><div id='charts'></div></section>"
    )


def _predicted(comparison: Comparison) -> str:
    """Sentence about the bands of predictions; empty where there is none."""
    if all(e.prediction is None or e.prediction.tube is None for e in comparison.entries):
        return ""
    return (
        " The band around a distance from the model's own run was predicted before the run, to first order and without "
        "disturbances and noise."
    )


def _bands(comparison: Comparison) -> str:
    """Legend of the time slots, one line for controllers whose slots are the same; empty where no controller has slots."""
    slotted = [e for e in comparison.entries if e.run.spans()]
    if not slotted:
        return ""
    by_slots: dict[tuple[str, ...], list[str]] = {}
    for e in slotted:
        by_slots.setdefault(e.run.layout["desired"].elements, []).append(e.name)
    lines = []
    for slots, names in by_slots.items():
        swatches = " ".join(
            f"<span class='band' style='background:{BANDS[k % len(BANDS)]}22;border-color:{BANDS[k % len(BANDS)]}'></span> "
            f"slot {_text(slot)}"
            for k, slot in enumerate(slots)
        )
        lines.append(f"<li>{swatches} ({_text(', '.join(names))})</li>")
    return (
        "<p>Pale bands are the time slots of the chart's own controller, or else of the first shown controller with time slots.</p>"
        f"<ul id='bands'>{''.join(lines)}</ul>"
    )


def _pictures(comparison: Comparison) -> list[str]:
    pair = headline_pair(comparison)
    if pair is None:
        return []
    blocks = []
    for title, figure in pair_figures(*pair).items():
        alt = f"{title}: {pair[0].name} on the left, {pair[1].name} on the right"
        blocks.append(_picture(figure, alt, f"{title}. {_CAPTIONS.get(title.partition(' [')[0], '')}"))
    pictures = f"<div class='pictures'>{''.join(blocks)}</div>"
    return [f"<section><h2>Without | with adaptivity</h2><p>Both sides have the same axes.</p>{pictures}</section>"]


def headline_pair(comparison: Comparison) -> tuple[Entry, Entry] | None:
    """The pair that the verdict begins with; None when there is none."""
    by_name = {e.name: e for e in comparison.entries}
    pairs = [(by_name[e.pair], e) for e in comparison.entries if e.pair in by_name]
    usable = [p for p in pairs if p[0].run.cycles > 1 and p[1].run.cycles > 1]
    named = [p for p in usable if comparison.findings[0].pair == (p[0].name, p[1].name)]
    candidates = named or usable
    return candidates[0] if candidates else None


def _contraction(comparison: Comparison) -> str:
    figure = contraction_figure(comparison)
    if figure is None:
        return ""
    texts = "".join(
        f"<li><b>{_text(e.name)}</b>: {_text(e.contraction.report.text)}</li>"
        for e in comparison.entries
        if e.contraction
    )
    picture = _picture(figure, "Predicted contraction factor against the gain, and the response error's decay", "")
    return f"<section><h2>Contraction</h2>{picture}<ul>{texts}</ul></section>"


def _lyapunov(comparison: Comparison) -> str:
    figure = lyapunov_figure(comparison)
    if figure is None:
        return ""
    caption = (
        "V = |S|^2 / 2 of the tracking law, dashed: its ultimate bound (sup|h| / rate)^2 / 2 by the response error h of the "
        "measured part. A small response error keeps V near zero."
    )
    picture = _picture(figure, "Lyapunov function over time with its ultimate bound", caption)
    return f"<section><h2>Lyapunov's view</h2>{picture}</section>"


def _in_force(comparison: Comparison) -> str:
    """Table of the live settings of every run, at its start and wherever they changed; empty where no run has any."""
    rows = "".join(
        f"<tr><th scope='row'>{_text(entry.name)}</th><td>{time:g}</td><td class='words'>{_text(path)}</td>"
        f"<td>{value:.6g}</td></tr>"
        for entry in comparison.entries
        for time, path, value in _new_numbers(entry)
    )
    if not rows:
        return ""
    heads = ["controller", f"from [{comparison.time_unit}]", "setting", "number"]
    words = "A number is in force from its time until the next one of the same setting. Dotted lines in the charts are changes."
    table = wide_table(heads, rows, "live settings and the times from which they were in force")
    return f"<section id='in-force'><h2>Settings in force</h2><p>{words}</p>{table}</section>"


def _new_numbers(entry: Entry) -> Iterator[tuple[float, str, float]]:
    """Time, path and number of every live setting at the start, and of those that changed later."""
    last: Mapping[str, float] = {}
    for time, numbers in entry.run.in_force:
        yield from ((time, path, value) for path, value in numbers.items() if last.get(path) != value)
        last = numbers


def _settings(comparison: Comparison) -> str:
    versions = ", ".join(f"{k} {v}" for k, v in comparison.versions.items())
    dumps = "".join(
        f"<details><summary>{_text(name)}</summary><pre>{_text(json.dumps(settings, indent=1))}</pre></details>"
        for name, settings in [
            ("problem", comparison.settings),
            *((e.name, {k: v for k, v in e.run.settings.items() if k != "problem"}) for e in comparison.entries),
        ]
    )
    command = (
        f"<p>This report is reproduced by</p><pre class='command'>{_text(comparison.command)}</pre>"
        if comparison.command
        else ""
    )
    return (
        f"<section><h2>Settings</h2>{dumps}<p>{_text(versions)}; took {comparison.elapsed:.1f} s.</p>"
        f"{command}</section>"
    )
