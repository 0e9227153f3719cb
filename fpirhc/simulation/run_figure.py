"""The figure of one run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from fpirhc.simulation.common_columns import shown_motion
from fpirhc.simulation.drawing import (
    PALETTE,
    by_unit,
    draw_bands,
    draw_changes,
    draw_legend,
    draw_line,
    draw_responses,
    new_figure,
    quantity_label,
    time_label,
)
from fpirhc.simulation.log import Log

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def run_figure(run: Log) -> Figure:
    """Return a figure with errors, coordinates, commands and responses of one run over time, one chart per unit."""
    judged, inputs = run.layout["error"].elements, run.layout["command"].elements
    panels = [
        *((_draw_errors, names) for names in by_unit(run, "error", judged).values()),
        *((_draw_motion, names) for names in by_unit(run, "error", judged).values()),
        *((_draw_commands, names) for names in by_unit(run, "command", inputs).values()),
        (_draw_first_response, run.layout["desired"].elements[:1]),
    ]
    figure = new_figure(10, 2.25 * len(panels), f"{run.controller}" + (f" ({run.stop})" if run.stop else ""))
    axes = figure.subplots(len(panels), 1, sharex=True)
    for axis, (draw, names) in zip(axes, panels, strict=True):
        axis.set_ylabel(draw(axis, run, names))
        draw_bands(axis, run)
        draw_changes(axis, run)
        draw_legend(axis)
    axes[-1].set_xlabel(time_label(run))
    return figure


def _draw_errors(axis: Axes, run: Log, names: Sequence[str]) -> str:
    for k, name in enumerate(names):
        draw_line(axis, run, f"error.{name}", name, PALETTE[k % len(PALETTE)])
    return f"error of {quantity_label(run, 'error', names)}"


def _draw_motion(axis: Axes, run: Log, names: Sequence[str]) -> str:
    for k, name in enumerate(names):
        color = PALETTE[k % len(PALETTE)]
        draw_line(axis, run, f"{shown_motion(run.layout)}.{name}", name, color)
        draw_line(axis, run, f"reference.{name}", f"{name} reference", color, "--")
        if "setpoint" in run.layout:
            draw_line(axis, run, f"setpoint.{name}", f"{name} set-point", color, ":")
    return quantity_label(run, shown_motion(run.layout), names)


def _draw_commands(axis: Axes, run: Log, names: Sequence[str]) -> str:
    for k, name in enumerate(names):
        draw_line(axis, run, f"command.{name}", name, PALETTE[k % len(PALETTE)])
    return quantity_label(run, "command", names)


def _draw_first_response(axis: Axes, run: Log, names: Sequence[str]) -> str:
    draw_responses(axis, run, names[0])
    return f"responses of {quantity_label(run, 'desired', names)}"
