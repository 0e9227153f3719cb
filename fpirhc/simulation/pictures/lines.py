"""Lines and events of runs: signals over time, one signal against another, times at which a signal passes a threshold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from fpirhc.simulation import drawing
from fpirhc.simulation.pictures.base import Picture, Quantity, extremes, label, numbers
from fpirhc.simulation.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class OverTime(Picture):
    """Panels below each other that share the time axis.

    Args:
        title: of the picture.
        panels: one entry for each panel: the name of a signal ("command.u"), or a Quantity.
        caption: of the picture.
        levels: values at which a panel has a dashed line (thresholds, limits), by the panel's signal or quantity name.
        since: time from which the lines are drawn.
        controllers: names of those shown; empty: all.
    """

    title: str
    panels: tuple[str | Quantity, ...]
    caption: str = ""
    levels: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    since: float = 0.0
    controllers: tuple[str, ...] = ()

    def size(self, count: int) -> tuple[float, float]:
        del count
        return 11.0, 2.3 * len(self.panels) + 0.6

    def draw(self, figure: Figure, runs: Mapping[str, Run]) -> None:
        """Draw the panels.

        Raises:
            InvalidName: a run does not have a signal.
        """
        axes = np.atleast_1d(figure.subplots(len(self.panels), 1, sharex=True))
        for axis, what in zip(axes, self.panels, strict=True):
            up = ""
            for name, run in runs.items():
                late = run.time >= self.since
                axis.plot(*extremes(run.time[late], numbers(run, what)[late]), lw=1, label=name)
                up = label(run, what)
            for level in self.levels.get(what if isinstance(what, str) else what.name, ()):
                axis.axhline(level, color="#777777", lw=0.8, ls="--")
            drawing.caption_axes(axis, "", up)
        axes[-1].set_xlabel(drawing.time_label(next(iter(runs.values()))))
        axes[0].legend(
            fontsize=7, ncols=3, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0)
        )  # it hides no line


@dataclass(frozen=True, eq=False)
class Portrait(Picture):
    """A panel for each controller with the same axes: `y` over `x`.

    Args:
        title: of the picture.
        x: the name of a signal ("state.q"), or a Quantity.
        y: the name of a signal, or a Quantity.
        caption: of the picture.
        since: time from which the lines are drawn, in the problem's unit; a later time leaves a transient out.
        controllers: names of those shown; empty: all.
    """

    title: str
    x: str | Quantity
    y: str | Quantity
    caption: str = ""
    since: float = 0.0
    controllers: tuple[str, ...] = ()

    def size(self, count: int) -> tuple[float, float]:
        return max(5.5, 3.7 * count), 3.6

    def draw(self, figure: Figure, runs: Mapping[str, Run]) -> None:
        """Draw the panels.

        Raises:
            InvalidName: a run does not have a signal.
        """
        panels = figure.subplots(1, len(runs), sharex=True, sharey=True, squeeze=False)[0]
        for axis, (name, run) in zip(np.atleast_1d(panels), runs.items(), strict=True):
            late = run.time >= self.since
            axis.plot(numbers(run, self.x)[late], numbers(run, self.y)[late], lw=0.8)
            axis.set_title(name, fontsize=10)
            drawing.caption_axes(axis, label(run, self.x), label(run, self.y))


@dataclass(frozen=True, eq=False)
class Raster(Picture):
    """A row of ticks for each controller, one tick where the signal passes the threshold upwards.

    Args:
        title: of the picture.
        signal: the name of a signal ("state.V"), or a Quantity.
        threshold: in the unit of the signal.
        caption: of the picture.
        controllers: names of those shown; empty: all.
    """

    title: str
    signal: str | Quantity
    threshold: float
    caption: str = ""
    controllers: tuple[str, ...] = ()

    def size(self, count: int) -> tuple[float, float]:
        return 11.0, 0.33 * count + 1.1

    def draw(self, figure: Figure, runs: Mapping[str, Run]) -> None:
        """Draw the rows, the first controller on top.

        Raises:
            InvalidName: a run does not have the signal.
        """
        axis = figure.subplots()
        events = [passages(run.time, numbers(run, self.signal), self.threshold) for run in runs.values()]
        axis.eventplot(events, lineoffsets=[float(k) for k in range(len(runs))], linelengths=0.7, colors="#222222")
        counts = [f"{name} ({len(times)})" for name, times in zip(runs, events, strict=True)]
        axis.set_yticks(np.arange(len(runs)), counts, fontsize=8)
        axis.set_ylim(len(runs) - 0.5, -0.5)
        axis.set_xlim(0, max(float(run.time[-1]) for run in runs.values()))
        drawing.caption_axes(axis, drawing.time_label(next(iter(runs.values()))), "")


def passages(times: np.ndarray, values: np.ndarray, threshold: float) -> np.ndarray:
    """Return the first times at which the values are above the threshold, after values at or below it."""
    above = values > threshold
    return times[1:][above[1:] & ~above[:-1]]
