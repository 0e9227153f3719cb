"""One signal against another: phase portraits, friction over velocity, input over output."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fpirhc.simulation.pictures.base import Picture, Quantity, caption_axes, label, numbers
from fpirhc.simulation.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
            caption_axes(axis, label(run, self.x), label(run, self.y))
