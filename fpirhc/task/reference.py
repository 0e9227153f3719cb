"""References: the nominal motion and its derivatives, as a function of time; of a map its divided forward differences.

Set-points are values that a run is given while it runs, and a filter, part of the controller's step, makes a motion of them:

    (d/dt + a)^m y = a^m w       for every coordinate y with its set-point w

With z = (y, y', ..., y^(m-1)), b = (1, 0, ..., 0) and w held, z(t + h) = w b + Phi(h) (z(t) - w b) with Phi(h) =
e^(-a h) sum_{k<m} (h N)^k / k!; N = A + a I, A the companion matrix of (s + a)^m, is nilpotent. So motion, velocity and response
belong together. Source: Franklin, Powell, Workman, Digital Control of Dynamic Systems, 1998, 4.3.3. Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar, NoReturn

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue, Mistakes, NotSupported
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Count, Positive, described, real_number
from fpirhc.fields.user_code import called, named_results, scalar_expression
from fpirhc.plant.maps import time_derivatives
from fpirhc.plant.motion import sampling, unit_of
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import Signals, power
from fpirhc.symbolic.layout import Expression, Layout, Signal

Steps = float | Sequence[Sequence[float]]  # one set-point, or pairs (time, set-point)

_GIVEN = "setpoints"  # signal from outside: the set-points in force
_OWN = "_reference_own"  # the filters' state, what is given
_FILTER = "reference_filter"  # remembered: the filters' state
_ON_TIME = 1e-12  # share of a change's time by which a time may be rounded
_LATE = 1e-9  # the same, of a cycle
_FUNCTIONS: Latest[ca.Function] = Latest(16)


class Reference(Checked, ABC):
    """Contract: the nominal motion of every coordinate, and how the motion of a run differs from it.

    A horizon of N stages asks for a preview of N + 1 nodes.
    """

    _WRITTEN: ClassVar[str] = 'fp.Trajectory(lambda t: {"NAME": 1.0}) or fp.Setpoint(values={"NAME": 1.0}, rate=1/TIME)'

    @abstractmethod
    def coordinates(self, t: Expression) -> Mapping[str, Expression]:
        """Return {coordinate: expression of t}."""

    def function(self, plant: Plant) -> ca.Function:
        """Function t -> (nominal state (nx), nominal response (n)); of a plant with outputs these are those of its outputs."""
        return _FUNCTIONS.of((self, plant.equations), (), lambda: self._function(plant))

    def _function(self, plant: Plant) -> ca.Function:
        t = ca.SX.sym("t")
        motion = {name: ca.SX(value) for name, value in self.coordinates(t).items()}
        _check(plant, motion)
        chains = {c: time_derivatives(plant, motion[c], t, r) for c, r in plant.chains.items()}
        state, response = _arranged(plant, chains)
        return ca.Function("fpirhc_reference", [t], [state, response], ["t"], ["state", "response"])

    @property
    def set_points(self) -> Mapping[str, Steps]:
        """The set-points of a run that is given no others, by coordinate; {}: a run gives this reference no set-points."""
        return {}

    def given(self, plant: Plant) -> tuple[Signal, ...]:  # noqa: ARG002
        """Return the signals that a controller reads from outside for this reference."""
        return ()

    def own(self, plant: Plant) -> tuple[Signal, ...]:  # noqa: ARG002
        """Return the signals on which the motion depends besides the time; the block writes them."""
        return ()

    def block(self, plant: Plant, period: float) -> Block | None:  # noqa: ARG002
        """Return the block from what is given to the own signals; None: there are no own signals."""
        return None

    def motion_now(self, plant: Plant, ahead: float = 0.0) -> ca.Function:
        """Function (t, own signals) -> (state, response) as far as it is known now, or `ahead` of it."""
        function, t = self.function(plant), ca.SX.sym("t")
        if ahead == 0:
            return function
        return ca.Function("fpirhc_reference_ahead", [t], list(function(t + ahead)), ["t"], ["state", "response"])

    def preview(self, plant: Plant, nodes: np.ndarray) -> ca.Function | None:
        """Function (t, own signals) -> (states (nx, N + 1), responses (n, N + 1)) at times from t on; None without own signals."""
        t, own = ca.SX.sym("t"), [ca.SX.sym(signal.name, signal.size) for signal in self.own(plant)]
        if not own:
            return None
        columns = [self.motion_now(plant, ahead)(t, *own) for ahead in nodes.tolist()]
        tables = [ca.horzcat(*parts) for parts in zip(*columns, strict=True)]
        return ca.Function("fpirhc_reference_preview", [t, *own], tables)


@dataclass(frozen=True, eq=False)
class Trajectory(Reference):
    """A nominal motion given as expressions of time: Trajectory(lambda t: {"q1": ca.sin(2 * t)}).

    Args:
        motion: function of the time in seconds that returns {coordinate: expression}.
    """

    motion: Callable[[Expression], Mapping[str, Expression]]

    def coordinates(self, t: Expression) -> Mapping[str, Expression]:
        return {
            str(name): scalar_expression(f"reference: coordinate '{name}'", value, of=self.motion, symbols=(t,))
            for name, value in named_results("reference", called("reference", self.motion, t)).items()
        }


@dataclass(frozen=True, eq=False)
class Setpoint(Reference):
    """A motion towards set-points: Setpoint({"q1": 0.2, "q2": [(0.0, 1.0), (2.0, 1.5)]}, rate=10.0).

    Args:
        values: set-points by coordinate: a number, or pairs (time, set-point), each in force from its time on. The filter begins at
            the first one, at rest. A run may be given others (`simulate(..., setpoints=...)`, `Stepper.step(..., setpoints=...)`);
            what is decided before a run follows these, and a horizon knows none before its time.
        rate: a, the rate of the filter, per unit of time, whose time constant is 1/a.
        order: m of every coordinate, at least the plant's order; None: the plant's order. With the plant's order the response jumps
            by a^m (w_new - w_old) at a change, with one more it is continuous.

    Raises:
        InvalidValue: values that are no steps.
    """

    values: Mapping[str, Steps]
    rate: Positive
    order: Count | None = None

    def __post_init__(self) -> None:
        for name, steps in self.values.items():
            pairs(name, steps)

    def coordinates(self, t: Expression) -> NoReturn:  # noqa: ARG002
        raise NotSupported("the motion towards set-points depends on a plant's orders; use Setpoint.function(plant)")

    @property
    def set_points(self) -> Mapping[str, Steps]:
        return self.values

    def _function(self, plant: Plant) -> ca.Function:
        """Function t -> (state, response) along `values`: a sum of step responses."""
        below = (
            f"Setpoint(order={self.order}) is below the order {r} of '{n}', whose motion would jump; leave order out"
            for n, r in plant.chains.items()
            if self.order is not None and self.order < r
        )
        _check(plant, dict.fromkeys(self.values, ca.SX(0)), below)
        t, chains = ca.SX.sym("t"), {}
        for name, order in self._orders(plant).items():
            rest = self._first(name)
            held, z = ca.SX(rest), ca.SX(ca.DM([rest, *[0.0] * (order - 1)]))
            for (_, old), (time, new) in pairwise(pairs(name, self.values[name])):
                if new != old:
                    rising = _transition(self.rate, ca.fmax(t - time, 0), order)[:, 0]
                    z = z + (new - old) * (ca.DM(np.eye(order)[:, 0]) - rising)
                    held = held + (new - old) * (t >= time * (1 - _ON_TIME))
            chains[name] = self._chain(plant, z, held)
        return ca.Function("fpirhc_reference", [t], list(_arranged(plant, chains)), ["t"], ["state", "response"])

    def given(self, plant: Plant) -> tuple[Signal, ...]:
        first = tuple(map(self._first, plant.chains))
        return (Signal(_GIVEN, tuple(plant.chains), plant.output.units[: len(first)], start=first),)

    def own(self, plant: Plant) -> tuple[Signal, ...]:
        """The filters' state, and the set-points."""
        return (Signal(_OWN, (*self._elements(plant), *(f"{_GIVEN}.{name}" for name in plant.chains))),)

    def block(self, plant: Plant, period: float) -> Block:
        (given,), (own,), elements = self.given(plant), self.own(plant), self._elements(plant)
        motion, rest = self.motion_now(plant), {name: self._first(name) for name in plant.chains}

        def step(s: Signals) -> dict[str, Expression]:
            z, points = getattr(s, _FILTER), getattr(s, _GIVEN)
            along = ca.vertcat(z, points)
            return {
                "setpoint": points,
                "reference_response": motion(0.0, along)[1],
                _OWN: along,
                f"{_FILTER}_next": self._later(plant, z, points, period),
            }

        names, units = given.elements, tuple(unit_of(plant, name + "'" * order) for name, order in plant.chains.items())
        shown = Signal("setpoint", names, given.units), Signal("reference_response", names, units)
        memory = Signal(_FILTER, elements, start=tuple(rest.get(element, 0.0) for element in elements))
        return Block("set_points", Layout((given,)), Layout((*shown, own)), step, Layout((memory,)))

    def motion_now(self, plant: Plant, ahead: float = 0.0) -> ca.Function:
        own = ca.SX.sym("own", self.own(plant)[0].size)
        z, points = ca.vertsplit(own, [0, len(self._elements(plant)), own.numel()])
        orders, z = self._orders(plant), self._later(plant, z, points, ahead) if ahead else z
        parts = ca.vertsplit(z, [0, *np.cumsum(list(orders.values())).tolist()])
        motion = _arranged(plant, {c: self._chain(plant, parts[k], points[k]) for k, c in enumerate(orders)})
        arguments, names = [ca.SX.sym("t"), own], ["t", "own"]
        return ca.Function("fpirhc_reference_now", arguments, list(motion), names, ["state", "response"])

    def _later(self, plant: Plant, z: Expression, points: Expression, time: float) -> Expression:
        """The state of all filters after a time with the set-points held; at rest every difference is exactly zero."""
        orders = self._orders(plant)
        aims = ca.diagcat(*(ca.DM(np.eye(order)[:, 0]) for order in orders.values())) @ points
        phi = ca.diagcat(*(_transition(self.rate, time, order) for order in orders.values()))
        return aims + phi @ (z - aims)

    def _chain(self, plant: Plant, z: Expression, held: Expression) -> list[Expression]:
        """(y, y', ..., y^(m)) of a filter in the state z, for w = `held`; of a map y and its divided forward differences."""
        order = z.numel()
        if plant.step is None:  # a rest is at zero, not at minus zero
            highest = power(self.rate, order) * (held - z[0])
            for j in range(1, order):
                highest = highest - math.comb(order, j) * power(self.rate, order - j) * z[j]
            return [*ca.vertsplit(z), highest]
        step, values, apart = sampling(plant), [z[0]], ca.vertcat(z[0] - held, z[1:])
        phi = _transition(self.rate, step, order)
        for _ in range(order):
            apart = (phi @ apart - apart) / step
            values.append(apart[0])
        return values

    def _elements(self, plant: Plant) -> tuple[str, ...]:
        """Names of the filters' states: y, y', ... of every coordinate."""
        return tuple(name + "'" * k for name, order in self._orders(plant).items() for k in range(order))

    def _orders(self, plant: Plant) -> dict[str, int]:
        return {c: self.order or r for c, r in plant.chains.items()}

    def _first(self, name: str) -> float:
        """Where the filter of a coordinate begins."""
        return pairs(name, self.values[name])[0][1]


def _transition(rate: float, time: float | ca.SX, order: int) -> ca.DM | ca.SX:
    """Phi(time), shape (order, order)."""
    matrix = ca.SX if isinstance(time, ca.SX) else ca.DM
    companion = [[0.0] * order] * (order - 1) + [[math.comb(order, j) * power(rate, order - j) for j in range(order)]]
    nilpotent = matrix(np.eye(order, k=1) + rate * np.eye(order) - companion)
    term = terms = matrix.eye(order)
    for k in range(1, order):
        term = term @ nilpotent * time / k
        terms = terms + term
    return ca.exp(-(rate * time)) * terms


def _arranged(plant: Plant, chains: Mapping[str, Sequence[Expression]]) -> tuple[Expression, Expression]:
    """State in the plant's order and response, of (y, y', ..., y^(r)) of every coordinate."""
    state = [chains[e.rstrip("'")][e.count("'")] for e in plant.output.elements]
    response = [chains[c][r] for c, r in plant.chains.items()]
    return ca.densify(ca.vertcat(*state)), ca.densify(ca.vertcat(*response))


def _check(plant: Plant, motion: Mapping[str, Expression], own: Iterable[str] = ()) -> None:
    mistakes = Mistakes("reference")
    mistakes.join(own)
    known = plant.followed
    slopes = [name for name in motion if name not in known and name.rstrip("'") in known]
    for name in slopes:
        mistakes.add(f"'{name}' is taken from '{name.rstrip(chr(39))}' by differentiation; leave it out")
    mistakes.unknown("quantity", [name for name in motion if name not in slopes], known)
    for c in plant.chains:
        if c not in motion:
            mistakes.add(f"'{c}' has no nominal motion; add '{c}' to the reference")
        elif motion[c].numel() != 1:
            mistakes.add(f"'{c}' must be one scalar, got shape {motion[c].shape}")
    mistakes.raise_if_any()


def pairs(name: str, steps: Steps) -> list[tuple[float, float]]:
    """Return the steps of one coordinate as pairs (time, set-point)."""
    entries = [(0.0, steps)] if not isinstance(steps, Sequence | np.ndarray) else list(steps)
    text = f"set-points of '{name}'"
    if not entries or any(not isinstance(e, Sequence | np.ndarray) or len(e) != 2 for e in entries):
        raise InvalidValue(f"{text}: expected a number, or pairs (time, set-point), got {steps!r}")
    numbers: list[tuple[float, float]] = []
    for entry in entries:
        time, value = map(real_number, entry)
        if time is None or value is None or not (math.isfinite(time) and math.isfinite(value)):
            raise InvalidValue(
                f"{text}: expected finite numbers, got {described(entry if len(entries) > 1 else steps)}"
            )
        numbers.append((time, value))
    times = [time for time, _ in numbers]
    if times[0] != 0 or any(later <= time for time, later in pairwise(times)):
        raise InvalidValue(f"{text}: the times must begin at 0 and increase, got {times}")
    return numbers


def in_force(steps: Sequence[tuple[float, float]], times: np.ndarray, period: float) -> np.ndarray:
    """Return the set-point at some times: a change counts from the first cycle at or after its time."""
    begins, values = np.array(steps).T
    return values[np.searchsorted(begins, times + _LATE * period, side="right") - 1]
