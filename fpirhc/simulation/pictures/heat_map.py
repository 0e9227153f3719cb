"""A quantity over time and place: traffic along a road, temperatures along a rod; one panel for each controller."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fpirhc.errors import InvalidValue
from fpirhc.simulation import drawing
from fpirhc.simulation.pictures.base import Picture, Quantity, averaged, numbers
from fpirhc.simulation.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLUMNS = 1000  # of a panel; more cycles than that are averaged


@dataclass(frozen=True, eq=False)
class HeatMap(Picture):
    """Panels below each other with the same times and the same scale of colours; a row is a place.

    Args:
        title: of the picture.
        rows: names of the signals ("state.rho1"), or Quantities, from the bottom to the top; all have one unit.
        place: what a row is, on the axis ("segment"); rows are counted from 1.
        quantity: what the colours show ("density"), before the unit at the scale.
        caption: of the picture.
        controllers: names of those shown; empty: all.

    Raises:
        InvalidValue: no row.
    """

    title: str
    rows: tuple[str | Quantity, ...]
    place: str = "place"
    quantity: str = ""
    caption: str = ""
    controllers: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.rows:
            raise InvalidValue(f"HeatMap({self.title!r}, rows=()): expected at least one signal, such as 'state.q'")

    def size(self, count: int) -> tuple[float, float]:
        return 11.0, 1.6 * count + 0.6

    def draw(self, figure: Figure, runs: Mapping[str, Run]) -> None:
        """Draw the panels, the first controller on top.

        Raises:
            InvalidName: a run does not have a signal.
            InvalidValue: the rows have different units.
        """
        unit = self._unit(next(iter(runs.values())))
        maps = {name: [averaged(numbers(run, row), _COLUMNS) for row in self.rows] for name, run in runs.items()}
        every = np.concatenate([np.ravel(values) for values in maps.values()])
        scale = {"vmin": np.nanmin(every), "vmax": np.nanmax(every)}
        panels = figure.subplots(len(runs), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        for axis, (name, run) in zip(panels, runs.items(), strict=True):
            times = averaged(run.time, _COLUMNS)
            shown = axis.pcolormesh(times, range(1, len(self.rows) + 1), maps[name], shading="nearest", **scale)
            axis.set_title(drawing.literal(name), fontsize=10)
            axis.set_ylabel(drawing.literal(self.place))
            axis.set_yticks(range(1, len(self.rows) + 1))
        panels[-1].set_xlabel(drawing.time_label(next(iter(runs.values()))))
        figure.colorbar(shown, ax=list(panels), label=drawing.literal(f"{self.quantity} [{unit}]".strip()))

    def _unit(self, run: Run) -> str:
        units = {run.unit(row) if isinstance(row, str) else row.unit: row for row in self.rows}
        if len(units) > 1:
            raise InvalidValue(
                f"HeatMap {self.title!r}: one scale of colours shows one unit, and rows have {', '.join(units)}"
            )
        return next(iter(units))
