"""A time slot: one coordinate, controlled alone with its own relative order, tracking law and deformation.

On a plant a slot becomes a `Channel`: the coordinate's chain of derivatives, and the light plant y^(r) = u. So tracking
laws and deformations work in a slot as they do on a whole plant, or on the outputs of one.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.controllers.contract import refuse
from fpirhc.deformation.base import Deformation, Identity, against_wrappers
from fpirhc.errors import InvalidName, InvalidProblem, NotInvertible, nearest
from fpirhc.fields.checked import Checked
from fpirhc.plant.chain import operator, output_expression, output_order
from fpirhc.plant.maps import response_age
from fpirhc.plant.motion import derivative_unit, followed_units
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Named, Signal
from fpirhc.symbolic.open import SETTINGS
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
    """A slot on a plant."""

    slot: Slot  # that is on the plant
    chain: OutputChain  # the derivatives of its coordinate
    number: int  # place among the slots
    plant: Plant  # the light one, y^(r) = u
    start_gain: float  # d y^(r)/du of the model at the problem's start
    # how often the highest derivative that is measured is differenced to find y^(r); 0: y^(r) itself is measured
    differences: int

    def wire(self, name: str) -> str:
        """Return the name of this slot's own copy of a signal."""
        return f"_{name.lstrip('_')}_{self.number}"

    def signal(self, name: str, elements: tuple[str, ...] = ()) -> Signal:
        """Return a signal of this slot's own: a scalar, or a vector with named elements."""
        return Signal(self.wire(name), elements)


# a controller is asked for its response, its checks and its blocks, and its schedule for every slot in turn
_CHANNELS: Latest[Channel] = Latest(16)


def channel(problem: Problem, slot: Slot, number: int) -> Channel:
    """Return the slot on the problem's plant."""
    return _CHANNELS.of((problem, slot), (number,), lambda: _channel(problem, slot, number))


def _channel(problem: Problem, slot: Slot, number: int) -> Channel:
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
    differences = 0 if reads_equations(problem) else _differences(plant, chain)
    refuse(_against(problem, slot.deformation, differences))
    rest = np.zeros(plant.input.size)
    gain = float(chain.gain(problem.start_state, rest, plant.approximate))
    if not (np.isfinite(gain) and gain != 0):
        raise NotInvertible(f"'{chain.input}' has no effect on '{slot.coordinate}' at the start (gain {gain:g})")
    light = integrators(plant, {chain.coordinate: (chain.unit, chain.order)}, (chain.input,))
    return Channel(slot, chain, number, light, gain, differences)


def reads_equations(problem: Problem) -> bool:
    """Return whether y^(r) is given as the equations of what moves have it: nothing is measured otherwise, or late."""
    return problem.sees_plant and problem.of_equations is problem


def measured_order(plant: Plant, coordinate: str) -> int:
    """Return the highest derivative of a coordinate that is measured or estimated; on a map the higher ones are predicted."""
    return 0 if response_age(plant) else plant.chains[coordinate] - 1


def _differences(plant: Plant, chain: OutputChain) -> int:
    shown = chain.coordinate in plant.controlled_names and plant.response_orders[chain.coordinate] == chain.order
    return 0 if shown else chain.order - measured_order(plant, chain.coordinate)


def _against(problem: Problem, deformation: Deformation, differences: int) -> Iterator[str]:
    estimator = problem.sensing.estimator
    at_once = estimator.of_steps or (estimator.shows_response and differences < 2)
    if not at_once:
        yield from deformation.mirror.against_last_request(
            f"ModelReferenced in a slot compares with the model's response of one cycle, and {estimator} gives a mean over "
            "several; use the map inside"
        )
    if deformation.iteration.pairing is not None and not deformation.mirror.share:
        pairs = deformation
        while pairs.inner is not None and pairs.inner.iteration.pairing is not None:
            pairs = pairs.inner
        yield (
            f"{type(pairs).__name__} keeps pairs of earlier cycles, which belong to another slot after a switch, where the command "
            "would jump back to them; use the map itself, or behind a dead time ModelReferenced(map, cycles=...)"
        )
    yield from against_wrappers(deformation)


def for_channel(
    block: Block, one: Channel, shared: Set[str], names: Mapping[str, str], first: First | None = None
) -> Block:
    """Return the block on the slot's own copies of its signals. The memory of the block starts anew with every slot.

    `first`: (signals) -> values with which the memory starts, by name; signals that are not named keep their own start.
    """

    def renamed(signal: Signal) -> Signal:
        name = signal.name if signal.name in shared else names.get(signal.name, one.wire(signal.name))
        return replace(signal, name=name)

    begun = one.signal("warm_up")
    reads = [s if s.name == SETTINGS else renamed(s) for s in block.inputs.signals]
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
    return Block(f"{block.name}_{one.number}", layout, writes, step, Layout(tuple(own)), opaque=block.opaque)


def delays_for_channel(delays: tuple[Delay, ...], one: Channel) -> list[Delay]:
    """Return the delays of a law, on the slot's own copies of its signals."""
    return [Delay(replace(d.now, name=one.wire(d.now.name)), one.wire(d.source)) for d in delays]


def integrators(plant: Plant, quantities: Mapping[str, tuple[str, int]], inputs: Sequence[str]) -> Plant:
    """Return the plant y^(r) = u of some quantities, in the time of another plant.

    `quantities`: (unit, order) of every quantity, by name.
    """
    names, orders = tuple(quantities), {name: order for name, (_, order) in quantities.items()}

    def response(*arguments: Named) -> dict[str, Expression]:
        return {name: arguments[-2][acting] for name, acting in zip(names, inputs, strict=True)}

    kind = inspect.Parameter.POSITIONAL_ONLY
    lower = [f"d{k}" for k in range(max(orders.values()))]
    vars(response)["__signature__"] = inspect.Signature([inspect.Parameter(n, kind) for n in (*lower, "u", "p")])
    return replace(
        plant,
        coordinates={name: unit for name, (unit, _) in quantities.items()},
        inputs={name: plant.inputs.get(name, "1") for name in inputs},
        parameters={},
        response=response,
        order=orders,
        controlled=names,
        inverse=None,
        ranges={},
        outputs={},
    )


@dataclass(frozen=True, eq=False)
class OutputChain:
    """One coordinate's derivatives up to its relative order, by Lie derivatives of the model.

    With x' = f(x, u, p) and y one entry of x the chain is  y^(0) = y,  y^(k) = d y^(k-1)/dx f(x, u, p),  k from 1 to r, and the
    relative order r is the first k for which y^(k) depends on the input. The pattern of dependence decides, not a value, so a gain
    that vanishes in one state does not change the order. On a map divided differences stand in place of derivatives.

    Args:
        order: the relative order r.
        response_unit: of y^(r).
        states: Function (state, parameters) -> (y, y', ..., y^(r-1)), shape (r,).
        response: Function (state, input, parameters, forcing) -> y^(r), scalar; `forcing` adds to the plant's responses.
        gain: Function (state, input, parameters) -> d y^(r) / d input, scalar.
    """

    coordinate: str
    input: str
    unit: str
    order: int
    response_unit: str
    states: ca.Function
    response: ca.Function
    gain: ca.Function

    @cached_property
    def affine(self) -> bool:
        """Whether y^(r) is affine in the input, decided from the symbols."""
        x, u, p = (ca.SX.sym("v", self.gain.size1_in(k)) for k in range(3))
        return not ca.depends_on(self.gain(x, u, p), u)


def output_chain(plant: Plant, coordinate: str, input_name: str | None = None) -> OutputChain:
    """Return the chain from a coordinate to an input; `input_name` may be None where the plant has one input.

    Raises:
        InvalidName: an unknown coordinate or input, or no name although there are several inputs.
        NotInvertible: the input reaches no derivative of the coordinate, or another input reaches an earlier one.
    """
    name = _input(plant, coordinate, input_name)
    x, u, p = plant.symbols()
    w = ca.SX.sym("w", len(plant.names))
    command = u[plant.input.elements.index(name)]
    derivatives, along = [output_expression(plant, coordinate, x, u, p)], operator(plant, (x, u, p, w))
    if ca.jacobian_sparsity(derivatives[0], u).nnz():
        raise NotInvertible(
            f"the command moves '{coordinate}' at once (order 0), so a slot has no derivative to prescribe"
        )
    for order in range(1, plant.state.size + 1):
        derivative = along(derivatives[-1])
        if ca.jacobian_sparsity(derivative, command).nnz():
            return _chain(plant, coordinate, name, derivatives, derivative, (x, u, p, w))
        if ca.depends_on(derivative, u):
            others = [e for k, e in enumerate(plant.inputs) if ca.jacobian_sparsity(derivative, u[k]).nnz()]
            raise NotInvertible(
                f"derivative {order} of '{coordinate}' is reached by another input than '{name}'; choose input='{others[0]}'"
            )
        derivatives.append(derivative)
    orders = ", ".join(f"{c} {output_order(plant, c) or 'none'}" for c in plant.names)
    raise NotInvertible(
        f"input '{name}' does not reach coordinate '{coordinate}', however often it is differentiated "
        f"(relative order by coordinate: {orders}); choose a coordinate that has one"
    )


def _input(plant: Plant, coordinate: str, name: str | None) -> str:
    followed = followed_units(plant)
    if coordinate not in followed:
        raise InvalidName(f"coordinate '{coordinate}' is unknown.{nearest(coordinate, followed)}")
    if name is None:
        if len(plant.inputs) > 1:
            raise InvalidName(f"'{coordinate}' needs the name of its input. Valid: {', '.join(plant.inputs)}.")
        return next(iter(plant.inputs))
    if name not in plant.inputs:
        raise InvalidName(f"input '{name}' is unknown.{nearest(name, plant.inputs)}")
    return name


def _chain(
    plant: Plant,
    coordinate: str,
    name: str,
    derivatives: list[ca.SX],
    response: ca.SX,
    symbols: tuple[ca.SX, ca.SX, ca.SX, ca.SX],
) -> OutputChain:
    x, u, p, w = symbols
    place, unit = plant.input.elements.index(name), followed_units(plant)[coordinate]
    # A model gives y ... y^(r-1) and the gain without disturbances.
    undisturbed = [ca.densify(ca.substitute(v, w, ca.SX.zeros(*w.shape))) for v in (ca.vertcat(*derivatives), response)]
    gain = ca.densify(ca.jacobian(undisturbed[1], u[place]))
    return OutputChain(
        coordinate,
        name,
        unit,
        len(derivatives),
        derivative_unit(unit, len(derivatives), plant.time_unit),
        ca.Function("fpirhc_chain", [x, p], [undisturbed[0]]),
        ca.Function("fpirhc_chain_response", [x, u, p, w], [ca.densify(response)]),
        ca.Function("fpirhc_chain_gain", [x, u, p], [gain]),
    )
