"""A time slot: one coordinate, controlled alone with its own relative order, tracking law and deformation.

On a plant a slot becomes a `Channel`: the coordinate's chain of derivatives, and the light plant y^(r) = u. So tracking
laws and deformations work in a slot as they do on a whole plant, or on the outputs of one.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from fpirhc.deformation.base import Deformation, Mirror
from fpirhc.deformation.identity import Identity
from fpirhc.deformation.model_referenced import form_inside
from fpirhc.errors import InvalidProblem, NotInvertible, NotSupported
from fpirhc.fields.checked import Checked
from fpirhc.plant.plant import Plant
from fpirhc.plant.relative_order import OutputChain, output_chain
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Named, Signal
from fpirhc.symbolic.live import PREFIX
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Tracking

First = Callable[[Signals], Mapping[str, Expression]]


@dataclass(frozen=True)
class Slot(Checked):
    """The coordinate that is controlled while the slot lasts, and how.

    Args:
        coordinate: the coordinate y that follows its reference.
        tracking: the law that gives the desired y^(r).
        deformation: the fixed-point map between desired y^(r) and request, its scale given; Identity() is no adaptation.
        order: the relative order r from the input to y; None: computed from the model. A wrong order is refused.
        input: the input that acts; None where the plant has only one. Other inputs keep their last command.
    """

    coordinate: str
    tracking: Tracking
    deformation: Deformation = field(default_factory=Identity)
    order: int | None = None
    input: str | None = None

    @property
    def adapts(self) -> bool:
        """Whether the slot has a deformation."""
        return self.deformation.adapts


@dataclass(frozen=True, eq=False)
class Channel:
    """A slot on a plant.

    Args:
        slot: that is on the plant.
        chain: the derivatives of its coordinate.
        number: place among the slots.
        plant: the light one, y^(r) = u.
        start_gain: d y^(r)/du of the model at the problem's start.
    """

    slot: Slot
    chain: OutputChain
    number: int
    plant: Plant
    start_gain: float

    def wire(self, name: str) -> str:
        """Return the name of this slot's own copy of a signal."""
        return f"_{name.lstrip('_')}_{self.number}"

    def signal(self, name: str, elements: tuple[str, ...] = ()) -> Signal:
        """Return a signal of this slot's own: a scalar, or a vector with named elements."""
        return Signal(self.wire(name), elements)


def channel(problem: Problem, slot: Slot, number: int) -> Channel:
    """Return the slot on the problem's plant.

    Raises:
        InvalidName: the coordinate or the input is unknown.
        NotInvertible: the input has no effect on the coordinate, y^(r) is not affine in it, or its gain is zero at the start.
        InvalidProblem: the order of the slot is not the model's.
        NotSupported: a deformation that keeps pairs or commands of earlier cycles.
    """
    plant = problem.plant
    chain = output_chain(plant, slot.coordinate, slot.input)
    if slot.order is not None and slot.order != chain.order:
        raise InvalidProblem(
            f"order={slot.order} is not the relative order from '{chain.input}' to '{slot.coordinate}', which is {chain.order}; "
            f"write order={chain.order} or leave it out"
        )
    if not chain.affine:
        raise NotInvertible(
            f"derivative {chain.order} of '{slot.coordinate}' is not affine in '{chain.input}', which a slot needs"
        )
    _check_deformation(slot.deformation)
    rest = np.zeros(plant.input.size)
    gain = float(chain.gain(problem.start_state, rest, plant.approximate))
    if not (np.isfinite(gain) and gain != 0):
        raise NotInvertible(f"'{chain.input}' has no effect on '{slot.coordinate}' at the start (gain {gain:g})")
    return Channel(slot, chain, number, _light_plant(plant, chain), gain)


def _check_deformation(deformation: Deformation) -> None:
    if deformation.mirror not in (None, Mirror()):
        raise NotSupported(
            "ModelReferenced in a slot compares with the model's response of this instant; dead time and lag keep commands of "
            "earlier cycles, which belong to another slot after a switch; leave cycles, measurement and lag out"
        )
    if deformation.iteration.pairing is not None:
        pairs = deformation
        while pairs.inner is not None and pairs.inner.iteration.pairing is not None:
            pairs = pairs.inner
        raise NotSupported(
            f"{type(pairs).__name__} keeps pairs of earlier cycles, which belong to another slot after a switch; "
            "use the map itself"
        )
    outer = form_inside(deformation)
    if outer is not None:
        raise NotSupported(
            f"{type(outer).__name__} around a model-referenced form: put it inside, ModelReferenced({type(outer).__name__}(map))"
        )


def for_channel(
    block: Block, one: Channel, shared: Set[str], names: Mapping[str, str], first: First | None = None
) -> Block:
    """Return the block on the slot's own copies of its signals. The memory of the block starts anew with every slot.

    Args:
        block: that runs in the slot.
        one: the slot.
        shared: names of signals that all slots share.
        names: signal of the block -> another name for the slot's copy.
        first: (signals) -> values with which the memory starts, by name; signals that are not named keep their own start.
    """

    def renamed(signal: Signal) -> Signal:
        name = signal.name if signal.name in shared else names.get(signal.name, one.wire(signal.name))
        return Signal(name, signal.elements, signal.units, signal.start)

    begun = one.signal("warm_up")
    reads = [s if s.name.startswith(PREFIX) else renamed(s) for s in block.inputs.signals]
    own = [renamed(s) for s in block.memory.signals]
    reads_begun = [] if not own or begun.name in [s.name for s in reads] else [begun]

    def step(s: Signals) -> dict[str, Expression]:
        starts = first(s) if first is not None else {}
        first_values = [
            starts.get(m.name, ca.DM(w.start_vector())) for m, w in zip(block.memory.signals, own, strict=True)
        ]
        memories = [
            ca.if_else(getattr(s, begun.name) > 0.5, getattr(s, w.name), start)
            for w, start in zip(own, first_values, strict=True)
        ]
        outputs = block.function(*(getattr(s, r.name) for r in reads), *memories)
        values = outputs if isinstance(outputs, tuple) else (outputs,)
        results = [renamed(w).name for w in block.writes.signals] + [f"{m.name}_next" for m in own]
        return dict(zip(results, values, strict=True))

    writes = Layout(tuple(renamed(w) for w in block.writes.signals))
    layout = Layout((*reads, *reads_begun))
    return Block(
        f"{block.name}_{one.number}",
        layout,
        writes,
        step,
        Layout(tuple(own)),
        opaque=block.opaque,
        derived=block.derived,
    )


def delays_for_channel(delays: tuple[Delay, ...], one: Channel) -> list[Delay]:
    """Return the delays of a law, on the slot's own copies of its signals."""
    return [
        Delay(Signal(one.wire(d.now.name), d.now.elements, d.now.units, d.now.start), one.wire(d.source))
        for d in delays
    ]


def _light_plant(plant: Plant, chain: OutputChain) -> Plant:
    """Return the plant y^(r) = u of one quantity and the input that acts on it."""
    name = chain.coordinate

    def response(*arguments: Named) -> dict[str, Expression]:
        return {name: arguments[-2][chain.input]}

    kind = inspect.Parameter.POSITIONAL_ONLY
    lower = [f"d{k}" for k in range(chain.order)]
    vars(response)["__signature__"] = inspect.Signature([inspect.Parameter(n, kind) for n in (*lower, "u", "p")])
    return replace(
        plant,
        coordinates={name: chain.unit},
        inputs={chain.input: plant.inputs[chain.input]},
        parameters={},
        response=response,
        order=chain.order,
        controlled=(name,),
        inverse=None,
        ranges={},
        outputs={},
        algebraic=None,
        next=None,
    )
