"""What a controller's model is told of signals from outside: the block before all others, and the composite with it.

    parameters, time -> parameters with the values of this cycle -> controller

A response that is measured at the end of a cycle belongs to the signals of that cycle. A model-referenced deformation therefore
compares it with the model's response at the signals of the last cycle, `_signals_acted`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from fpirhc.plant.motion import time_signal
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.task.exogenous import Exogenous, known_places, model_values, rows_of

ACTED = "_signals_acted"
NOW = "_parameters_now"
_QUEUE = "mirror_signals"


@dataclass(frozen=True, eq=False)
class KnownSignals:
    """What a model is told.

    Args:
        plant: the model.
        signals: from outside, by name.
        period: of the control cycle.
    """

    plant: Plant
    signals: Mapping[str, Exogenous]
    period: float

    @property
    def places(self) -> tuple[int, ...]:
        """Places among the parameters of the signals of which it is told something."""
        return known_places(self.plant, self.signals)

    @property
    def reads(self) -> tuple[Signal, ...]:
        """The signals of the last cycle, in the first cycle those of the cycle itself; nothing where it is told nothing."""
        plant, places = self.plant, self.places
        if not places:
            return ()
        at = np.array([self.period / 2])
        first = rows_of(model_values(plant, self.signals), at, plant.approximate)[0]
        names, units = (tuple(v[k] for k in places) for v in (plant.parameter.elements, plant.parameter.units))
        return (Signal(ACTED, names, units, tuple(float(first[k]) for k in places)),)

    def memory(self, late: int, name: str = _QUEUE) -> tuple[Signal, ...]:
        """Return the signals of `late` more cycles before the last one, remembered under a name."""
        if not (self.reads and late):
            return ()
        [one] = self.reads
        names = tuple(f"{e}@{k}" for k in range(1, late + 1) for e in one.elements)
        return (Signal(name, names, start=one.start * late),)

    def acted(self, s: Signals, late: int, name: str = _QUEUE) -> tuple[Expression, dict[str, Expression]]:
        """Return the parameters of the last cycle, or of `late` cycles before it, and what is remembered.

        They are the parameters of this cycle, with the signals of that one.
        """
        if not self.places:
            return s.parameters, {}
        column, size = getattr(s, ACTED), len(self.places)
        remembered = {}
        if late:
            column = ca.vertcat(column, getattr(s, name))
            remembered[f"{name}_next"] = column[: size * late]
        acted = dict(zip(self.places, ca.vertsplit(column[size * late :]), strict=True))
        parameters = ca.vertcat(*(acted.get(k, s.parameters[k]) for k in range(self.plant.parameter.size)))
        return parameters, remembered

    def block(self, *, remembers: bool) -> Block | None:
        """Return the block (time, parameters) -> parameters of this cycle; None where the model is told nothing.

        Args:
            remembers: whether it also writes the signals of the last cycle.
        """
        values = model_values(self.plant, self.signals)
        if values is None:
            return None
        (acted,), places, half = self.reads, list(self.places), self.period / 2
        last = Signal("signals_last", acted.elements, acted.units, acted.start)

        def step(s: Signals) -> dict[str, Expression]:
            now = values(s.time + half, s.parameters)
            if not remembers:
                return {NOW: now}
            return {NOW: now, ACTED: s.signals_last, "signals_last_next": now[places]}

        parameter, opaque = self.plant.parameter, not values.is_a("SXFunction")
        writes = Layout((Signal(NOW, parameter.elements, parameter.units), *((acted,) if remembers else ())))
        memory = Layout((last,)) if remembers else Layout()
        block = Block("signals", Layout((time_signal(self.plant), parameter)), writes, step, memory, opaque)
        return replace(block, waits=block)  # time goes on
