"""The contract of pictures of a report: a title, a caption, the controllers that it shows, and a way to draw their runs.

A problem file names its pictures: `pictures = (fp.Portrait(...), fp.Raster(...))`. A picture draws into an existing figure, so this
module imports no plotting library.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
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


def averaged(values: np.ndarray, columns: int) -> np.ndarray:
    """Return means of equal intervals where there are more values than columns; a shorter series as it is."""
    if values.size <= columns:
        return values
    edges = np.linspace(0, values.size, columns + 1).astype(int)
    return np.asarray(np.add.reduceat(values, edges[:-1]) / np.diff(edges))


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
