"""A quantity of a population over time: its median, the middle half and nine tenths of the cases, and a range to be kept."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np

from fpirhc.simulation import drawing
from fpirhc.simulation.pictures.base import Kept, Picture, Quantity, caption_axes, label, numbers
from fpirhc.simulation.pictures.heat_map import averaged
from fpirhc.simulation.run import Run

if TYPE_CHECKING:
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
    """

    title: str
    what: str | Quantity
    target: tuple[float, ...] = ()
    caption: str = ""
    controllers: tuple[str, ...] = ()

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
            caption_axes(axis, "", str(cases[0]["up"]))
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
