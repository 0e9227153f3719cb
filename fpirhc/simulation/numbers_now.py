"""The numbers of a stepper that may change from step to step: live settings and set-points, checked before they are in force."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fpirhc.by_name import ByName
from fpirhc.controllers.live_settings import LiveSettings, Numbers
from fpirhc.errors import FpirhcError, InvalidName, InvalidValue
from fpirhc.fields.kinds import named_entries
from fpirhc.simulation.set_points import SetpointsNow, set_points_now
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.live import PREFIX


class NumbersNow:
    """Live settings and set-points in force, written into the arguments of a step.

    What is refused changes nothing: the old numbers stay, `refused` counts, and `why_refused` states the last reason.

    Attributes:
        numbers: live settings in force, by path.
        refused: number of changes that were refused.
        why_refused: reason of the last one.
    """

    def __init__(
        self, live: LiveSettings, composite: Composite, settings: Mapping[str, np.ndarray], setpoints: np.ndarray
    ) -> None:
        """Put the numbers of the build in force.

        Args:
            live: the settings and what they may be.
            composite: the step.
            settings: arguments of the step, by the name of their signal.
            setpoints: argument of the step, with the set-points at the start; no entries without any.
        """
        self._live, self._composite = live, composite
        self._settings, self._setpoints = settings, setpoints
        self.refused, self.why_refused = 0, ""
        self.numbers: dict[str, float] = live.start
        self._write(self.numbers)

    def memory(self) -> np.ndarray:
        """Return the memory of the controller before its first cycle, with the settings in force."""
        remembered = self._composite.derived(self.numbers).memory() if self.numbers else {}
        return self._composite.memory.pack(remembered)

    def change(self, settings: Numbers) -> bool:
        """Put numbers of live settings in force, by path, and return whether they were accepted.

        Raises:
            InvalidField: no mapping of names.
            InvalidName: a setting that is not live.
        """
        if not named_entries("settings", settings):
            return True
        before = {path: value for path, value in self.numbers.items() if path in self._live.paths}
        try:
            _, _, numbers = self._live.changed({**before, **self._live.flat(settings)})
            self._write(numbers)
        except InvalidName:
            raise
        except FpirhcError as error:
            return self._refuse(error)
        self.numbers = numbers
        return True

    def aim(self, setpoints: SetpointsNow) -> bool:
        """Put set-points in force, by coordinate or output, and return whether they were accepted.

        Raises:
            InvalidField: no mapping of names.
            InvalidName: a coordinate without set-point.
            InvalidShape: neither one number nor one per node.
        """
        if not named_entries("setpoints", setpoints):
            return True
        try:
            row = set_points_now(self._live.problem, setpoints, self._setpoints)
        except InvalidValue as error:
            return self._refuse(error)
        self._setpoints[:] = row
        return True

    @property
    def setpoints(self) -> dict[str, float | list[float]]:
        """The set-points in force, by coordinate or output; where they are announced, one per node of the horizon."""
        names = self._live.problem.plant.face.names
        rows = self._setpoints.reshape(-1, len(names)).T
        values = {
            n: row.tolist() if row.size > 1 else float(row[0]) for n, row in zip(names, rows, strict=True) if row.size
        }
        return ByName(values, "Stepper.setpoints")

    def stale(self) -> dict[str, str]:
        """Return what follows from live settings by way of Python, and what becomes of a device that keeps the old number."""
        return ByName(self._composite.derived(self.numbers).stale if self.numbers else {}, "Stepper.stale()")

    def _write(self, numbers: Mapping[str, float]) -> None:
        """Write the settings and what follows from them into the arguments; nothing is written where something is refused."""
        if not numbers:
            return
        values = {PREFIX + path: np.array([value]) for path, value in numbers.items()}
        values |= self._composite.derived(numbers).signals
        for name, argument in self._settings.items():
            argument[:] = values[name]

    def _refuse(self, error: FpirhcError) -> bool:
        self.refused, self.why_refused = self.refused + 1, str(error)
        return False
