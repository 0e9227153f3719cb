"""HTML reports: one self-contained file with its styles, scripts and pictures inside, from a template and a view."""

from __future__ import annotations

import base64
import hashlib
import json
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fpirhc.errors import FpirhcError
from fpirhc.simulation.drawing import BANDS, colours_of, new_figure, responses_of, shown_motion
from fpirhc.simulation.pictures import player
from fpirhc.studies import finite_alone
from fpirhc.studies.verdict import IN_FULL, Outcome
from fpirhc.summary import HELD
from fpirhc.whole_file import write_whole

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

    from fpirhc.simulation.picture import Drawing
    from fpirhc.studies import View
    from fpirhc.studies.compare import Comparison


@dataclass(frozen=True)
class Image:
    """A picture inside a page; one that cannot be drawn has no source, and its caption says why."""

    source: str
    alt: str
    caption: str = ""


def write_report(comparison: Comparison, path: Path) -> None:
    """Write the report, atomically: the file is complete or not there.

    Raises:
        OutputError: the file cannot be written.
    """
    write_whole(render(comparison), path, "report")


def render(comparison: Comparison) -> str:
    """Return the page's text."""
    own, motions = own_pictures(comparison)
    begin = [*(comparison.findings[0].pair or ())]
    series = {**chart_data(comparison), "bands": BANDS, "begin": begin, "motions": motions}
    data = json.dumps(series, separators=(",", ":")).replace("<", "\\u003c")  # no text ends the script
    scripts = asset("uPlot.iife.min.js"), asset("axes.js"), *([player()] if motions else [])
    slots: dict[tuple[str, ...], list[str]] = {}  # names of controllers by their time slots
    for e in comparison.entries:
        if e.run.spans():
            slots.setdefault(e.run.layout["desired"].elements, []).append(e.name)
    drawn = {line["name"] for chart in series["charts"] if "only" in chart for line in chart["series"]}
    return render_page(
        "comparison.html",
        comparison.view,
        (*scripts, f"const DATA={data};\n{asset('report.js')}"),
        slots=slots,
        curves={n: what for n, what in CURVES.items() if n in drawn},
        bands=BANDS,
        real=any("real" in chart for chart in series["charts"]),
        own=own,
        motions=motions,
    )


CURVES = {
    "nominal": "what the plan or the reference foresees",
    "desired": "what the controller wants, with feedback of the error",
    "deformed": "the request that the model gets in its place, where it differs",
    "realised": "what the plant did",
}  # of responses


def own_pictures(comparison: Comparison) -> tuple[list[Image], list[dict[str, Any]]]:
    """Return the pictures that the problem file lists, and those that move; one of whose controllers none ran is left out."""
    from matplotlib import rc_context, rcsetup

    runs, images, motions = {e.name: e.run for e in comparison.entries if e.run.cycles > 1}, [], []
    colours = colours_of(comparison.task.controllers)
    for wanted in comparison.task.pictures:
        shown = {name: run for name, run in runs.items() if not wanted.controllers or name in wanted.controllers}
        if not shown:
            continue
        try:
            if motion := dict(wanted.motion(shown)):
                motions.append(motion)
                continue
            with rc_context({"axes.prop_cycle": rcsetup.cycler(color=[colours[name] for name in shown])}):
                wanted.draw(figure := new_figure(*wanted.size(len(shown))), runs=shown)
                caption = f"{wanted.title}. {wanted.caption}".strip()
                images.append(Image(figure.address, f"{wanted.title}: {', '.join(shown)}", caption))
        except FpirhcError as error:
            images.append(Image("", "", f"{wanted.title} is not drawn: {error}"))
    return images, motions


def render_charted(view: View, figure: Drawing | None = None) -> str:
    """Return the text of a page, with a figure of every run where there is one."""
    return render_page("page.html", view, chart=Image(figure.address, "Every run") if figure else None)


def render_page(name: str, view: View, scripts: Sequence[str] = (), **context: Any) -> str:
    """Return a page's text.

    The page loads nothing from anywhere, and a browser that reads its content security policy also refuses to: it runs the
    page's own scripts alone, which are named by their hashes, and shows pictures that are inside the page.

    Args:
        scripts: texts of the page's scripts, which run in this order after those of every page.
    """
    from markupsafe import Markup

    every = [Markup(script) for script in scripts]
    styles = [Markup(asset(style)) for style in ("uPlot.min.css", "report.css")]
    template = _environment().get_template(name)
    digests = (base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii") for script in scripts)
    hashes = " ".join(f"'sha256-{one}'" for one in digests)
    policy = (
        f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )
    context |= {"in_full": IN_FULL, "policy": Markup(policy), "chart": context.get("chart")}
    return template.render(view=view, styles=styles, scripts=every, **context)


@cache
def blocks(text: str) -> list[tuple[bool, str]]:
    """Return the paragraphs of a description, each with whether it is set as written, as indented equations and tables are."""
    blocks = (block for block in text.strip("\n").split("\n\n") if block.strip())
    return [(True, textwrap.dedent(b)) if b.startswith("  ") else (False, " ".join(b.split())) for b in blocks]


def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader(__package__)
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.filters |= {"css_class": css_class, "whole_numbers": whole_numbers, "blocks": blocks}
    return environment


def whole_numbers(text: str) -> Markup:
    """Return a sentence as HTML whose lines do not end inside a number, or between a number and its unit."""
    from markupsafe import Markup, escape

    return Markup(str(escape(HELD.sub("\N{NO-BREAK SPACE}", text))).replace("-&gt;", "→"))


def css_class(outcome: Outcome | None) -> str:
    """Return the class of a sentence: green is better, red worse, amber mixed or doubtful."""
    return "remark" if outcome is None else f"outcome-{outcome.value.replace(' ', '-')}"


def asset(name: str) -> str:
    """Return the text of a style or script."""
    return files("fpirhc.report").joinpath("assets", name).read_text(encoding="utf-8")


INTERVALS = 300


def chart_data(comparison: Comparison) -> dict[str, Any]:
    """Return the data of the page's charts: controllers with their colours, and charts with one series per controller."""
    entries = [e for e in comparison.entries if e.run.cycles > 1]
    if not entries:
        return {"controllers": [], "timeUnit": comparison.task.problem.time_unit, "time": [], "charts": []}
    longest = max(entries, key=lambda e: e.run.cycles).run
    edges = np.unique(np.linspace(0, longest.cycles, min(INTERVALS, longest.cycles) + 1).astype(int))
    first, colours = entries[0].run, colours_of(comparison.task.controllers)
    names, inputs = first.layout["error"].elements, first.layout["command"].elements
    limits = {one.name: one for e in entries for one in e.limits}
    ends = {n: finite_alone(_round([one.lower, one.upper])) for n, one in limits.items()}
    charts = [
        _chart(f"error of {c}", first.unit(f"error.{c}"), [(e.name, e.run[f"error.{c}"]) for e in entries], edges)
        for c in names
    ]
    for c in names:
        aims = [("set-point", longest[f"setpoint.{c}"])] if "setpoint" in longest.layout else []
        own = [(e.name, e.run[f"{shown_motion(e.run.layout)}.{c}"]) for e in entries]
        lines = [*aims, ("reference", longest[f"reference.{c}"]), *own]
        charts.append({**_chart(c, first.unit(f"reference.{c}"), lines, edges), "limits": ends.get(c, [])})
    for n in (*inputs, *(n for n in limits if n not in (*names, *inputs))):
        lines = [(e.name, one.values) for e in entries for one in e.limits if one.name == n]
        title = f"command {n}" if n in inputs else n
        charts.append({**_chart(title, limits[n].unit, lines, edges), "limits": ends[n]})
    for e in entries:
        for c in e.run.layout["desired"].elements:
            lines = [(what, e.run[f"{signal}.{c}"]) for what, signal in responses_of(e.run.layout).items()]
            aim = e.run[f"desired.{c}"]  # what lies on it everywhere is not drawn too
            lines = [(n, v) for n, v in lines if n in ("desired", "realised") or not np.array_equal(v, aim)]
            chart = _chart(f"{e.name}: responses of {c}", e.run.unit(f"desired.{c}"), lines, edges)
            charts.append({**chart, "only": e.name})
    real = [e for e in entries if "reality_state" in e.run.layout]
    for n in real[0].run.layout["reality_state"].elements if real else ():
        if n not in real[0].run.layout["state"].elements:  # the model does not have it
            lines = [(e.name, e.run[f"reality_state.{n}"]) for e in real]
            charts.append({**_chart(n, real[0].run.unit(f"reality_state.{n}"), lines, edges), "real": True})
    middles = 0.5 * np.diff(edges) * longest.period
    shown = [{"name": e.name, "color": colours[e.name], "ended": bool(e.run.stop)} for e in entries]
    for one, e in zip(shown, entries, strict=True):
        spans = e.run.spans()  # too many are not seen
        one["slots"] = [[*_round(span[:2]), span[2]] for span in spans] if len(spans) <= INTERVALS else []
    times = _round(np.repeat(longest.time[edges[:-1]], 2) + np.outer(middles, (0, 1)).ravel())
    return {"controllers": shown, "timeUnit": comparison.task.problem.time_unit, "time": times, "charts": charts}


def _chart(title: str, unit: str, lines: Sequence[tuple[str, np.ndarray]], edges: np.ndarray) -> dict[str, Any]:
    return {"title": title, "unit": unit, "series": [{"name": n, "values": _extremes(v, edges)} for n, v in lines]}


def _extremes(values: np.ndarray, edges: np.ndarray) -> list[float | None]:
    """Two values per interval: its extremes in the order in which they occur; None where the run had ended."""
    begins = edges[:-1][edges[:-1] < len(values)]
    if not len(begins):
        return [None] * (2 * (len(edges) - 1))
    width = int(np.diff(edges).max())  # an interval that is shorter repeats its last value
    ends = np.minimum(edges[1 : len(begins) + 1], len(values))
    parts = values[np.minimum(begins[:, None] + np.arange(width), ends[:, None] - 1)]
    places = np.sort(np.column_stack([parts.argmin(axis=1), parts.argmax(axis=1)]))
    extremes = np.take_along_axis(parts, places, axis=1).ravel()
    return [*_round(extremes), *[None] * (2 * (len(edges) - 1 - len(begins)))]


def _round(values: Sequence[float] | np.ndarray) -> list[float]:
    return [float(f"{v:.5g}") for v in np.asarray(values).tolist()]
