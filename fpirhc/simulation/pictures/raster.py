"""Times at which a signal passes a threshold upwards: the spike raster of neurons, one row for each controller."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fpirhc.simulation import drawing
from fpirhc.simulation.pictures.base import Picture, Quantity, caption_axes, numbers
from fpirhc.simulation.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
        caption_axes(axis, drawing.time_label(next(iter(runs.values()))), "")


def passages(times: np.ndarray, values: np.ndarray, threshold: float) -> np.ndarray:
    """Return the first times at which the values are above the threshold, after values at or below it."""
    above = values > threshold
    return times[1:][above[1:] & ~above[:-1]]
