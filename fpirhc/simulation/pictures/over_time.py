"""Signals over time: one panel for each signal, with the lines of all controllers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from fpirhc.simulation import drawing
from fpirhc.simulation.pictures.base import Picture, Quantity, caption_axes, extremes, label, numbers
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
            caption_axes(axis, "", up)
        axes[-1].set_xlabel(drawing.time_label(next(iter(runs.values()))))
        axes[0].legend(fontsize=7, loc="best", framealpha=0.8)
