"""The figure of one run."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fpirhc.simulation.common_columns import shown_motion
from fpirhc.simulation.drawing import (
    PALETTE,
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
    from matplotlib.figure import Figure


def run_figure(run: Log) -> Figure:
    """Return a figure with errors, coordinates, commands and responses of one run over time."""
    figure = new_figure(10, 9, f"{run.controller}" + (f" ({run.stop})" if run.stop else ""))
    names = run.layout["error"].elements
    axes = figure.subplots(4, 1, sharex=True)
    for k, name in enumerate(names):
        draw_line(axes[0], run, f"error.{name}", name, PALETTE[k])
        draw_line(axes[1], run, f"{shown_motion(run.layout)}.{name}", name, PALETTE[k])
        draw_line(axes[1], run, f"reference.{name}", f"{name} reference", PALETTE[k], "--")
        if "setpoint" in run.layout:
            draw_line(axes[1], run, f"setpoint.{name}", f"{name} set-point", PALETTE[k], ":")
    for k, name in enumerate(run.layout["command"].elements):
        draw_line(axes[2], run, f"command.{name}", name, PALETTE[k])
    first = run.layout["desired"].elements[0]
    draw_responses(axes[3], run, first)
    labels = (
        f"error of {quantity_label(run, 'error', names)}",
        quantity_label(run, shown_motion(run.layout), names),
        quantity_label(run, "command", run.layout["command"].elements),
        f"responses of {quantity_label(run, 'desired', [first])}",
    )
    for axis, label in zip(axes, labels, strict=True):
        draw_bands(axis, run)
        draw_changes(axis, run)
        axis.set_ylabel(label)
        draw_legend(axis)
    axes[3].set_xlabel(time_label(run))
    return figure
