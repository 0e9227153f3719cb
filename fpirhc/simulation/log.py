"""The log of a run: every signal of a closed loop by name and unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from fpirhc.errors import InvalidName, nearest
from fpirhc.fields.checked import ByName, FoundByName
from fpirhc.symbolic.layout import Layout, Signal


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
        """Return the unit of one column."""
        if column not in self.layout.columns:
            raise self._unknown(column)
        return self.layout.units[self.layout.columns.index(column)]

    def _unknown(self, name: object) -> InvalidName:
        valid = [*self.layout.names, *self.layout.columns]
        rows = "" if isinstance(name, str) else " A run is read by names; run.log has its cycles by number."
        return InvalidName(f"signal '{name}' is not in this run.{rows}{nearest(name, valid)}")


_SAME = {"plant_state": "state", "plant_output": "output", "plant_realised": "realised"}

# where the judged motion is logged: the first that a run has
_MOTION = ("plant_output", "output", "plant_state", "state")


def with_common_columns(layout: Layout, log: np.ndarray) -> tuple[Layout, np.ndarray]:
    """Return layout and log, shape (cycles, layout.size), with 'plant_state', 'plant_realised' and 'true_error'.

    'plant_state' has the states of the model that the plant that moves has.

    'true_error' is the reference minus the plant's state of the judged coordinates, at the same time.
    """
    # A loop that logs what is true logs all of it: a reality may lack states that the controller believes in.
    true = any(name in layout for name in _SAME)
    added = [
        (_renamed(layout[logged], name), log[:, layout.slice(logged)])
        for name, logged in _SAME.items()
        if logged in layout and not true
    ]
    if "true_error" not in layout and "error" in layout:
        added.append((_renamed(layout["error"], "true_error"), _true_error(layout, log)))
    if not added:
        return layout, log
    return layout + Layout(tuple(signal for signal, _ in added)), np.hstack([log, *(values for _, values in added)])


def judged_motion(layout: Layout) -> str:
    """Return the name of the signal of the plant's own motion that is judged: its outputs, or its state."""
    return next(name for name in _MOTION if name in layout)


def shown_motion(layout: Layout) -> str:
    """Return the name of the signal that the controller is given of what is judged: 'output' or 'state'."""
    return "output" if "output" in layout else "state"


def responses_of(layout: Layout) -> dict[str, str]:
    """Return the columns of responses by what they are: time slots find their realised ones from what is measured."""
    own = "realised_of_slots" in layout
    return {n: n for n in ("nominal", "desired", "deformed")} | {"realised": "realised_of_slots" if own else "realised"}


def _true_error(layout: Layout, log: np.ndarray) -> np.ndarray:
    state = layout[judged_motion(layout)]
    if "reference" not in layout:
        return log[:, layout.slice("error")]  # a controller of a user's own that logs its error alone
    places = [state.elements.index(name) for name in layout["error"].elements]
    reference, states = log[:, layout.slice("reference")], log[:, layout.slice(state.name)]
    return np.asarray(reference[:, places] - states[:, places])


def _renamed(signal: Signal, name: str) -> Signal:
    return Signal(name, signal.elements, signal.units)
