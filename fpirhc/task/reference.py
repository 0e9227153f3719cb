"""References: the nominal motion and its derivatives, as a function of time; of a map its divided forward differences.

Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidShape, InvalidValue, Mistakes
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Finite, described, real_number
from fpirhc.fields.user_code import called, named_results, scalar_expression
from fpirhc.plant.maps import time_derivatives
from fpirhc.plant.motion import followed, followed_units
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import kind
from fpirhc.symbolic.layout import Expression, Signal

Steps = float | Sequence[Sequence[float]]  # one set-point, or pairs (time, set-point)


_FUNCTIONS: Latest[ca.Function] = Latest(16)


class Reference(Checked, ABC):
    """Contract: the nominal motion of every coordinate, and how the motion of a run differs from it.

    A horizon of N stages asks for a preview of N + 1 nodes; `stages` is N, or 0 for a problem without a horizon.
    """

    @property
    def opaque(self) -> bool:
        """Whether the reference holds operations that scalar expressions cannot, such as the look-up of a table."""
        return False

    @abstractmethod
    def coordinates(self, t: Expression) -> Mapping[str, Expression]:
        """Return {coordinate: expression of t}."""

    def function(self, plant: Plant) -> ca.Function:
        """Function t -> (nominal state (nx), nominal response (n)); of a plant with outputs these are those of its outputs.

        Raises:
            InvalidProblem: a coordinate is missing, unknown, or not a scalar.
        """
        return _FUNCTIONS.of((self, plant.equations), (), lambda: self._function(plant))

    def _function(self, plant: Plant) -> ca.Function:
        matrix, what = kind(self.opaque), followed(plant)
        t = matrix.sym("t")
        motion = {name: matrix(value) for name, value in self.coordinates(t).items()}
        _check(plant, motion, what)
        by = time_derivatives(plant)
        derivatives = {c: by(motion[c], t, r) for c, r in plant.chains.items()}
        state = [derivatives[e.rstrip("'")][e.count("'")] for e in plant.output.elements]
        response = [derivatives[c][r] for c, r in plant.chains.items()]
        results = [ca.densify(ca.vertcat(*state)), ca.densify(ca.vertcat(*response))]
        return ca.Function("fpirhc_reference", [t], results, ["t"], ["state", "response"])

    @property
    def set_points(self) -> Mapping[str, Steps]:
        """The set-points of a run that is given no others, by coordinate; {}: a run gives this reference no set-points."""
        return {}

    def given(self, plant: Plant, stages: int) -> tuple[Signal, ...]:
        """Return the signals that a controller reads from outside for this reference."""
        del plant, stages
        return ()

    def own(self, plant: Plant, stages: int) -> tuple[Signal, ...]:
        """Return the signals on which the motion depends besides the time; the block writes them."""
        del plant, stages
        return ()

    def block(self, plant: Plant, stages: int, period: float) -> Block | None:
        """Return the block from what is given to the own signals; None: there are no own signals."""
        del plant, stages, period
        return None

    def motion_now(self, plant: Plant, stages: int, ahead: float = 0.0) -> ca.Function:
        """Function (t, own signals) -> (state, response) as far as it is known now.

        Args:
            ahead: time by which the motion lies in the future.
        """
        del stages
        function = self.function(plant)
        if ahead == 0:
            return function
        t = kind(self.opaque).sym("t")
        return ca.Function("fpirhc_reference_ahead", [t], list(function(t + ahead)), ["t"], ["state", "response"])

    def preview(self, plant: Plant, nodes: np.ndarray) -> ca.Function | None:
        """Function (t, own signals) -> (states (nx, N + 1), responses (n, N + 1)) at times from t on; None without own signals."""
        del plant, nodes
        return None

    def largest_jump(self, plant: Plant) -> float:
        """Largest known jump of the controlled responses from one cycle to the next, which no derivative shows."""
        del plant
        return 0.0


@dataclass(frozen=True, eq=False)
class Trajectory(Reference):
    """A nominal motion given as expressions of time: Trajectory(lambda t: {"q1": ca.sin(2 * t)}).

        y(t) = m(0) + s (m(t) - m(0)),  y^(k)(t) = s m^(k)(t)       for every coordinate y with its motion m

    Args:
        motion: function of the time in seconds that returns {coordinate: expression}.
        scale: s; how far the motion goes from its first point.
    """

    motion: Callable[[Expression], Mapping[str, Expression]]
    scale: Finite = field(default=1.0, kw_only=True, metadata={"setting": "where given", "structure": True})

    def coordinates(self, t: Expression) -> Mapping[str, Expression]:
        def of(time: Expression) -> dict[str, Expression]:
            named = named_results("reference", called("reference", self.motion, time))
            return {
                str(name): scalar_expression(f"reference: coordinate '{name}'", value, of=self.motion, symbols=(time,))
                for name, value in named.items()
            }

        if self.scale == 1:
            return of(t)
        still = ca.SX.sym("t")
        first = {name: ca.substitute(value, still, 0) for name, value in of(still).items()}
        return {name: first[name] + self.scale * (value - first[name]) for name, value in of(t).items()}


@dataclass(frozen=True, eq=False)
class Table(Reference):
    """A nominal motion given by samples and joined by splines; outside the table it is constant.

    Args:
        times: increasing sample times, shape (m,), s.
        values: coordinate -> samples, shape (m,).
        degree: degree of the splines; derivatives are continuous up to degree - 1.

    Raises:
        InvalidValue: times that do not increase, or values that are not finite.
        InvalidShape: lengths that differ, or too few samples.
    """

    times: Sequence[float] | np.ndarray
    values: Mapping[str, Sequence[float] | np.ndarray]
    degree: int = 5

    def __post_init__(self) -> None:
        times = np.asarray(self.times, dtype=float)
        if times.ndim != 1 or times.size < self.degree + 1:
            raise InvalidShape(f"a table of degree {self.degree} needs at least {self.degree + 1} times")
        if not np.all(np.isfinite(times)) or np.any(np.diff(times) <= 0):
            raise InvalidValue("the times of a table must be finite and increasing")
        for name, samples in self.values.items():
            column = np.asarray(samples, dtype=float)
            if column.shape != times.shape:
                raise InvalidShape(f"table '{name}' has shape {column.shape}, expected {times.shape} as its times")
            if not np.all(np.isfinite(column)):
                raise InvalidValue(f"table '{name}' holds values that are not finite")

    opaque = True

    def coordinates(self, t: Expression) -> Mapping[str, Expression]:
        return {name: self._spline(name, np.asarray(v, dtype=float), t) for name, v in self.values.items()}

    def _spline(self, name: str, samples: np.ndarray, t: Expression) -> Expression:
        times = np.asarray(self.times, dtype=float)
        spline = ca.interpolant(f"fpirhc_table_{name}", "bspline", [times], samples, {"degree": [self.degree]})
        # A choice and not a clamped argument: fmin and fmax have half a derivative at the table's first and last time.
        held = ca.if_else(t < times[0], spline(times[0]), spline(times[-1]))
        return ca.if_else(ca.logic_or(t < times[0], t > times[-1]), held, spline(t))


def _check(plant: Plant, motion: Mapping[str, Expression], what: str) -> None:
    mistakes = Mistakes("reference")
    known = followed_units(plant)
    slopes = [name for name in motion if name not in known and name.rstrip("'") in known]
    for name in slopes:
        mistakes.add(f"'{name}' is taken from '{name.rstrip(chr(39))}' by differentiation; leave it out")
    mistakes.unknown(what, [name for name in motion if name not in slopes], known)
    for c in plant.chains:
        if c not in motion:
            mistakes.add(f"{what} '{c}' has no nominal motion; add '{c}' to the reference")
        elif motion[c].numel() != 1:
            mistakes.add(f"{what} '{c}' must be one scalar, got shape {motion[c].shape}")
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
