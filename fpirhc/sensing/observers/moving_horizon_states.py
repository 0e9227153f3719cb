"""States that no sensor shows, by least squares over a window of the last N + 1 samples.

    minimise  |x_0 - a|^2_{P^-1} + sum |w_i|^2_{W^-1} + sum |y_i - h(x_i, u_i)|^2_{R^-1}     with x_{i+1} = F(x_i, u_{i+1}, w_i),

Theory: docs/theory-estimation.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidProblem, InvalidValue, Mistakes
from fpirhc.fields.kinds import Deviation, Positive, whole
from fpirhc.plant.motion import outside_names
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import (
    Correct,
    Evidence,
    Model,
    Predict,
    Remembered,
    WeighingObserver,
    covariance_entries,
    first_covariance,
    values_of,
)
from fpirhc.symbolic.layout import Expression, Layout, Signal

_STAYS = 0.1  # share of its distance from a bound that a step leaves at least


@dataclass(frozen=True, eq=False)
class Interior:
    """States inside some bounds, kept from inside: by a logarithm of the distance, and by steps that leave a tenth of it.

    To second order the cost -mu log s of a distance s is a measurement of this distance that says 2 s, with the deviation
    s / sqrt(mu).
    """

    elements: tuple[str, ...]  # names of the states
    # state -> (lower, upper); an end may be infinite
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    barrier: float = 1.0  # weight mu of the logarithm

    @property
    def ends(self) -> list[tuple[int, float, float]]:
        """Place, value and direction (1: lower, -1: upper) of every finite end."""
        both = [
            (self.elements.index(n), e, d) for n, b in self.bounds.items() for e, d in zip(b, (1.0, -1.0), strict=True)
        ]
        return [one for one in both if math.isfinite(one[1])]

    def measured(self, x: ca.SX) -> tuple[ca.SX, ca.SX, list[ca.SX]]:
        """Return errors, slopes and variances of the measurements for which the logarithms stand."""
        distances, slopes = ca.SX(0, 1), ca.SX(0, x.numel())
        for place, end, direction in self.ends:
            slope = ca.SX.zeros(1, x.numel())
            slope[place] = direction
            distances, slopes = ca.vertcat(distances, direction * (x[place] - end)), ca.vertcat(slopes, slope)
        return distances, slopes, [d**2 / self.barrier for d in ca.vertsplit(distances)] if self.ends else []

    def bounded(self, before: Expression, after: Expression) -> Expression:
        """Return a state that has at least a tenth of the distance from every bound that another state has."""
        entries = ca.vertsplit(after)
        for place, end, direction in self.ends:
            nearest = end + _STAYS * (before[place] - end)
            entries[place] = (ca.fmax if direction > 0 else ca.fmin)(entries[place], nearest)
        return ca.vertcat(*entries)


@dataclass(frozen=True, eq=False)
class Smoother:
    """The functions of a window.

    A row of the window has all that is known of one sample: whether it counts, the share of a cycle by which it is later than the
    one before, the measured quantities, the command and the signals from outside that acted until then.

    Args:
        model: the model.
        measured: quantity -> deviation of the noise of its sensor.
        noise: coordinate -> deviation of what its response has beyond the model in a cycle.
        interior: the bounded states, with the weight mu.
    """

    model: Model
    measured: Mapping[str, float]
    noise: Mapping[str, float]
    interior: Interior

    @property
    def row_size(self) -> int:
        """Entries of a row."""
        plant = self.model.plant
        return 2 + len(self.measured) + plant.input.size + len(outside_names(plant))

    def row(self, counts: Expression, moves: Expression, shown: Expression, u: Expression, p: Expression) -> Expression:
        """Return the row of a sample."""
        return ca.vertcat(counts, moves, shown, u, *(p[k] for k in self._signals))

    def step(self, count: int) -> ca.Function:
        """Function (states, noises, mean, covariance, rows, parameters) -> (states, noises) after one step, `count` samples."""
        size, few = self._size, len(self.noise)
        states, rows = ca.MX.sym("states", size, count), ca.MX.sym("rows", self.row_size, count)
        noises, p = ca.MX.sym("noises", few, count - 1), ca.MX.sym("p", self.model.plant.parameter.size)
        mean, covariance = ca.MX.sym("mean", size), ca.MX.sym("covariance", size * size)
        # Behind the last sample stands one that does not move.
        beyond = (
            ca.horzcat(v[:, 1:], last) for v, last in ((states, states[:, -1]), (rows, ca.DM.zeros(self.row_size)))
        )
        filled, same = ca.horzcat(noises, ca.DM.zeros(few, 1)), ca.repmat(p, 1, count)
        first = ca.vertcat(mean - states[:, 0], covariance)
        passed, *data = self.forward.mapaccum(count)(first, states, rows, filled, *beyond, same)
        before = ca.horzcat(first, passed[:, :-1])
        turned = [v[:, list(range(count))[::-1]] for v in (before, *data)]
        _, changes, smooth = self.backward.mapaccum(count)(ca.DM.zeros(size), *turned)
        forth = list(range(count))[::-1]
        guess, change = ca.SX.sym("x", size), ca.SX.sym("d", size)
        bounded = ca.Function("fpirhc_bounded", [guess, change], [self.interior.bounded(guess, guess + change)])
        results = [bounded.map(count)(states, changes[:, forth]), smooth[:, forth[:-1]]]
        return ca.Function("fpirhc_smooth", [states, noises, mean, covariance, rows, p], results)

    @cached_property
    def absorb(self) -> ca.Function:
        """Function (mean, covariance, state, row, noise, next state, next row, parameters) -> (mean, covariance) one sample later.

        The sample is linearised at the state; bounds have no part in what is known of earlier samples.
        """
        free, size = replace(self, interior=replace(self.interior, bounds={})), self._size
        _, x, row, w, x_next, row_next, p = self._symbols()
        mean, covariance = ca.SX.sym("mean", size), ca.SX.sym("covariance", size * size)
        carried = free.forward(ca.vertcat(mean - x, covariance), x, row, w, x_next, row_next, p)[0]
        results = [x_next + carried[:size], carried[size:]]
        return ca.Function("fpirhc_absorb", [mean, covariance, x, row, w, x_next, row_next, p], results)

    @cached_property
    def forward(self) -> ca.Function:
        """Function (d and its covariance, state, row, noise, next state, next row, parameters) -> (d .. one sample later, data).

        d is the deviation of the state from its guess, and the data of the way back are A, B, C, K, and v / S.
        """
        size = self._size
        carried, x, row, w, x_next, row_next, p = self._symbols()
        errors, slopes, variances = self._compared(x, row, p)
        deviation, covariance = carried[:size], ca.reshape(carried[size:], size, size)
        gains, scaled = [], []
        for k, variance in enumerate(variances):
            c = slopes[k, :]
            g = covariance @ c.T
            spread = c @ g + variance
            gain, innovation = g / spread, errors[k] - c @ deviation
            rest = covariance - gain @ g.T
            covariance = rest - (rest @ c.T) @ gain.T + variance * gain @ gain.T  # Joseph's form
            deviation = deviation + gain * innovation
            gains.append(gain)
            scaled.append(innovation / spread)
        later, slope, effect = self._motion(x, w, row_next, p)
        covariance = slope @ covariance @ slope.T + effect @ self._white @ effect.T
        deviation = later - x_next + slope @ deviation - effect @ w
        after = ca.vertcat(deviation, ca.vec((covariance + covariance.T) / 2))
        data = [slope, effect, slopes.T, ca.horzcat(*gains), ca.vertcat(*scaled)]
        results = [after, *(ca.vec(v) for v in data)]
        return ca.Function(
            "fpirhc_forward", [carried, x, row, w, x_next, row_next, p], [ca.densify(v) for v in results]
        )

    @cached_property
    def backward(self) -> ca.Function:
        """Function (adjoint, d and its covariance, data) -> (adjoint one sample earlier, change of the state, noise)."""
        size, few = self._size, len(self.noise)
        count = self.forward.size1_out(5)
        sizes = {
            "l": size,
            "d": size + size * size,
            "A": size * size,
            "B": size * few,
            "C": size * count,
            "K": size * count,
        }
        inputs = [ca.SX.sym(name, n) for name, n in {**sizes, "v": count}.items()]
        adjoint, carried, *columns, scaled = inputs
        slope, effect, slopes, gains = (ca.reshape(v, size, v.numel() // size) for v in columns)
        earlier, noise = slope.T @ adjoint, -self._white @ (effect.T @ adjoint)
        for k in reversed(range(count)):
            c, gain = slopes[:, k], gains[:, k]
            earlier = earlier - c * (gain.T @ earlier) - c * scaled[k]
        change = carried[:size] - ca.reshape(carried[size:], size, size) @ earlier
        return ca.Function("fpirhc_backward", inputs, [earlier, change, noise])

    @property
    def _size(self) -> int:
        return self.model.plant.state.size

    @property
    def _white(self) -> ca.DM:
        """Covariance of the noise, W."""
        return ca.diag(ca.DM([d**2 for d in self.noise.values()]))

    @property
    def _signals(self) -> list[int]:
        plant = self.model.plant
        return [plant.parameter.elements.index(n) for n in outside_names(plant)]

    def _symbols(self) -> tuple[ca.SX, ...]:
        size, few = self._size, len(self.noise)
        sizes = {"c": size + size * size, "x": size, "row": self.row_size, "w": few}
        sizes |= {"x_next": size, "row_next": self.row_size, "p": self.model.plant.parameter.size}
        return tuple(ca.SX.sym(name, n) for name, n in sizes.items())

    def _acted(self, row: ca.SX, p: ca.SX) -> tuple[ca.SX, ca.SX]:
        at, count = 2 + len(self.measured), self.model.plant.input.size
        values = dict(zip(self._signals, ca.vertsplit(row[at + count :]), strict=True)) if self._signals else {}
        parameters = [values.get(k, p[k]) for k in range(p.numel())]
        return row[at : at + count], ca.vertcat(*parameters) if parameters else p

    def _compared(self, x: ca.SX, row: ca.SX, p: ca.SX) -> tuple[ca.SX, ca.SX, list[ca.SX | float]]:
        """Errors, slopes and variances of measurements and of distances from bounds; without a sample errors and slopes are 0."""
        u, acted = self._acted(row, p)
        values = values_of(self.model.plant, x, u, acted)
        expected = ca.vertcat(*(values[n] for n in self.measured))
        distances, directions, spreads = self.interior.measured(x)
        errors = ca.vertcat(row[2 : 2 + len(self.measured)] - expected, distances)
        slopes = ca.vertcat(ca.densify(ca.jacobian(expected, x)), directions)
        variances: list[ca.SX | float] = [*(d**2 for d in self.measured.values()), *spreads]
        counts = row[0] > 0.5
        return ca.if_else(counts, errors, 0), ca.if_else(counts, slopes, 0), variances

    def _motion(self, x: ca.SX, w: ca.SX, row: ca.SX, p: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        """The next state, and its Jacobians with respect to state and noise."""
        u, acted = self._acted(row, p)
        names, places = self.model.plant.names, list(self.noise)
        forcing = ca.vertcat(*(w[places.index(n)] if n in places else 0 for n in names))
        after = self.model.move(x, u, acted, forcing, row[1])
        return after, ca.densify(ca.jacobian(after, x)), ca.densify(ca.jacobian(after, w))


MOST = 500  # samples of a window: the memory has a fixed size
_STATES, _NOISES, _ROWS = "observer_states", "observer_noises", "observer_samples"
_MEAN, _COVARIANCE = "observer_arrival", "observer_covariance"


@dataclass(frozen=True, eq=False)
class MovingHorizonStates(WeighingObserver):
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
    window: Annotated[int, whole(1, MOST)]
    start: Mapping[str, Deviation] = field(default_factory=dict)
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    iterations: Annotated[int, whole(1, 50)] = 1
    barrier: Positive = 1e-2

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, (lower, upper) in self.bounds.items():
            if not lower < upper:
                raise InvalidValue(
                    f"MovingHorizonStates: bounds of '{name}' are ({lower!r}, {upper!r}); write lower < upper"
                )

    def _mistakes(self, plant: Plant, shown: tuple[str, ...]) -> Mistakes:
        mistakes = super()._mistakes(plant, shown)
        mistakes.unknown("bounds: state", self.bounds, plant.state.elements)
        return mistakes

    opaque = True

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
        calm, size = np.zeros(len(model.plant.names)), model.plant.state.size
        smoother = self._smoother(model)

        def predicted(evidence: Evidence, memory: Remembered) -> Expression:
            newest = memory[_STATES][-size:]
            after = model.move(newest, evidence.command, evidence.parameters, calm, evidence.moves)
            return smoother.interior.bounded(newest, after)

        return predicted

    def correct(self, model: Model) -> Correct:
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

    def _smoother(self, model: Model) -> Smoother:
        interior = Interior(model.plant.state.elements, self.bounds, self.barrier)
        return Smoother(model, self.measured, self.noise, interior)


EXAMPLES = (MovingHorizonStates(measured={"a": 1e-3, "b": 1e-3}, noise={"a": 1.0, "b": 1.0}, window=5),)
