"""A run: every signal of a closed loop by name and unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, cast

import numpy as np

from fpirhc.by_name import ByName, FoundByName
from fpirhc.errors import InvalidName, nearest
from fpirhc.fields.checked_call import checked_call
from fpirhc.status import Status
from fpirhc.summary import in_percent, line, number, table
from fpirhc.symbolic.layout import Layout

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


_FEW = 0.01  # share of the cycles without a converged plan that says nothing about a run


@dataclass(frozen=True, eq=False)
class Run(FoundByName):
    """The log of one closed-loop run.

    `run["desired"]` has shape (cycles, entries); `run["desired.q1"]` has shape (cycles,).

    Args:
        problem: its name; '' for a problem without a name.
        controller: its name.
        seed: of disturbances and noise.
        period: of the control cycle.
        layout: the logged signals. Every run has 'plant_state' and 'plant_realised', response of the plant and those states of
            the model that it has, and 'true_error', the reference minus the plant's state at the same time.
        log: values of all signals, shape (cycles, layout.size), read-only.
        stop: why the run ended early; None for a run that finished.
        compiled: whether the loop ran as compiled C.
        settings: of problem and controller, as plain data.
    """

    LOADED: ClassVar[str] = "fp.load_run({})"
    """How a value of a name or a file is written, with the name as {}: for who gives the name alone."""

    problem: str
    controller: str
    seed: int
    period: float
    layout: Layout
    log: np.ndarray
    stop: str | None
    compiled: bool
    settings: Mapping[str, object]

    def __repr__(self) -> str:
        return line(self, f"{self.problem or 'problem'}, {self.controller}", *self._facts())

    def _repr_html_(self) -> str:
        """Extremes of errors and commands as a table, for notebooks."""
        shown = [s for s in ("true_error", "error", "command") if s in self.layout and self.cycles]
        columns = [c for s in shown for c in self.layout[s].columns]
        rows = [(c, self.unit(c), number(self[c].min()), number(self[c].max()), number(self[c][-1])) for c in columns]
        title = f"Run of {self.controller} on {self.problem or 'the problem'}"
        return table(title, ("signal", "unit", "smallest", "largest", "last"), rows, [", ".join(self._facts())])

    def _facts(self) -> tuple[str, ...]:
        how = "compiled C" if self.compiled else "virtual machine"
        ended = f"ended early: {self.stop}" if self.stop else "complete"
        about = f"{self.cycles} cycles of {self.period:g} {self.time_unit}", f"seed {self.seed}", how, ended
        doubt = (self.depends_on_rounding,) if self.depends_on_rounding else ()
        return *about, *self._faults(), *doubt

    def _faults(self) -> tuple[str, ...]:
        """What was worse in some cycles than a plan that had not converged, with the first time."""
        if "status" not in self.layout or not self.cycles:
            return ()
        statuses, faults = self["status"].ravel().astype(int), []
        for status in sorted(map(Status, set(statuses.tolist())), key=lambda s: s.severity):
            if status.severity > Status.NOT_CONVERGED.severity:
                at = np.flatnonzero(statuses == status)
                first = f"{at[0] * self.period:g} {self.time_unit}"
                faults.append(f"{status.name} in {at.size} cycles, first at {first}")
        return tuple(faults)

    @property
    def depends_on_rounding(self) -> str:
        """Why the same run may be another one elsewhere: a sentence where plans did not converge in 1 % of the cycles or more."""
        if "status" not in self.layout or not self.cycles:
            return ""
        share = float(np.mean(self["status"] == Status.NOT_CONVERGED))
        if share < _FEW:
            return ""
        return (
            f"plans did not converge in {in_percent(share)} of the cycles; such plans depend on rounding, so compiled C, the "
            f"virtual machine and another computer may give other runs: allow more iterations, or loosen the tolerance"
        )

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

    def to_dataframe(self) -> pd.DataFrame:
        """Return all signals as a pandas DataFrame with one column per entry, indexed by time."""
        import pandas as pd

        return pd.DataFrame(
            self.log, columns=list(self.layout.columns), index=pd.Index(self.time, name=f"time [{self.time_unit}]")
        )

    def plot(self) -> Figure:
        """Return errors, commands and responses over time as a matplotlib Figure."""
        from fpirhc.simulation.run_figure import run_figure

        return run_figure(self)

    @checked_call
    def save(self, path: str | Path) -> None:
        """Write the run to a .npz file (no pickle), at once or not at all.

        Raises:
            OutputError: the file cannot be written, or its place is a symbolic link.
        """
        from fpirhc.simulation.run_file import save_run

        save_run(self, Path(path))
