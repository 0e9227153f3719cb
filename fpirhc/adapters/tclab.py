"""The Temperature Control Lab as the reality of a problem: its digital twin, or the board.

    problem = fp.Problem(plant=model, reality=tclab_body(model, period=2.0), ...)             the twin, in simulated time
    problem = fp.Problem(plant=model, reality=tclab_body(model, period=2.0, board=RealTime(), rest={"Q1": 0.0, "Q2": 0.0}), ...)

Measured are the temperatures T1 and T2, degC, with noise and the steps of the converter; inputs are the heaters Q1 and Q2, %.
"""

from __future__ import annotations

import contextlib
import io
import random
import time as wall
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from fpirhc.adapters import adapter, require, require_seconds
from fpirhc.errors import Mistakes, package
from fpirhc.fields.kinds import Finite
from fpirhc.plant.plant import Plant
from fpirhc.task.external_plant import ExternalPlant

_SENSORS, _HEATERS = ("T1", "T2"), ("Q1", "Q2")


@dataclass
class RealTime:
    """The time of a run by the clock on the wall, for a device that moves by itself.

    A cycle that ends more than a period late raises: no burst of commands makes up for it.

    Args:
        clock: function that returns the wall time, s.
        sleep: function that waits for some seconds.
    """

    clock: Callable[[], float] = wall.monotonic
    sleep: Callable[[float], None] = wall.sleep
    _zero: float | None = None  # the wall time at which the run has time 0

    def begin(self) -> None:
        """The next cycle is the first; what is built before it has no cycle."""
        self._zero = None

    @contextmanager
    def cycle(self, time: float, period: float) -> Iterator[None]:
        """Do what stands in the body, and return at the end of the cycle that has begun at this time of the run.

        Raises:
            InvalidProblem: the cycle ended more than a period late; the run goes on from now.
        """
        if self._zero is None:
            self._zero = self.clock() - time
        try:
            yield
        finally:
            end = self._zero + time + period
            self.sleep(max(end - self.clock(), 0.0))
            late = self.clock() - end
            if late > period:  # commands until now would else go out at one instant
                self._zero += late
        require(
            late <= period,
            f"the cycle of {period:g} s ended {late:.3g} s late; choose a longer period, or a quicker bus or controller",
        )


@adapter
def tclab_body(
    model: Plant, *, period: float, board: RealTime | None = None, rest: Mapping[str, Finite] | None = None
) -> ExternalPlant:
    """Return the lab as a reality.

    Args:
        model: the controller's model; its states or outputs are named T1 and T2, its inputs Q1 and Q2, one or both.
        period: of the problem, s.
        board: the clock of the board, `RealTime()`; None: it is its digital twin, in simulated time.
        rest: by input, what the board is sent when a run ends, however it ends: {"Q1": 0.0, "Q2": 0.0}. A board needs it.

    Raises:
        NotSupported: tclab is not installed.
        InvalidProblem: the model has other names, or a board has no rest.
    """
    require_seconds("tclab_body", model)
    tclab, mistakes = package("tclab", "outside"), Mistakes("tclab_body")
    mistakes.unknown("measured", model.output.elements, _SENSORS)
    mistakes.unknown("input", model.inputs, _HEATERS)
    if board is not None and rest is None:
        wanted = ", ".join(f'"{name}": 0.0' for name in model.inputs)
        mistakes.add(f"rest: the board keeps its heaters on after a run; say what they are sent, rest={{{wanted}}}")
    mistakes.raise_if_any()
    body = _Twin(tclab, model, period) if board is None else _Board(tclab, model, period, board)
    return ExternalPlant(body, measures=dict.fromkeys(model.output.elements, "degC"), rest=rest, period=period)


class _Twin:
    """The package's own model of the lab, led by simulated time. `period`: of a cycle, s."""

    def __init__(self, tclab: Any, model: Plant, period: float) -> None:
        self._tclab, self._model, self._period = tclab, model, period
        self._lab: Any = None

    def reset(self, seed: int) -> np.ndarray:
        """Begin at the temperature of the room; the noise of the sensors has this seed."""
        random.seed(seed)
        with contextlib.redirect_stdout(io.StringIO()):
            self._lab = self._begun()
        return self._measured()

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        """Hold the heaters for a cycle."""
        self._heat(command)
        self._lab.update(time + self._period)
        return self._measured()

    def _heat(self, command: np.ndarray) -> None:
        for name, value in zip(self._model.inputs, command, strict=True):
            getattr(self._lab, name)(float(value))

    def _begun(self) -> Any:
        lab = self._tclab.tclab.TCLabModel(synced=False)
        lab.tstart = lab.tlast = 0.0
        return lab

    def _measured(self) -> np.ndarray:
        return np.array([getattr(self._lab, name) for name in self._model.output.elements])


class _Board(_Twin):
    """The board: the next cycle begins when it is time."""

    def __init__(self, tclab: Any, model: Plant, period: float, now: RealTime) -> None:
        super().__init__(tclab, model, period)
        self._now = now

    def _begun(self) -> Any:
        self.close()
        lab = self._tclab.TCLab()
        self._now.begin()
        return lab

    def close(self) -> None:
        """Let the board go."""
        if self._lab is not None:
            self._lab.close()
            self._lab = None

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        """Hold the heaters until the cycle is over."""
        with self._now.cycle(time, self._period):
            self._heat(command)
        return self._measured()
