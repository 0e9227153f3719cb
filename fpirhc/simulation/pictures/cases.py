"""Pictures of many cases: bands of a signal over time, and the grid of a population's extremes.

Source of the grid: Magni et al., Evaluating the efficacy of closed-loop glucose regulation via control-variability grid analysis,
J. Diabetes Sci. Technol. 2(4), 2008.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, cast

import numpy as np

from fpirhc.errors import InvalidValue
from fpirhc.simulation import drawing
from fpirhc.simulation.pictures.base import Kept, Picture, Quantity, averaged, label, numbers
from fpirhc.simulation.run import Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLUMNS = 240  # of a case; more cycles than that are averaged
_RANGES = ((0.05, 0.95, 0.18), (0.25, 0.75, 0.35))  # quantiles, and how strongly they are drawn
_TARGET = "#009e73"


@dataclass(frozen=True, eq=False)
class Band(Picture):
    """Panels below each other with the same axes, one for each controller; in a comparison without cases they show one run.

    A line is the median over the cases at each time, the dark band has the cases between the quartiles, the pale one those between
    5 and 95 %, and dotted lines are the extremes. A case that ended early counts as long as it lasted.

    Args:
        title: of the picture.
        what: name of the signal ("output.bis"), or a Quantity.
        target: (low, high) of the range to be kept, shaded; empty: none.
        caption: of the picture.
        controllers: names of those shown; empty: all.
        fold: time after which the axis begins anew, such as a day: every day of every case counts then, as in an ambulatory
            glucose profile; 0: never.
    """

    title: str
    what: str | Quantity
    target: tuple[float, ...] = ()
    caption: str = ""
    controllers: tuple[str, ...] = ()
    fold: float = 0.0
    keeps: ClassVar[bool] = True

    def size(self, count: int) -> tuple[float, float]:
        return 11.0, 2.1 * count + 0.6

    def draw(self, figure: Figure, runs: Mapping[str, Run]) -> None:
        self.draw_cases(figure, {name: [self.kept(run)] for name, run in runs.items()})

    def kept(self, run: Run) -> Kept:
        values, times = averaged(numbers(run, self.what), _COLUMNS), averaged(run.time, _COLUMNS)
        return {
            "up": label(run, self.what),
            "across": drawing.time_label(run),
            "times": times.tolist(),
            "values": values.tolist(),
        }

    def draw_cases(self, figure: Figure, kept: Mapping[str, Sequence[Kept]]) -> None:
        panels = figure.subplots(len(kept), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        for k, (axis, (name, cases)) in enumerate(zip(panels, kept.items(), strict=True)):
            times, values = together(cases)
            if self.fold > 0:
                times, values = folded(times, values, self.fold)
            colour = drawing.PALETTE[k % len(drawing.PALETTE)]
            if self.target:
                axis.axhspan(*self.target, color=_TARGET, alpha=0.1, lw=0)
            for low, high, strength in _RANGES:
                axis.fill_between(
                    times, *np.nanquantile(values, (low, high), axis=0), color=colour, alpha=strength, lw=0
                )
            for extreme in (np.nanmin(values, axis=0), np.nanmax(values, axis=0)):
                axis.plot(times, extreme, color=colour, lw=0.7, ls=":")
            axis.plot(times, np.nanmedian(values, axis=0), color=colour, lw=1.5)
            drawing.caption_axes(axis, "", str(cases[0]["up"]))
            cohort = f" ({len(cases)} cases)" if len(cases) > 1 else ""
            axis.set_title(drawing.literal(f"{name}{cohort}"), fontsize=10)
        panels[-1].set_xlabel(str(next(iter(kept.values()))[0]["across"]))


def together(cases: Sequence[Kept]) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of the longest case, shape (m,), and the values of all at them, shape (cases, m); NaN after their ends."""
    series = [np.array(one["times"], dtype=float) for one in cases]
    times = max(series, key=lambda one: float(one[-1]))
    rows = [
        np.interp(times, own, np.array(cast("list[float]", one["values"])), right=np.nan)
        for own, one in zip(series, cases, strict=True)
    ]
    return times, np.array(rows)


def folded(times: np.ndarray, values: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of one period, and every whole or begun period of every case at them, a row each; NaN after its end."""
    once = times[times < period]
    begins = np.arange(0.0, times[-1], period)
    rows = [np.interp(once + begin, times, case, right=np.nan) for case in values for begin in begins]
    return once, np.array(rows)


ZONES = (("A", "B", "C"), ("B", "B", "D"), ("C", "D", "E"))  # by how low (rows) and how high (columns) a case goes
_COLOURS = {"A": "#009e73", "B": "#8bc34a", "C": "#e69f00", "D": "#e69f00", "E": "#d55e00"}
_EDGES = 4


@dataclass(frozen=True, eq=False)
class Grid(Picture):
    """One panel: how low a case goes to the right, how high upwards; the corner below on the left is the best.

    A: neither far. B: on one or both sides a little too far. C: far on one side alone, the other is corrected too much. D: far on
    one side, and too far on the other. E: far on both. What lies beyond the last edges is drawn at the edge.

    Args:
        title: of the picture.
        what: name of the signal ("output.glucose"), or a Quantity.
        low: four edges of the lowest values, falling: (110, 90, 70, 50) mg/dl.
        high: four edges of the highest values, rising: (110, 180, 300, 400) mg/dl.
        beyond: share of the time that is left out at either end; 0.025 leaves the middle 95 %.
        caption: of the picture.
        controllers: names of those shown; empty: all.

    Raises:
        InvalidValue: edges that are not four, that do not fall, or that do not rise; a share outside 0 to 0.5.
    """

    title: str
    what: str | Quantity
    low: tuple[float, ...]
    high: tuple[float, ...]
    beyond: float = 0.0
    caption: str = ""
    controllers: tuple[str, ...] = ()
    keeps: ClassVar[bool] = True

    def __post_init__(self) -> None:
        for name, edges, sign, way in (("low", self.low, -1, "falling"), ("high", self.high, 1, "rising")):
            if len(edges) != _EDGES or not (np.diff(edges) * sign > 0).all():
                raise InvalidValue(f"Grid({self.title!r}, {name}={edges}): expected {_EDGES} {way} numbers")
        if not 0 <= self.beyond < 0.5:
            raise InvalidValue(f"Grid({self.title!r}, beyond={self.beyond}): expected a share from 0 to below 0.5")

    def size(self, count: int) -> tuple[float, float]:
        del count
        return 8.0, 5.6

    def draw(self, figure: Figure, runs: Mapping[str, Run]) -> None:
        self.draw_cases(figure, {name: [self.kept(run)] for name, run in runs.items()})

    def kept(self, run: Run) -> Kept:
        low, high = np.quantile(numbers(run, self.what), (self.beyond, 1 - self.beyond))
        return {"label": label(run, self.what), "low": float(low), "high": float(high)}

    def zone(self, low: float, high: float) -> str:
        """Return the zone of a case from its extremes."""
        down = sum(low < edge for edge in self.low[1:3])
        up = sum(high > edge for edge in self.high[1:3])
        return ZONES[down][up]

    def draw_cases(self, figure: Figure, kept: Mapping[str, Sequence[Kept]]) -> None:
        axis = figure.subplots()
        self._draw_zones(axis)
        for k, (name, cases) in enumerate(kept.items()):
            points = np.array([(one["low"], one["high"]) for one in cases], dtype=float)
            zones = [self.zone(*one) for one in points.tolist()]
            shares = ", ".join(f"{z} {zones.count(z)}" for z in "ABCDE" if z in zones)
            x = np.clip(points[:, 0], self.low[-1], self.low[0])
            y = np.clip(points[:, 1], self.high[0], self.high[-1])
            colour, text = drawing.PALETTE[k % len(drawing.PALETTE)], drawing.literal(f"{name}: {shares}")
            axis.plot(x, y, "o", color=colour, ms=5, mec="white", mew=0.5, label=text, clip_on=False, zorder=3)
        what = str(next(iter(kept.values()))[0]["label"])
        axis.set_xlabel(f"lowest {what}")
        axis.set_ylabel(f"highest {what}")
        axis.legend(fontsize=8, loc="lower left", bbox_to_anchor=(0, 1.01), frameon=False)  # no corner is free of cases

    def _draw_zones(self, axis: Axes) -> None:
        for row, (right, left) in enumerate(zip(self.low, self.low[1:], strict=False)):
            for column, (below, above) in enumerate(zip(self.high, self.high[1:], strict=False)):
                zone = ZONES[row][column]
                axis.fill_between((right, left), below, above, color=_COLOURS[zone], alpha=0.18, lw=0)
                axis.text((right + left) / 2, (below + above) / 2, zone, ha="center", va="center", alpha=0.5)
        axis.set_xlim(self.low[0], self.low[-1])
        axis.set_ylim(self.high[0], self.high[-1])
        axis.set_xticks(self.low)
        axis.set_yticks(self.high)
