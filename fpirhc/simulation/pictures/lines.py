"""The contract of pictures of a report, a title, a caption and a way to draw runs; lines over time, and one signal against another.

A problem file names its pictures: `pictures = (fp.Portrait(...), fp.OverTime(...))`. A picture draws into an existing figure, so
this module imports no plotting library.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from fpirhc.fields.checked import Checked
from fpirhc.simulation import drawing
from fpirhc.simulation.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure


INTERVALS = 2000  # of a line over time, each drawn by its two extremes


@dataclass(frozen=True, eq=False)
class Quantity:
    """A quantity that a run does not log but that follows from its signals.

    Args:
        name: on the axis.
        unit: on the axis.
        values: function of a Run that returns one number per cycle, shape (cycles,).
    """

    name: str
    unit: str
    values: Callable[[Run], np.ndarray]


class Picture(Checked, ABC):
    """Contract of a picture.

    Every picture has the attributes `title`, `caption` and `controllers`, the names of the controllers that it shows (empty: all).
    """

    title: str
    caption: str
    controllers: tuple[str, ...]

    @abstractmethod
    def size(self, count: int) -> tuple[float, float]:
        """Return width and height in inches for `count` controllers."""

    @abstractmethod
    def draw(self, figure: Figure, runs: Mapping[str, Run]) -> None:
        """Draw the runs, by name of their controller, into an empty figure.

        Raises:
            InvalidName: a run does not have a signal; the message names the nearest one.
        """

    def motion(self, runs: Mapping[str, Run]) -> Mapping[str, object]:  # noqa: ARG002
        """Return what a page needs to play the runs, by name of their controller; nothing where the picture stands still."""
        return {}


def numbers(run: Run, what: str | Quantity) -> np.ndarray:
    """Return the values of a signal or a quantity, shape (cycles,)."""
    return run[what] if isinstance(what, str) else np.asarray(what.values(run), dtype=float)


def label(run: Run, what: str | Quantity) -> str:
    """Return the axis label 'name [unit]' of a signal or a quantity."""
    name, unit = (what.partition(".")[2] or what, run.unit(what)) if isinstance(what, str) else (what.name, what.unit)
    return drawing.literal(f"{name} [{unit}]")


def extremes(times: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return times and values of the extremes of equal intervals in their order; a short series as it is.

    Every n-th value alone would show a command that alternates from cycle to cycle as a smooth line.
    """
    if values.size <= 2 * INTERVALS:
        return times, values
    edges = np.linspace(0, values.size, INTERVALS + 1).astype(int)
    parts = [(a, values[a:b]) for a, b in pairwise(edges)]
    places = np.array([sorted((a + int(np.argmin(v)), a + int(np.argmax(v)))) for a, v in parts]).ravel()
    return times[places], values[places]


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
