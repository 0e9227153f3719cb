"""A reference whose controlled coordinates are shifted while it runs: the target that an outer loop gives an inner controller."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.plant.motion import followed_units, time_signal
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals, kind
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.task.reference import Reference, Steps

SHIFT = "_target_shift"  # given from outside: by how much every controlled coordinate is shifted
_OWN = "_target_own"  # the reference's own signals, the shift, and the time


@dataclass(frozen=True, eq=False)
class Shifted(Reference):
    """The motion of another reference plus a shift of its controlled coordinates, which is held along a horizon.

    Whatever is decided before a run uses the motion without shift. Derivatives are not shifted: the shift changes slowly.

    Args:
        reference: that is shifted. Its own signals are given from outside too.
    """

    reference: Reference

    @property
    def opaque(self) -> bool:
        """As the reference."""
        return self.reference.opaque

    @property
    def set_points(self) -> Mapping[str, Steps]:
        """Those of the reference."""
        return self.reference.set_points

    def coordinates(self, t: Expression) -> Mapping[str, Expression]:
        """Return the motion without shift."""
        return self.reference.coordinates(t)

    def function(self, plant: Plant) -> ca.Function:
        """Function t -> (nominal state (nx), nominal response (n)) without shift."""
        return self.reference.function(plant)

    def derivatives(self, coordinate: str, order: int) -> ca.Function:
        """Function t -> the coordinate's nominal value and its derivatives without shift."""
        return self.reference.derivatives(coordinate, order)

    def given(self, plant: Plant, stages: int) -> tuple[Signal, ...]:
        """Return the own signals of the reference, and the shift."""
        every = followed_units(plant)
        units = tuple(every[name] for name in plant.controlled_names)
        return (*self.reference.own(plant, stages), Signal(SHIFT, plant.controlled_names, units))

    def own(self, plant: Plant, stages: int) -> tuple[Signal, ...]:
        """Return all of these and the time as one signal."""
        names = tuple(column for signal in self.given(plant, stages) for column in signal.columns)
        return (Signal(_OWN, (*names, "time")),)

    def block(self, plant: Plant, stages: int, period: float) -> Block:
        """Return the block that packs what is given."""
        del period
        signals = self.given(plant, stages)

        def step(s: Signals) -> dict[str, Expression]:
            return {_OWN: ca.vertcat(*(getattr(s, signal.name) for signal in signals), s.time)}

        return Block("target", Layout((time_signal(plant), *signals)), Layout(self.own(plant, stages)), step)

    def motion_now(self, plant: Plant, stages: int, ahead: float = 0.0) -> ca.Function:
        """Function (t, own signal) -> (state, response), now or after some time with the shift held."""
        t, own, parts, places = self._symbols(plant, stages)
        state, response = self.reference.motion_now(plant, stages, ahead)(t, *parts[:-2])
        shifted = state + places @ parts[-2]
        return ca.Function("fpirhc_target", [t, own], [shifted, response], ["t", "own"], ["state", "response"])

    def chain(self, plant: Plant, stages: int, coordinate: str, order: int) -> ca.Function:
        """Function (t, own signal) -> the coordinate's value and its derivatives up to `order`."""
        t, own, parts, _ = self._symbols(plant, stages)
        values = self.reference.chain(plant, stages, coordinate, order)(t, *parts[:-2])
        if coordinate in plant.controlled_names:
            unit = ca.DM(np.eye(order + 1)[:, :1])
            values = values + unit * parts[-2][plant.controlled_names.index(coordinate)]
        return ca.Function("fpirhc_target_chain", [t, own], [values])

    def preview(self, plant: Plant, stages: int, step: float) -> ca.Function:
        """Function (own signal) -> (states (nx, N + 1), responses (n, N + 1)) at the nodes of a horizon."""
        _, own, parts, places = self._symbols(plant, stages)
        known = self.reference.preview(plant, stages, step)
        if known is not None:
            states, responses = known(*parts[:-2])
        else:
            times = [parts[-1] + step * node for node in range(stages + 1)]
            nodes = [self.reference.function(plant)(time) for time in times]
            states, responses = (ca.horzcat(*columns) for columns in zip(*nodes, strict=True))
        shifted = states + ca.repmat(places @ parts[-2], 1, stages + 1)
        return ca.Function("fpirhc_target_preview", [own], [shifted, responses], ["own"], ["states", "responses"])

    def rests(self, until: float) -> bool:
        """Return whether the motion without shift rests."""
        return self.reference.rests(until)

    def largest_jump(self, plant: Plant) -> float:
        """Largest known jump of the motion without shift."""
        return self.reference.largest_jump(plant)

    def _symbols(self, plant: Plant, stages: int) -> tuple[Expression, Expression, list[Expression], ca.DM]:
        """Time, the own signal, its parts, and the matrix that puts the shift into the state."""
        matrix, signals = kind(self.opaque), self.given(plant, stages)
        own = matrix.sym("own", self.own(plant, stages)[0].size)
        ends = np.cumsum([0, *(signal.size for signal in signals), 1]).tolist()
        places = ca.DM(plant.output.size, len(plant.controlled_names))
        for column, name in enumerate(plant.controlled_names):
            places[plant.output.elements.index(name), column] = 1
        return matrix.sym("t"), own, ca.vertsplit(own, ends), places
