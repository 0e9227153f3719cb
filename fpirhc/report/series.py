"""Time series small enough for a page: extremes of equal intervals, with few digits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fpirhc.simulation.log import shown_motion

if TYPE_CHECKING:
    from fpirhc.simulation.run import Run
    from fpirhc.studies.comparison.comparison import Comparison
    from fpirhc.studies.comparison.entry import Entry

INTERVALS = 300
_REALITY = "reality_state"
_RESPONSES = ("nominal", "desired", "deformed", "realised")


def chart_data(comparison: Comparison, palette: Sequence[str]) -> dict[str, Any]:
    """Return the data of the page's charts: controllers with their colours, and charts with one series per controller."""
    entries = [e for e in comparison.entries if e.run.cycles > 1]
    if not entries:
        return {"controllers": [], "charts": [], "time": [], "timeUnit": comparison.time_unit}
    longest = max(entries, key=lambda e: e.run.cycles).run
    edges = _edges(longest.cycles)
    first = entries[0].run
    names = first.layout["error"].elements
    charts = [
        _chart(f"error of {c}", first.unit(f"error.{c}"), [(e.name, e.run[f"error.{c}"]) for e in entries], edges)
        for c in names
    ]
    for c in names:
        aims = [("set-point", longest[f"setpoint.{c}"])] if "setpoint" in longest.layout else []
        own = [(e.name, e.run[f"{shown_motion(e.run.layout)}.{c}"]) for e in entries]
        lines = [*aims, ("reference", longest[f"reference.{c}"]), *own]
        charts.append(_chart(c, first.unit(f"reference.{c}"), lines, edges))
    for i in first.layout["command"].elements:
        lines = [(e.name, e.run[f"command.{i}"]) for e in entries]
        charts.append(_chart(f"command {i}", first.unit(f"command.{i}"), lines, edges))
    for e in entries:
        for c in e.run.layout["desired"].elements:
            lines = [(signal, e.run[f"{signal}.{c}"]) for signal in _RESPONSES]
            chart = _chart(f"{e.name}: responses of {c}", e.run.unit(f"desired.{c}"), lines, edges)
            charts.append({**chart, "only": e.name})
    charts += _reality_charts(entries, edges)
    charts += [chart for e in entries for chart in _tubes(e, edges)]
    return {
        "controllers": [
            {"name": e.name, "color": palette[k % len(palette)], "slots": _slots(e.run), "changes": _changes(e.run)}
            for k, e in enumerate(entries)
        ],
        "timeUnit": comparison.time_unit,
        "steps": comparison.steps,
        "time": _round(np.repeat(longest.time[edges[:-1]], 2) + _halves(longest, edges)),
        "charts": charts,
    }


def _reality_charts(entries: Sequence[Entry], edges: np.ndarray) -> list[dict[str, Any]]:
    """Charts of realities that are plants: states that the model does not have, and the response that the model expected."""
    real = [e for e in entries if _REALITY in e.run.layout]
    if not real:
        return []
    first, charts = real[0].run, []
    for name in (n for n in first.layout[_REALITY].elements if n not in first.layout["state"].elements):
        column = f"{_REALITY}.{name}"
        charts.append(_chart(f"reality: {name}", first.unit(column), [(e.name, e.run[column]) for e in real], edges))
    return charts + [chart for e in real for chart in _responses(e.name, e.run, edges)]


def _responses(name: str, run: Run, edges: np.ndarray) -> list[dict[str, Any]]:
    """The response that the model expected of the last command, and the real one, by coordinate."""
    if not {"deformed", "plant_realised"} <= set(run.layout.names):
        return []
    charts = []
    for c in run.layout["deformed"].elements:
        requested, real = run[f"deformed.{c}"], run[f"plant_realised.{c}"]
        lines = [("the model expected", np.concatenate([real[:1], requested[:-1]])), ("the reality did", real)]
        title = f"{name}: response of {c}, observer and reality"
        charts.append({**_chart(title, run.unit(f"deformed.{c}"), lines, edges), "only": name})
    return charts


def _tubes(entry: Entry, edges: np.ndarray) -> list[dict[str, Any]]:
    """Charts of every coordinate's distance from the model's own run inside the band that was predicted; none without a tube."""
    prediction, run = entry.prediction, entry.run
    if prediction is None or prediction.tube is None or not np.isfinite(prediction.tube).all():
        return []
    state = "plant_state" if "plant_state" in run.layout else "state"  # of which the band is
    places = {e: k for k, e in enumerate(run.layout[state].elements)}
    count, charts = min(run.cycles, len(prediction.tube)), []
    for c in (c for c in run.layout["error"].elements if c in places):
        half = prediction.tube[:count, places[c]]
        apart = run[f"{state}.{c}"][:count] - prediction.nominal.states[:count, places[c]]
        lines = [("distance", apart), ("predicted at most", half), ("predicted at least", -half)]
        title = f"{entry.name}: {c}, distance from the model's own run"
        charts.append(_chart(title, run.unit(f"error.{c}"), lines, edges) | {"only": entry.name, "band": [2, 3]})
    return charts


def _changes(run: Run) -> list[float]:
    """Times at which live settings changed."""
    return [float(f"{time:.6g}") for time, _ in run.in_force[1:]]


def _slots(run: Run) -> list[list[float]]:
    """Time slots as [start, end, number]; none where there are too many to be seen."""
    spans = run.spans()
    return [[float(f"{a:.6g}"), float(f"{b:.6g}"), slot] for a, b, slot in spans] if len(spans) <= INTERVALS else []


def _edges(cycles: int) -> np.ndarray:
    return np.unique(np.linspace(0, cycles, min(INTERVALS, cycles) + 1).astype(int))


def _halves(run: Run, edges: np.ndarray) -> np.ndarray:
    """Offsets of the two points of every interval: its start and its middle."""
    middle = 0.5 * np.diff(edges) * run.period
    return np.column_stack([np.zeros_like(middle), middle]).ravel()


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


def _round(values: np.ndarray) -> list[float]:
    return [float(f"{v:.5g}") for v in values.tolist()]
