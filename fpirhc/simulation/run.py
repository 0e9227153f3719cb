"""A run: every signal of a closed loop by name and unit, and its file."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from fpirhc.errors import InvalidName, OutputError, nearest
from fpirhc.fields.checked import FoundByName, checked_call
from fpirhc.status import Status
from fpirhc.summary import in_percent, in_units, line
from fpirhc.symbolic.layout import Layout, Signal
from fpirhc.whole_file import write_whole

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

    _WRITTEN: ClassVar[str] = "fp.load_run({})"
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

    def __post_init__(self) -> None:
        """A log that is not finite is no finished run, whoever made it."""
        super().__post_init__()
        if self.stop is None and not np.isfinite(self.log).all():
            row, column = (int(k) for k in np.argwhere(~np.isfinite(self.log))[0])
            where = f"'{self.layout.columns[column]}' is not finite in cycle {row}"
            object.__setattr__(self, "stop", f"signal {where}; the run was not ended there")

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

    def __repr__(self) -> str:
        return line(self, f"{self.problem or 'problem'}, {self.controller}", *self._facts())

    def _facts(self) -> tuple[str, ...]:
        how = "compiled C" if self.compiled else "virtual machine"
        ended = f"ended early: {self.stop}" if self.stop else "complete"
        about = f"{self.cycles} cycles of {self.period:g} {self.time_unit}", f"seed {self.seed}", how, ended
        return *about, *self._faults(), *self.remarks

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
    def remarks(self) -> tuple[str, ...]:
        """Why the same run may be another one elsewhere: a sentence where plans did not converge in 1 % of the cycles or more."""
        if "status" not in self.layout or not self.cycles:
            return ()
        share = float(np.mean(self["status"] == Status.NOT_CONVERGED))
        words = (
            f"plans did not converge in {in_percent(share)} of the cycles; such plans depend on rounding, so compiled C, the "
            f"virtual machine and another computer may give other runs: allow more iterations, or loosen the tolerance"
        )
        return (words,) if share >= _FEW else ()

    def first(self, cycles: int) -> Run:
        """Return the run of its first cycles; itself where it has fewer."""
        return replace(self, log=self.log[:cycles], stop=None) if cycles <= self.cycles else self

    def to_dataframe(self) -> pd.DataFrame:
        """Return all signals as a pandas DataFrame by column and time; `attrs["units"]` has units by column."""
        import pandas as pd

        columns, index = list(self.layout.columns), pd.Index(self.time, name=f"time [{self.time_unit}]")
        return in_units(
            pd.DataFrame(self.log, columns=columns, index=index), dict(zip(columns, self.layout.units, strict=True))
        )

    def plot(self) -> Figure:
        """Return errors, commands and responses over time as a matplotlib Figure."""
        from fpirhc.simulation.drawing import run_figure

        return run_figure(self)

    @checked_call
    def save(self, path: str | Path) -> None:
        """Write the run to a .npz file (no pickle), at once or not at all.

        Raises:
            OutputError: the file cannot be written.
        """
        facts = {name: getattr(self, name) for name in _FACTS}
        facts |= {"format": FORMAT, "signals": [[s.name, s.elements, s.units] for s in self.layout.signals]}
        content = io.BytesIO()
        np.savez_compressed(content, log=self.log, facts=np.array(json.dumps(facts)))
        write_whole(content.getvalue(), Path(path), "run")


FORMAT = 1
_FACTS = ("problem", "controller", "seed", "period", "stop", "compiled", "settings")


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


def _true_error(layout: Layout, log: np.ndarray) -> np.ndarray:
    state = layout[judged_motion(layout)]
    if "reference" not in layout:
        return log[:, layout.slice("error")]  # a controller of a user's own that logs its error alone
    places = [state.elements.index(name) for name in layout["error"].elements]
    reference, states = log[:, layout.slice("reference")], log[:, layout.slice(state.name)]
    return np.asarray(reference[:, places] - states[:, places])


def _renamed(signal: Signal, name: str) -> Signal:
    return Signal(name, signal.elements, signal.units)


@checked_call
def load_run(path: str | Path) -> Run:
    """Read a run that `Run.save` wrote: a numpy array and JSON, so that a file of somebody else runs no code.

    Raises:
        OutputError: the file is missing, damaged, of another format, or no file of a run.
    """
    try:
        with Path(path).open("rb") as handle, np.load(handle, allow_pickle=False) as file:
            log, facts = file["log"], json.loads(str(file["facts"]))
        layout = Layout(tuple(Signal(n, tuple(elements), tuple(units)) for n, elements, units in facts["signals"]))
        if facts["format"] != FORMAT or log.dtype != np.float64 or log.shape[1:] != (layout.size,):
            raise OutputError(f"format {facts['format']!r}, {log.shape} numbers for {layout.size} columns")
        log.setflags(write=False)
        return Run(layout=layout, log=log, **{name: facts[name] for name in _FACTS})
    except Exception as error:  # noqa: BLE001 -- a file that is damaged can raise anything in the readers of zip and JSON
        said = str(getattr(error, "strerror", None) or error).partition("\n")[0][:200]
        raise OutputError(f"cannot read a run from '{path}': {said or type(error).__name__}") from None
