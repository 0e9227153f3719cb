"""States that no sensor shows, by least squares over a window of the last N + 1 samples.

    minimise  |x_0 - a|^2_{P^-1} + sum |w_i|^2_{W^-1} + sum |y_i - h(x_i, u_i)|^2_{R^-1}     with x_{i+1} = F(x_i, u_{i+1}, w_i),

and states inside their bounds. A fixed number of Gauss-Newton steps per sample starts from the last window, one sample later; see
`fpirhc.sensing.smoother`. A sample that leaves the window is linearised once more, at the estimate that later samples have
improved, and joins the arrival cost (a, P) as in a Kalman filter. For a linear model with Gaussian noise the estimate is that of
the Kalman filter, whatever the window. For a curved one the window keeps what a filter forgets: its samples are compared with the
model around the newest estimate, and not around a first guess that was wrong.

Bounds are kept by a logarithm of the distance, with the weight `barrier`, so an estimate comes near a bound and never to it.
A step leaves at least a tenth of the distance. Both keep a wrong start away from a solution behind a bound.

References:
    C. V. Rao, J. B. Rawlings and D. Q. Mayne, Constrained state estimation for nonlinear discrete-time systems, IEEE Trans.
    Automatic Control 48(2), 2003.
    E. L. Haseltine and J. B. Rawlings, Critical evaluation of extended Kalman filtering and moving-horizon estimation, Ind. Eng.
    Chem. Res. 44(8), 2005.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidProblem, InvalidValue
from fpirhc.fields.kinds import Deviation, Positive
from fpirhc.plant.plant import Plant
from fpirhc.sensing.observability import unobservable
from fpirhc.sensing.smoother import Interior, Smoother
from fpirhc.sensing.state_observer import (
    Correct,
    Evidence,
    Model,
    Predict,
    Remembered,
    StateObserver,
    covariance_entries,
    first_covariance,
    name_mistakes,
    require_named,
)
from fpirhc.symbolic.layout import Expression, Layout, Signal

MOST = 500  # samples of a window: the memory has a fixed size
_STATES, _NOISES, _ROWS = "observer_states", "observer_noises", "observer_samples"
_MEAN, _COVARIANCE = "observer_arrival", "observer_covariance"


@dataclass(frozen=True, eq=False)
class MovingHorizonStates(StateObserver):
    """The whole state from a window of noisy measurements of a part of it.

    Args:
        measured: quantity -> deviation of the noise of its sensor, in its unit. They are among `Sensing(measured=...)`.
        noise: coordinate -> deviation of what its response has beyond the model in every cycle, white, in the response's unit.
        window: number N of cycles that the window covers; it has N + 1 samples.
        start: state -> deviation of its first value; zero, that is known, where not named.
        bounds: state -> (lower, upper) between which it is believed; the start must lie inside.
        iterations: Gauss-Newton steps per sample.
        barrier: weight mu of a bound. At a bound that holds the estimate against a force l, the distance is mu / l.

    Raises:
        InvalidValue: no measured quantity, no noise; a window or iterations outside their range; bounds in the wrong order.
    """

    measured: Mapping[str, Deviation]
    noise: Mapping[str, Deviation]
    window: int
    start: Mapping[str, Deviation] = field(default_factory=dict)
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    iterations: int = 1
    barrier: Positive = 1e-2

    def __post_init__(self) -> None:
        require_named("MovingHorizonStates", measured=self.measured, noise=self.noise)
        for name, value, most in (("window", self.window, MOST), ("iterations", self.iterations, 50)):
            if not isinstance(value, int) or not 1 <= value <= most:
                raise InvalidValue(f"MovingHorizonStates({name}={value!r}): expected a whole number from 1 to {most}")
        for name, (lower, upper) in self.bounds.items():
            if not lower < upper:
                raise InvalidValue(
                    f"MovingHorizonStates: bounds of '{name}' are ({lower!r}, {upper!r}); write lower < upper"
                )

    def check(self, plant: Plant, measured: tuple[str, ...]) -> None:
        """Raise if a name is unknown or not measured.

        Raises:
            InvalidProblem: all mistakes together.
        """
        mistakes = name_mistakes("MovingHorizonStates", plant, measured, self.measured, self.noise, self.start)
        mistakes.unknown("bounds: state", self.bounds, plant.state.elements)
        mistakes.raise_if_any()

    def believes(self, plant: Plant, known: tuple[str, ...]) -> tuple[str, ...]:
        """The whole state: measured states come filtered."""
        del known
        return plant.state.elements

    def uses(self, measured: tuple[str, ...]) -> tuple[str, ...]:
        """The quantities whose noise is named."""
        del measured
        return tuple(self.measured)

    @property
    def opaque(self) -> bool:
        """True: the window is a loop, and not written out."""
        return True

    def memory(self, model: Model) -> Layout:
        """States, noises and samples of the window, oldest first, and the arrival cost.

        Raises:
            InvalidProblem: a start that is not inside the bounds.
        """
        plant, count, row = model.plant, self.window + 1, self._smoother(model).row_size
        for name, (lower, upper) in self.bounds.items():
            first = model.start[plant.state.elements.index(name)]
            if not lower < first < upper:
                raise InvalidProblem(
                    f"MovingHorizonStates: '{name}' starts at {first:g}, and its bounds are {lower:g} and {upper:g}; start inside, "
                    "or leave the bound out"
                )
        start, covariance = tuple(map(float, model.start)), first_covariance(plant, self.start)
        noises = [f"{n}@{k}" for k in range(self.window) for n in self.noise]
        return Layout(
            (
                Signal(
                    _STATES, tuple(f"{e}@{k}" for k in range(count) for e in plant.state.elements), start=start * count
                ),
                Signal(_NOISES, tuple(noises)),
                Signal(_ROWS, tuple(f"{k}@{i}" for i in range(count) for k in range(row))),
                Signal(_MEAN, plant.state.elements, plant.state.units, start),
                Signal(_COVARIANCE, covariance_entries(plant), start=tuple(map(float, covariance.ravel()))),
            )
        )

    def predict(self, model: Model) -> Predict:
        """One cycle of the model from the newest state of the window."""
        calm, size = np.zeros(len(model.plant.names)), model.plant.state.size
        smoother = self._smoother(model)

        def predicted(evidence: Evidence, memory: Remembered) -> Expression:
            newest = memory[_STATES][-size:]
            after = model.move(newest, evidence.command, evidence.parameters, calm, evidence.moves)
            return smoother.interior.bounded(newest, after)

        return predicted

    def correct(self, model: Model) -> Correct:
        """The exchange of one sample in the window, and the Gauss-Newton steps."""
        smoother, count = self._smoother(model), self.window + 1
        size, few, step = model.plant.state.size, len(self.noise), smoother.step(count)

        def corrected(
            evidence: Evidence, memory: Remembered, predicted: Expression
        ) -> tuple[Expression, dict[str, Expression]]:
            p = evidence.parameters
            shown = ca.vertcat(*(evidence.measured[n] for n in self.measured))
            row = smoother.row(evidence.counts, evidence.moves, shown, evidence.command, p)
            states = ca.reshape(ca.vertcat(memory[_STATES], predicted), size, count + 1)
            rows = ca.reshape(ca.vertcat(memory[_ROWS], row), smoother.row_size, count + 1)
            noises = ca.reshape(ca.vertcat(memory[_NOISES], ca.DM.zeros(few)), few, count)
            leaving = states[:, 0], rows[:, 0], noises[:, 0], states[:, 1], rows[:, 1]
            mean, covariance = smoother.absorb(memory[_MEAN], memory[_COVARIANCE], *leaving, p)
            states, rows, noises = states[:, 1:], rows[:, 1:], noises[:, 1:]
            for _ in range(self.iterations):
                states, noises = step(states, noises, mean, covariance, rows, p)
            columns = {_STATES: states, _NOISES: noises, _ROWS: rows}
            remembered = {name: ca.vec(value) for name, value in columns.items()}
            return states[:, -1], {**remembered, _MEAN: mean, _COVARIANCE: covariance}

        return corrected

    def free(self, slopes: Sequence[np.ndarray], shown: Sequence[np.ndarray], known: Sequence[int]) -> np.ndarray:
        """What cannot be observed along the reference."""
        del known
        return unobservable(slopes, shown)

    @property
    def needs_detectability(self) -> bool:
        """True: the arrival cost of an error that neither decays nor is observed would stay or grow for ever."""
        return True

    def _smoother(self, model: Model) -> Smoother:
        interior = Interior(model.plant.state.elements, self.bounds, self.barrier)
        return Smoother(model, self.measured, self.noise, interior)


EXAMPLES = (MovingHorizonStates(measured={"a": 1e-3, "b": 1e-3}, noise={"a": 1.0, "b": 1.0}, window=5),)
