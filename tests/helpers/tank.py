"""A tank that moves by itself whenever the clock of its cycles waits, for tests of field buses."""

from collections.abc import Callable

import fpirhc as fp
from fpirhc.adapters.tclab import RealTime

PERIOD = 0.1
TANK = fp.Plant(
    {"h": "m"},
    {"q": "m/s"},
    {"outlet": fp.Parameter(approximate=0.3, exact=0.3, unit="1/s")},
    lambda q, u, p: {"h": u.q - p.outlet * q.h},
    order=1,
)


class Tank:
    """Another outlet than the model's."""

    def __init__(self, inflow: Callable[[], float], show: Callable[[float], None]) -> None:
        self.inflow, self.show, self.now, self.level = inflow, show, 0.0, 1.0

    @property
    def clock(self) -> RealTime:
        return RealTime(lambda: self.now, self.sleep)

    def begin(self) -> None:
        self.level = 1.0
        self.show(self.level)

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        self.level += seconds * (self.inflow() - 0.5 * self.level)
        self.show(self.level)
