"""The figure of a run, and parts that figures share: colours, lines with units, time slots, responses."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from colorsys import hsv_to_rgb
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from fpirhc.summary import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from fpirhc.simulation.picture import Drawing
    from fpirhc.simulation.run import Run
    from fpirhc.symbolic.layout import Layout


PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#5b4a9c", "#8c6d1f", "#7f7f7f", "#111111")
BANDS = ("#7f7f7f", "#e69f00", "#56b4e9", "#cc79a7")  # of time slots, drawn pale
_GOLDEN = 0.618034  # of a turn, from hue to hue
_RESPONSES = {"nominal": "#009e73", "desired": "#0072b2", "deformed": "#e69f00", "realised": "#d55e00"}
_INTERVALS = 2000  # of a line over time, each drawn by its two extremes
_SHORTEST = 12  # characters of a name that was cut
_LABEL, _NAME = 28, 48  # characters of a label of an axis, a name in a legend
_TALL = 20  # largest over usual size from which the range of a panel is cut, so that one spike does not hide the rest


def new_figure(width: float, height: float, title: str = "") -> Drawing:
    """Return an empty figure of this size in inches, with the title as literal text."""
    from fpirhc.simulation.picture import Drawing

    figure = Drawing(figsize=(width, height), layout="constrained")
    if title:
        figure.suptitle(literal(title), fontsize=11)
    return figure


def literal(text: str) -> str:
    """Return a name or unit as matplotlib shows it literally: a pair of dollar signs would be read as a formula."""
    return printable(text).replace("$", r"\$")


def time_label(run: Run) -> str:
    """Return the label of a time axis: 'time [s]'."""
    return literal(f"time [{run.time_unit}]")


def quantity_label(run: Run, signal: str, names: Sequence[str], what: str = "") -> str:
    """Return the label of an axis that shows these entries of a signal, with their unit where they have one in common.

    `what` they are of the names, such as 'error of '. Where the names are too long for a label, it says that there are several.
    """
    units = list(dict.fromkeys(run.unit(f"{signal}.{name}") for name in names))
    shown, unit = ", ".join(names), f" [{units[0]}]" if len(units) == 1 else ""
    if len(what + shown) > _LABEL:
        shown = "several" if len(names) > 1 else _cut(names[0], max(_LABEL - len(what + unit), _SHORTEST))
    return literal(what + shown + unit)


def by_unit(run: Run, signal: str, names: Sequence[str]) -> dict[str, list[str]]:
    """Return these entries of a signal by their unit, in their order: a chart has one unit."""
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(run.unit(f"{signal}.{name}"), []).append(name)
    return groups


def extremes(times: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return times and values of the extremes of equal intervals in their order; a short series as it is.

    Every n-th value alone would show a command that alternates from cycle to cycle as a smooth line.
    """
    if values.size <= 2 * _INTERVALS:
        return times, values
    edges = np.linspace(0, values.size, _INTERVALS + 1).astype(int)
    parts = [(a, values[a:b]) for a, b in pairwise(edges)]
    places = np.array([sorted((a + int(np.argmin(v)), a + int(np.argmax(v)))) for a, v in parts]).ravel()
    return times[places], values[places]


def draw_line(axis: Axes, run: Run, column: str, label: str, color: str, style: str = "-") -> None:
    """Draw one column of a run over time; its unit stands in the legend."""
    name = literal(f"{label} [{run.unit(column)}]")
    axis.plot(*extremes(run.time, run[column]), style, color=color, lw=1, label=name)
    axis.grid(visible=True, alpha=0.25)


def draw_legend(axis: Axes) -> None:
    """Add a legend where something has a label, each label once."""
    handles, labels = axis.get_legend_handles_labels()
    named = {_cut(label, _NAME): handle for handle, label in zip(handles, labels, strict=True)}
    if named:
        axis.legend(named.values(), named, fontsize=8, loc="best", framealpha=0.8)


def _cut(name: str, length: int) -> str:
    """A name without its middle where it is too long."""
    side = (length - len("...")) // 2
    return name if len(name) <= length else f"{name[:side]}...{name[-side:]}"


def draw_responses(axis: Axes, run: Run, names: Sequence[str], _: str) -> None:
    """Draw the nominal, desired, deformed and realised response of the first coordinate; a spike does not hide the rest."""
    columns = {what: f"{signal}.{names[0]}" for what, signal in responses_of(run.layout).items()}
    for what, column in columns.items():
        draw_line(
            axis, run, column, f"{names[0]} {what}", _RESPONSES[what], {"deformed": "--", "nominal": ":"}.get(what, "-")
        )
    values = np.abs(np.concatenate([run[column] for column in columns.values()])) if run.cycles else np.zeros(1)
    usual = float(np.quantile(values, 0.99))
    if usual > 0 and values.max() > _TALL * usual:
        axis.set_ylim(-3 * usual, 3 * usual)
    show_usual(axis.set_ylim, run, columns.values())


def show_usual(limit: Callable[[float, float], object], run: Run, columns: Iterable[str]) -> None:
    """Limit the range of an axis where the run ended early: what it reached at last does not hide the rest."""
    values = np.concatenate([run[column] for column in columns])
    most = _TALL * float(np.median(np.abs(values))) if run.stop and values.size else 0.0
    if 0 < most < np.abs(values).max():
        low, high = max(values.min(), -most), min(values.max(), most)
        edge = 0.05 * (high - low)
        limit(low - edge, high + edge)


def draw_signal(axis: Axes, run: Run, names: Sequence[str], signal: str) -> None:
    """Draw entries of a signal of a run over time, each in its colour."""
    for k, name in enumerate(names):
        draw_line(axis, run, f"{signal}.{name}", name, PALETTE[k % len(PALETTE)])
    show_usual(axis.set_ylim, run, [f"{signal}.{name}" for name in names])


def caption_axes(axis: Axes, across: str, up: str) -> None:
    """Label the two directions of an axis with texts that are `literal` already, and draw a pale grid."""
    axis.set_xlabel(across)
    axis.set_ylabel(up)
    axis.grid(visible=True, alpha=0.25)


def shown_motion(layout: Layout) -> str:
    """Return the name of the signal that the controller is given of what is judged: 'output' or 'state'."""
    return "output" if "output" in layout else "state"


def colours_of(names: Collection[str]) -> dict[str, str]:
    """Return the colour of every controller of a problem file by its place in it, whichever others run; no two have the same."""
    more = (hsv_to_rgb((k * _GOLDEN) % 1, 0.75, 0.6) for k in range(len(names)))
    extra = (f"#{''.join(f'{round(255 * one):02x}' for one in colour)}" for colour in more)
    return dict(zip(names, (*PALETTE, *extra), strict=False))


def responses_of(layout: Layout) -> dict[str, str]:
    """Return the columns of responses by what they are, the lowest first: those of time slots are found from what is measured."""
    own = "realised_of_slots" in layout
    return {"realised": "realised_of_slots" if own else "realised"} | {n: n for n in ("deformed", "desired", "nominal")}


def run_figure(run: Run) -> Figure:
    """Return a figure with errors, coordinates, commands and responses of one run over time, one chart per unit."""
    judged, inputs = (by_unit(run, signal, run.layout[signal].elements).values() for signal in ("error", "command"))
    panels = [
        *(("error", "error of ", draw_signal, names) for names in judged),
        *((shown_motion(run.layout), "", _draw_motion, names) for names in judged),
        *(("command", "", draw_signal, names) for names in inputs),
        ("desired", "responses of ", draw_responses, run.layout["desired"].elements[:1]),
    ]
    figure = new_figure(10, 2.25 * len(panels), f"{run.controller}" + (f" ({run.stop})" if run.stop else ""))
    axes = figure.subplots(len(panels), 1, sharex=True)
    for axis, (signal, what, draw, names) in zip(axes, panels, strict=True):
        draw(axis, run, names, signal)
        axis.set_ylabel(quantity_label(run, signal, names, what))
        for start, end, slot in run.spans():
            name = run.layout["desired"].elements[slot]
            axis.axvspan(start, end, color=BANDS[slot % len(BANDS)], alpha=0.12, lw=0, label=f"slot {name}")
        draw_legend(axis)
    axes[-1].set_xlabel(time_label(run))
    return figure


def _draw_motion(axis: Axes, run: Run, names: Sequence[str], signal: str) -> None:
    for k, name in enumerate(names):
        color = PALETTE[k % len(PALETTE)]
        draw_line(axis, run, f"{signal}.{name}", name, color)
        draw_line(axis, run, f"reference.{name}", f"{name} reference", color, "--")
        if "setpoint" in run.layout:
            draw_line(axis, run, f"setpoint.{name}", f"{name} set-point", color, ":")
    show_usual(axis.set_ylim, run, [f"{one}.{name}" for one in (signal, "reference") for name in names])
