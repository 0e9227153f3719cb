"""The pages of comparisons and of scenarios: verdict first, then the tables, charts, pictures, settings."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from fpirhc.errors import InvalidName
from fpirhc.report.figures import contraction_figure, lyapunov_figure, mismatch_figure, pair_figures
from fpirhc.report.page import Image, asset, picture, render_page
from fpirhc.report.series import chart_data
from fpirhc.simulation.drawing import BANDS, PALETTE
from fpirhc.simulation.picture import Drawing
from fpirhc.summary import Column, Table
from fpirhc.whole_file import write_whole

if TYPE_CHECKING:
    from fpirhc.simulation.pictures.base import Picture
    from fpirhc.simulation.run import Run
    from fpirhc.studies.comparison.comparison import Comparison
    from fpirhc.studies.comparison.entry import Entry
    from fpirhc.studies.scenarios.scenario_comparison import ScenarioComparison

_CAPTIONS = {
    "Trajectory tracking": "Nominal (dashed) and realised motion over time.",
    "Phase trajectories": "First derivative against coordinate.",
    "Tracking error": "Nominal minus realised.",
    "Command": "After clipping.",
    "Second derivatives": "With adaptation the realised acceleration lies on the desired one, although the deformed request "
    "is far from both: the wrong model needs this request.",
}
_LYAPUNOV = (
    "V = |S|^2 / 2 of the tracking law, dashed: its ultimate bound (sup|h| / rate)^2 / 2 by the response error h of the "
    "measured part. A small response error keeps V near zero."
)
_CONTRACTION = "Predicted contraction factor against the gain, and the response error's decay"


_MISMATCH = (
    "One point per scenario and controller; lines join medians of scenarios with similar mismatch, crosses at the upper edge "
    "are runs that ended early. Mismatch: rms over the parameters of the relative distance between the model and the drawn "
    "plant. Error: rms error divided by the reference's range, root mean square over the coordinates."
)


def write_report(comparison: Comparison, path: Path) -> None:
    """Write the report, atomically: the file is complete or not there.

    Raises:
        OutputError: the file cannot be written.
    """
    write_whole(render(comparison), path, "report")


def render(comparison: Comparison) -> str:
    """Return the page's text."""
    pair, entries = headline_pair(comparison), comparison.entries
    series = {**chart_data(comparison, PALETTE), "bands": BANDS, "begin": [e.name for e in pair] if pair else []}
    data = json.dumps(series, separators=(",", ":")).replace("<", "\\u003c")
    contraction, lyapunov = contraction_figure(comparison), lyapunov_figure(comparison)
    return render_page(
        "comparison.html",
        comparison.view,
        (asset("uPlot.iife.min.js"), f"const DATA={data};\n{asset('report.js')}"),
        predicted=any(e.prediction is not None and e.prediction.tube is not None for e in entries),
        slots=_slots(comparison),
        bands=BANDS,
        pairs=_pairs(*pair) if pair else [],
        own=own_pictures(comparison),
        contraction=[picture(contraction, _CONTRACTION)] if contraction else [],
        contracts=[f"{e.name}: {e.contraction.report.text}" for e in entries if e.contraction],
        lyapunov=[picture(lyapunov, "Lyapunov function over time with its ultimate bound", _LYAPUNOV)]
        if lyapunov
        else [],
        in_force=_in_force(comparison),
    )


def headline_pair(comparison: Comparison) -> tuple[Entry, Entry] | None:
    """The pair that the verdict begins with; None when there is none."""
    by_name = {e.name: e for e in comparison.entries}
    pairs = [(by_name[e.pair], e) for e in comparison.entries if e.pair in by_name]
    usable = [p for p in pairs if p[0].run.cycles > 1 and p[1].run.cycles > 1]
    named = [p for p in usable if comparison.findings[0].pair == (p[0].name, p[1].name)]
    candidates = named or usable
    return candidates[0] if candidates else None


def _slots(comparison: Comparison) -> dict[tuple[str, ...], list[str]]:
    """Names of controllers by their time slots."""
    by_slots: dict[tuple[str, ...], list[str]] = {}
    for e in comparison.entries:
        if e.run.spans():
            by_slots.setdefault(e.run.layout["desired"].elements, []).append(e.name)
    return by_slots


def _pairs(plain: Entry, adaptive: Entry) -> list[Image]:
    sides = f"{plain.name} on the left, {adaptive.name} on the right"
    return [
        picture(figure, f"{title}: {sides}", f"{title}. {_CAPTIONS.get(title.partition(' [')[0], '')}")
        for title, figure in pair_figures(plain, adaptive).items()
    ]


def own_pictures(comparison: Comparison) -> list[Image]:
    """Return the pictures that the problem file lists; one of whose controllers none ran is left out."""
    runs = {e.name: e.run for e in comparison.entries if e.run.cycles > 1}
    return [image for wanted in comparison.pictures if (image := _own(wanted, runs))]


def _own(wanted: Picture, runs: Mapping[str, Run]) -> Image | None:
    shown = {name: run for name, run in runs.items() if not wanted.controllers or name in wanted.controllers}
    if not shown:
        return None
    figure = Drawing(figsize=wanted.size(len(shown)), layout="constrained")
    try:
        wanted.draw(figure, shown)
    except InvalidName as error:
        return Image("", "", f"{wanted.title} is not drawn: {error}")
    return picture(figure, f"{wanted.title}: {', '.join(shown)}", f"{wanted.title}. {wanted.caption}".strip())


def _in_force(comparison: Comparison) -> Table:
    """The live settings of every run, at its start and wherever they changed."""
    heads = ("controller", f"from [{comparison.time_unit}]", "setting", "number")
    table = Table("settings in force", [Column(head, left=head == "setting") for head in heads])
    for entry in comparison.entries:
        for time, path, value in _new_numbers(entry):
            table.add([entry.name, f"{time:g}", path, f"{value:.6g}"])
    return table


def _new_numbers(entry: Entry) -> Iterator[tuple[float, str, float]]:
    """Time, path and number of every live setting at the start, and of those that changed later."""
    last: Mapping[str, float] = {}
    for time, numbers in entry.run.in_force:
        yield from ((time, path, value) for path, value in numbers.items() if last.get(path) != value)
        last = numbers


def write_scenarios(comparison: ScenarioComparison, path: Path) -> None:
    """Write the report, atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    write_whole(render_scenarios(comparison), path, "report")


def render_scenarios(comparison: ScenarioComparison) -> str:
    """Return the page's text."""
    figure = mismatch_figure(comparison) if comparison.summaries else None
    chart = picture(figure, "Error against mismatch", _MISMATCH) if figure else None
    return render_page("scenarios.html", comparison.view, chart=chart)
