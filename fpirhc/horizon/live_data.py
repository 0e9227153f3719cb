"""Settings among the data of the stages: what a horizon's Functions read where cost or limits have live numbers.

The data of every stage end with the settings, the scale of the inputs D = 1 / (step c), and the largest eigenvalue of D V''. The
last two are numbers that follow from the settings; Python computes them, and the optimiser reads them from the data.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NoReturn

import casadi as ca
import numpy as np

from fpirhc.errors import NotSupported
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.symbolic.live import DERIVED, PREFIX

SCALE, STEEPEST = "input_scale", "steepest"


def settings_in(expressions: Iterable[Expression], known: Expression) -> list[ca.SX]:
    """Return the symbols of settings in some expressions, in the order in which they appear."""
    symbols = ca.symvar(ca.vertcat(known, *(ca.vec(ca.SX(e)) for e in expressions)))
    return [s for s in symbols if s.name().startswith(PREFIX)]


def live_signals(paths: tuple[str, ...], inputs: Signal) -> Layout:
    """Return the signals at the end of a stage's data; none without settings."""
    if not paths:
        return Layout()
    return Layout((Signal("settings", paths), Signal(SCALE, inputs.elements), scalar(STEEPEST)))


def live_table(table: np.ndarray, settings: np.ndarray, scale: np.ndarray, steepest: float) -> np.ndarray:
    """Return the data of all stages with the rows of the settings, of the scale and of the largest eigenvalue."""
    rows = np.concatenate([settings, scale, [steepest]])
    return np.vstack([table, np.repeat(rows[:, None], table.shape[1], axis=1)])


class Withheld:
    """A number that follows from live settings, where code is built: every use is refused, so that no code keeps an old number.

    Args:
        paths: of the settings.
    """

    __array_ufunc__ = None

    def __init__(self, paths: tuple[str, ...]) -> None:
        self._paths = paths

    def refuse(self, *_: object) -> NoReturn:
        """Raise NotSupported with the names of the settings."""
        names = ", ".join(f"'{path}'" for path in self._paths if not path.startswith(DERIVED))
        raise NotSupported(
            f"setting {names} cannot be live with this optimiser: its code keeps numbers that follow from it; use FixedPoint() "
            "without limits of states, or leave it out of live=[...]"
        )

    __getitem__ = __iter__ = __len__ = __array__ = __float__ = __bool__ = refuse
    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __truediv__ = __rtruediv__ = __neg__ = __pow__ = (
        refuse
    )

    def __getattr__(self, name: str) -> NoReturn:
        if name.startswith("__"):  # copy and pickle ask for what does not exist
            raise AttributeError(name)
        self.refuse()
