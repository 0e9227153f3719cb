"""A run: every signal of a closed loop by name and unit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from fpirhc.fields.checked import checked_call
from fpirhc.simulation import run_file
from fpirhc.simulation.log import Log
from fpirhc.status import Status
from fpirhc.summary import in_percent, line, number, table

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


_FEW = 0.01  # share of the cycles without a converged plan that says nothing about a run


@dataclass(frozen=True, eq=False)
class Run(Log):
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

    _LOADED: ClassVar[str] = "fp.load_run({})"
    """How a value of a name or a file is written, with the name as {}: for who gives the name alone."""

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

    def to_dataframe(self) -> pd.DataFrame:
        """Return all signals as a pandas DataFrame with one column per entry, indexed by time."""
        import pandas as pd

        return pd.DataFrame(
            self.log, columns=list(self.layout.columns), index=pd.Index(self.time, name=f"time [{self.time_unit}]")
        )

    def plot(self) -> Figure:
        """Return errors, commands and responses over time as a matplotlib Figure."""
        from fpirhc.simulation.drawing import run_figure

        return run_figure(self)

    @checked_call
    def save(self, path: str | Path) -> None:
        """Write the run to a .npz file (no pickle), at once or not at all.

        Raises:
            OutputError: the file cannot be written, or its place is a symbolic link.
        """
        run_file.save(self, Path(path))


@checked_call
def load_run(path: str | Path) -> Run:
    """Read a run that `Run.save` wrote.

    Raises:
        OutputError: the file is missing, damaged, of another format, or no file of a run.
    """
    facts, layout, log = run_file.read(Path(path))
    names = facts.problem, facts.controller, facts.seed, facts.period
    return Run(*names, layout, log, facts.stop, facts.compiled, facts.settings)
