"""Which target was in force when an output was measured: the pair of a fixed-point iteration on targets.

    f^_k = reference_{k-d} + z_k,        z_{k+1} = rho z_k + (1 - rho) shift_{k-d},        rho = exp(-T / lag^)

d is the believed dead time in cycles. An inner controller knows how its reference moves, so the model follows that after the dead
time alone. A shift has no derivative: the model follows it with the time constant lag^, and forgets its start as fast. The
iteration runs on f - f^, in the model-referenced form. With one input, a plant whose gain is lambda times the model's, and cycles
that are short against the lag, it is

    (s + w)(lag s + 1) + (lambda - 1) w = 0,

damped by at least 1 / sqrt(lambda) at any speed w. A lag or a dead time that is wrong changes little; none at all is worst, because
the iteration then goes on while the output is still under way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue
from fpirhc.fields.checked import Checked
from fpirhc.plant.maps import growth_of
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Signal
from fpirhc.symbolic.queue import MOST, Queue, every
from fpirhc.task.problem import Problem

_STILL = 1e-9  # smallest decay of a settling mode, as a share of the fastest mode's rate


@dataclass(frozen=True)
class ThroughModel(Checked):
    """The target passed through the model's dead time and lag.

    Args:
        lag: time constant with which the model follows a shift of its target, in the plant's unit of time; a tuple has one per
            controlled coordinate, 0 settles within a cycle. None: the slowest one of the model at the start, with the command held;
            0 for outputs of order 0, which the model moves at once.
        dead_time: from a target to its measured output; None: that of the problem, for the slowest input.

    Raises:
        InvalidValue: a negative or infinite time.
    """

    lag: float | tuple[float, ...] | None = field(default=None, metadata={"structure": True})
    dead_time: float | None = field(default=None, metadata={"structure": True})

    def __post_init__(self) -> None:
        times = [
            *(every(self.lag) if self.lag is not None else ()),
            *([] if self.dead_time is None else [self.dead_time]),
        ]
        if not all(math.isfinite(t) and t >= 0 for t in times):
            raise InvalidValue(f"{self!r}: expected finite times of at least 0")

    def stated(self, problem: Problem) -> ThroughModel:
        """Return the pairing with lag and dead time as numbers; one that cannot be known stays open, for `decays` to refuse."""
        try:
            lag = _own_lags(problem) if self.lag is None else self.lag
        except InvalidValue:
            return self
        return ThroughModel(lag, self._late(problem))

    def _late(self, problem: Problem) -> float:
        late = problem.dead_time
        return max(late.inputs.values(), default=0.0) + late.measurement if self.dead_time is None else self.dead_time

    def decays(self, problem: Problem) -> np.ndarray:
        """Return rho of every controlled coordinate.

        Raises:
            InvalidValue: a model that does not settle, a wrong number of lags.
        """
        count = len(problem.plant.controlled_names)
        lags = every(_own_lags(problem) if self.lag is None else self.lag)
        if len(lags) not in (1, count):
            raise InvalidValue(
                f"{self!r}: there are {count} controlled coordinates; give one lag for each, or one for all"
            )
        rho = [math.exp(-problem.period / lag) if lag else 0.0 for lag in lags]
        return np.array(rho * count if len(rho) == 1 else rho)

    def queue(self, problem: Problem) -> Queue:
        """Return the queue of targets, newest first: that of the last cycle.

        Raises:
            InvalidValue: more than 1000 cycles.
        """
        cycles = self._late(problem) / problem.period
        if cycles > MOST:
            raise InvalidValue(f"{self!r}: {cycles:g} cycles of dead time, more than {MOST}")
        return Queue(cycles)

    def memory(self, problem: Problem) -> tuple[Signal, ...]:
        """Return references and shifts on their way, newest first, and the shift in force: at first the distance of the start."""
        plant, names = problem.plant, problem.plant.controlled_names
        places = [plant.output.elements.index(n) for n in names]
        first = np.asarray(problem.reference.function(plant)(0.0)[0].full()).ravel()[places]
        away, length = problem.start_output[places] - first, self.queue(problem).length
        queued = tuple(f"{n}@{k}" for k in range(1, length + 1) for n in names)
        return (
            Signal("references_sent", queued, start=tuple(map(float, first)) * length),
            Signal("shifts_sent", queued),
            Signal("shift_in_force", names, start=tuple(map(float, away))),
        )

    def in_force(self, problem: Problem, s: Signals, wanted: Expression) -> Expression:
        """Return the target that was in force when the output of this cycle was measured; `wanted` is the reference of now."""
        queue = self.queue(problem)
        return queue.delayed(queue.pushed(s.references_sent, wanted), wanted.numel()) + s.shift_in_force

    def remembered(self, problem: Problem, s: Signals, wanted: Expression, shift: Expression) -> dict[str, Expression]:
        """Return the memory one cycle later."""
        queue, rho = self.queue(problem), ca.DM(self.decays(problem))
        shifts = queue.pushed(s.shifts_sent, shift)
        return {
            "references_sent_next": queue.pushed(s.references_sent, wanted),
            "shifts_sent_next": shifts,
            "shift_in_force_next": rho * s.shift_in_force + (1 - rho) * queue.delayed(shifts, shift.numel()),
        }


def _own_lags(problem: Problem) -> float | tuple[float, ...]:
    """The model's own time constants, one per controlled quantity where some settle at once."""
    orders = list(problem.plant.response_orders.values())
    slowest = _slowest(problem) if any(orders) else 0.0
    return slowest if all(orders) else tuple(slowest if order else 0.0 for order in orders)


def _slowest(problem: Problem) -> float:
    """Slowest time constant of the model at the start, with the command held."""
    plant = problem.plant
    x, u, p = plant.symbols()
    slope = ca.Function("fpirhc_modes", [x, u, p], [ca.densify(ca.jacobian(plant.equations.rate(x, u, p), x))])
    matrix = np.asarray(slope(problem.start_state, problem.inputs_before, plant.approximate).full())
    modes = np.linalg.eigvals(matrix) if np.isfinite(matrix).all() else np.zeros(1)
    rates = -growth_of(plant)(modes)
    if rates.min() <= _STILL * np.abs(rates).max():
        raise InvalidValue(
            f"ThroughModel(): the model does not settle at the start with its command held (slowest rate {rates.min():.3g} "
            f"{problem.rate_unit}); say how fast the inner controller follows its target: ThroughModel(lag=...)"
        )
    return float(1 / rates.min())
