"""The contract of tracking laws, and the errors and integrals that they feed back."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from fpirhc.fields.checked import Checked
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, power
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar, vector


class Tracking(Checked, ABC):
    """Contract: q^Des from the nominal motion and the measured state.

    A law is two blocks with its memory between them, because the memory may depend on the command, which comes later in the cycle
    (an integral must not grow into a limit of the command). A field `largest` that is empty is given what the limits of the inputs
    allow, so that what the law remembers forgets a demand that no limits could meet.
    """

    def gains(self, order: int) -> tuple[float, ...] | None:  # noqa: ARG002
        """Constant gains for a coordinate of relative order n, q^(n),Des = q^(n),N + sum of gains times errors; None: not constant.

        They are those of (e_int, e, e', ...) with the integral, of (e, e', ...) without; lowest derivative first.
        """
        return None

    def check(self, plant: Plant, period: float) -> None:
        """Raise if the law cannot act on the plant in this control cycle; by default it acts on every plant."""

    @abstractmethod
    def law(self, plant: Plant, period: float) -> Block:
        """Block (state, target, nominal, warm_up, memory) -> (_target_error, desired, ...).

        Where `warm_up` is zero a run begins, and the law must not use its memory.
        """

    @abstractmethod
    def update(self, plant: Plant, period: float) -> Block:
        """Block (_target_error, clipped, _cut_off, _held, ...) -> memory of the law for the next cycle.

        `_cut_off` is the response of every controlled coordinate that limits of the inputs cut off, wanted less possible. `clipped`
        is 1 where some input was clipped, and `_held` where the last command was repeated because that of now cannot be used.
        """

    @abstractmethod
    def delays(self, plant: Plant) -> tuple[Delay, ...]:
        """Signals that the law carries to the next cycle."""


def bounded(law: Tracking, largest: Sequence[float]) -> Tracking:
    """Return the law with the largest response of every controlled coordinate in its field `largest`, where that is empty."""
    if not getattr(law, "largest", True):
        vars(law := copy(law))["largest"] = tuple(largest)  # unchecked: a number of it may be open
    return law


def decay_gains(rate: float, order: int) -> tuple[float, ...]:
    """Return the gains of (e, e', ...) in (d/dt + rate)^n e = 0, lowest derivative first."""
    return tuple(math.comb(order, s) * power(rate, order - s) for s in range(order))


def one_rate(gains: Sequence[float]) -> float | None:
    """Return Lambda where the law of these gains is (d/dt + Lambda)^m z = 0; None where its modes differ."""
    rate = gains[-1] / len(gains)
    return rate if np.allclose(gains, np.poly([-rate] * len(gains))[:0:-1]) else None


ROOM = 10.0  # times the largest response that a law may ask for, because a model may be wrong by a factor


@dataclass(frozen=True)
class Useful:
    """What the integral of an error may ask for."""

    integral: float  # its gain g_0
    error: float  # the gain g_1 of the error itself
    largest: float  # response that the limits of the inputs allow, L; infinite where they are not finite

    def next(self, integral: Expression, error: Expression, period: float) -> Expression:
        """The integral one cycle later.

        The error counts where |g_0 e_int + g_1 e| <= 10 L; so it takes the integral back as soon as the two are of opposite signs.
        An integral with |g_0 e_int| > 20 L, such as one that began at an absurd sample, is forgotten.
        """
        if math.isinf(self.largest):
            return integral + period * error
        most = ROOM * self.largest
        counted = ca.if_else(ca.fabs(self.integral * integral + self.error * error) <= most, error, 0)
        later = integral + period * counted
        return ca.if_else(ca.fabs(self.integral * later) <= 2 * most, later, 0)


class IntegralLaw(Tracking):
    """A law whose memory between cycles is the integral of the error, which does not grow into a limit of the command."""

    def update(self, plant: Plant, period: float) -> Block:
        """Block that integrates the error, except further into a limit of the command, and within its bounds."""
        return integral_update(plant, period, self._useful(plant))

    def delays(self, plant: Plant) -> tuple[Delay, ...]:
        return integral_delay(plant)

    @abstractmethod
    def _useful(self, plant: Plant) -> list[Useful]:
        """What the integrals may ask for; nothing where they are not fed back."""


def law_signals(plant: Plant) -> tuple[Layout, Layout]:
    """Signals that the law of an integrating tracking law reads and writes."""
    reads = (
        plant.output,
        Signal("_target", plant.output.elements, plant.output.units),
        plant.response_signal("nominal"),
        scalar("warm_up"),
        integral_signal(plant, "_integral_before"),
    )
    writes = (error_signal(plant), plant.response_signal("desired"), integral_signal(plant, "_integral_used"))
    return Layout(reads), Layout(writes)


def integral_update(plant: Plant, period: float, useful: Sequence[Useful] = ()) -> Block:
    """Block that integrates the error, except further into a limit, and where it asks for what no limits could meet.

    Every coordinate is judged alone: its error counts where it is not of the sign of '_cut_off', what limits cut off of its
    demand. So it takes the integral out of a limit, where a frozen integral could stay for ever.

    Args:
        period: of the control cycle, s.
        useful: what the integral of every controlled coordinate may ask for; empty: anything.
    """
    cut_off, held, integral = plant.response_signal("_cut_off"), scalar("_held"), integral_signal(plant, "integral")
    reads = (error_signal(plant), cut_off, held, replace(integral, name="_integral_used"))

    def step(s: Signals) -> dict[str, Expression]:
        counts = ca.logic_and(s._target_error * s._cut_off <= 0, ca.logic_not(s._held))
        error = ca.if_else(counts, s._target_error, 0)
        if not useful:
            return {"integral": s._integral_used + period * error}
        columns = zip(useful, ca.vertsplit(s._integral_used), ca.vertsplit(error), strict=True)
        return {"integral": ca.vertcat(*(one.next(i, e, period) for one, i, e in columns))}

    return Block("tracking_update", Layout(reads), Layout((integral,)), step)


def integral_delay(plant: Plant) -> tuple[Delay, ...]:
    """Delay that carries the updated integral to the next cycle."""
    return (Delay(integral_signal(plant, "_integral_before"), "integral"),)


def error_signal(plant: Plant) -> Signal:
    """Error to the target of every controlled coordinate."""
    return vector("_target_error", plant.controlled_names, [plant.followed[c] for c in plant.controlled_names])


def integral_signal(plant: Plant, name: str) -> Signal:
    """Integral of the error of every controlled coordinate, under the given name."""
    units = [f"{plant.followed[c]} {plant.time_unit}" for c in plant.controlled_names]
    return vector(name, plant.controlled_names, units)


def error_chains(plant: Plant, error: Expression) -> list[list[Expression]]:
    """Per controlled coordinate: [e, e', ...] below its relative order; nothing for one of order 0."""
    place = plant.output.elements.index
    return [[error[place(name + "'" * s)] for s in range(order)] for name, order in plant.response_orders.items()]


def own_errors(plant: Plant, error: Expression) -> list[Expression]:
    """The error e of every controlled coordinate."""
    return [error[plant.output.elements.index(name)] for name in plant.controlled_names]
