"""The log of a run: every signal of a closed loop by name and unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from fpirhc.by_name import ByName, FoundByName
from fpirhc.errors import InvalidName, nearest
from fpirhc.symbolic.layout import Layout


@dataclass(frozen=True, eq=False)
class Log(FoundByName):
    """What one closed-loop run recorded; the fields are described at `Run`."""

    problem: str
    controller: str
    seed: int
    period: float
    layout: Layout
    log: np.ndarray
    stop: str | None
    compiled: bool
    settings: Mapping[str, object]

    def __getitem__(self, name: str) -> np.ndarray:
        if name in self.layout:
            return self.log[:, self.layout.slice(name)]
        if name in self.layout.columns:
            return self.log[:, self.layout.columns.index(name)]
        raise self._unknown(name)

    @property
    def time(self) -> np.ndarray:
        """Time of every cycle, shape (cycles,), in `time_unit`."""
        return self["time"][:, 0]

    @property
    def time_unit(self) -> str:
        """Unit of time, as the plant names it."""
        return self.unit("time")

    @property
    def in_force(self) -> tuple[tuple[float, Mapping[str, float]], ...]:
        """Times from which numbers of live settings were in force, with the numbers by path; empty without live settings."""
        record = cast(Sequence[tuple[float, Mapping[str, float]]], self.settings.get("live", ()))
        return tuple((float(time), ByName(numbers, "Run.in_force")) for time, numbers in record)

    @property
    def cycles(self) -> int:
        """Number of cycles that were run."""
        return int(self.log.shape[0])

    def spans(self) -> list[tuple[float, float, int]]:
        """Return the time slots as (start, end, number of the slot); empty where the controller has none."""
        if "slot" not in self.layout or not self.cycles:
            return []
        slots = self["slot"][:, 0].astype(int)
        starts = [0, *(np.flatnonzero(np.diff(slots)) + 1).tolist()]
        ends = [*starts[1:], self.cycles]
        return [(a * self.period, b * self.period, int(slots[a])) for a, b in zip(starts, ends, strict=True)]

    def unit(self, column: str) -> str:
        """Return the unit of one column.

        Raises:
            InvalidName: an unknown column; the nearest one is offered.
        """
        if column not in self.layout.columns:
            raise self._unknown(column)
        return self.layout.units[self.layout.columns.index(column)]

    def _unknown(self, name: object) -> InvalidName:
        valid = [*self.layout.names, *self.layout.columns]
        rows = "" if isinstance(name, str) else " A run is read by names; run.log has its cycles by number."
        return InvalidName(f"signal '{name}' is not in this run.{rows}{nearest(name, valid)}")
