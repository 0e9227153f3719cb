"""The way from the plant to the controller: sensors, their dead time, and an estimator of unmeasured quantities.

    true plant -> sensors -> measurement dead time -> [estimator -> controller]

Theory: docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import BelowOne, Positive
from fpirhc.plant.chain import quantities, response_names
from fpirhc.plant.motion import unit_of
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import Array, DerivativeEstimator, Measured, StateObserver
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal, vector
from fpirhc.task.dead_time import Queue, delay_block
from fpirhc.task.disturbance import Disturbance, Noise


@dataclass(frozen=True, eq=False)
class Sensor(Checked):
    """Noise, quantisation, lost samples and range of one measured quantity.

    Args:
        noise: signal that adds to the true value, in its unit: Noise, Step (bias), Formula (drift, hum);
            None: no noise.
        quantum: Q, the resolution (of an encoder, for example), in the quantity's unit; None: no quantisation.
        dropout: probability that a cycle's sample is lost. A cycle in which one quantity is lost is skipped, as on a real plant:
            the command is held, with the status BAD_SAMPLE.
        range: (lower, upper), what a working sensor shows, in the quantity's unit; one side may be infinite. A sample outside
            skips the cycle, for as long as it is outside. None: every finite number is believed.

    Raises:
        InvalidValue: a range whose lower end is not below its upper one.
    """

    noise: Disturbance | None = None
    quantum: Positive | None = None
    dropout: BelowOne = 0.0
    range: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.range is not None and not self.range[0] < self.range[1]:
            raise InvalidValue(f"Sensor(range={self.range!r}): expected (lower, upper) with lower < upper")

    @property
    def acts(self) -> bool:
        """Whether it changes what is measured."""
        return self.noise is not None or self.quantum is not None or self.dropout > 0


class Fault(NamedTuple):
    """What can grow in all sensors of a problem."""

    told: str  # what grows, in words
    unit: str
    first: float  # the smallest value that is of interest
    most: float
    of: Callable[[Sensor, float, float, int], Sensor]  # (sensor, value, range of what it shows, number of sensors)


FAULTS = {
    "noise": Fault(
        "all that is measured has white noise of this deviation, up to 410 % of the range of the reference",
        "of the range", 1e-3, 4.096,
        lambda sensor, value, size, _: replace(sensor, noise=Noise(value * size)) if value * size else sensor),
    "lost": Fault(  # a cycle in which one sensor loses its sample has none
        "samples are lost at random, up to 98 %", "of the samples", 0.02, 0.98,
        lambda sensor, value, _, count: replace(sensor, dropout=1 - (1 - value) ** (1 / count))),
}  # fmt: skip
_DIGITS = 9  # decimals of a delay in cycles, so that half a cycle is one
_STREAM = 1  # separates the sensors' random series from the series of disturbances


@dataclass(frozen=True, eq=False)
class Sensing(Checked):
    """Sensors and estimator between plant and controller; ideal by default.

    Args:
        sensors: by name of the measured quantity, which is a state element ("q1", "q1'") or, where the estimator measures it, the
            highest derivative of a controlled coordinate ("q1''"). A quantity that is not named is measured perfectly. Of a plant
            with outputs, coordinates are its outputs; with an observer, states may be measured beside them.
        estimator: of state and response from the measured quantities: Measured, VelocityDifference, LowPassDifference,
            PositionDifference, SavitzkyGolay.
        measured: names of the quantities that sensors show; None: all that the estimator needs.
        observer: how the states that no sensor shows are known: KalmanFilter. See
            `fpirhc.sensing.base`.
    """

    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    estimator: DerivativeEstimator = field(default_factory=Measured)
    measured: Sequence[str] | None = field(default=None, kw_only=True)
    observer: StateObserver | None = field(default=None, kw_only=True)

    @property
    def ideal(self) -> bool:
        """Whether the controller receives the true state and response."""
        return not any(sensor.acts for sensor in self.sensors.values()) and not self.estimates

    @property
    def estimates(self) -> bool:
        """Whether state or response are estimated, so that a controller's step begins with raw measurements."""
        return not self.estimator.measures_all or self.measured is not None or self.observer is not None

    def spreads(self, plant: Plant) -> bool:
        """Whether a response is a mean over time, and not that of one state and one command."""
        return not (self.estimator.measures_all or plant.response_age)

    def measures(self, plant: Plant) -> tuple[str, ...]:
        """Names of the measured quantities: states, outputs, and highest derivatives of controlled ones."""
        if self.measured is None:
            return self.estimator.measures(plant)
        return tuple(n for n in quantities(plant) if n in self.measured)

    def believed_response(self, plant: Plant) -> tuple[str, ...]:
        """Quantities that the response follows from and no sensor shows."""
        names, measured = self.estimator.measures(plant), self.measures(plant)
        if {*names} <= {*measured}:
            return ()
        block = self.estimator.block(plant, 1.0, np.zeros(plant.output.size), Signal("_seen", names))
        answers = block.function.jac_sparsity(1, 0).get_triplet()[1]
        return tuple(n for k, n in enumerate(names) if k in answers and n not in measured)

    def check(self, plant: Plant) -> None:
        """Raise if a sensor's quantity is unknown or not measured, or the estimator cannot serve the plant.

        Raises:
            InvalidProblem: all mistakes together.
        """
        mistakes = Mistakes("sensing")
        measures, every = self.measures(plant), quantities(plant)
        mistakes.unknown("sensors: quantity", self.sensors, every)
        for name in self.sensors:
            if name in every and name not in measures:
                by = self.observer if self.observer and name in plant.state.elements else self.estimator
                what = f"'{name}' is estimated by {type(by).__name__}, not measured"
                mistakes.add(f"sensors: {what}; sensors are those of {', '.join(measures)}")
        mistakes.unknown("measured: quantity", self.measured or (), every)
        for mistake in self._uncovered(plant):
            mistakes.add(mistake)
        with mistakes.caught():
            self.estimator.check(plant)
        if self.observer is not None:
            with mistakes.caught():
                self.observer.check(plant, measures)
        mistakes.raise_if_any()

    def _uncovered(self, plant: Plant) -> Iterator[str]:
        """Sentences about what is needed and neither measured nor believed, and about an observer without need.

        The outputs that controllers follow are measured or estimated, never believed: an output that the wrong model computes would
        be followed in place of the true one.
        """
        own, believes, measured = type(self.estimator).__name__, self.observer is not None, self.measures(plant)
        missing = [n for n in self.estimator.measures(plant) if n not in measured]
        beside = {e for signal in plant.beside for e in signal.elements}
        followed = [n for n in missing if n.rstrip("'") in beside.intersection(plant.controlled_names)]
        states = [n for n in measured if n not in plant.output.elements and n in plant.state.elements]
        if self.measured is not None and not measured:
            yield "measured: name at least one quantity; Sensing() without it measures all that the estimator needs"
        elif missing and not believes:
            yield (
                f"measured: {own} also needs {', '.join(missing)}; measure it, or estimate it by "
                "an observer: Sensing(measured=..., observer=KalmanFilter(...))"
            )
        if believes and followed:
            yield (
                f"measured: {own} needs {', '.join(followed)}, and outputs that are controlled are measured or differentiated, "
                "never observed; measure it, or choose an estimator of what is measured, such as PositionDifference()"
            )
        if states and not believes:
            yield (
                f"measured: {', '.join(states)} is given as it is to controllers of a plant with outputs, unless an "
                "observer is stated: leave it out, or add Sensing(..., observer=KalmanFilter(...))"
            )

    def delay(self, plant: Plant, period: float) -> float:
        """Largest delay of an estimated response in cycles beyond the ideal pair: the centre of its weights."""
        weights = (self.estimator.weights(plant.chains[name], period) for name in plant.controlled_names)
        return max(round(float(one @ np.arange(one.size)), _DIGITS) for one in weights)

    def warm_up_cycles(self, plant: Plant, late: float) -> int:
        """Number of the first cycle whose response may be used; samples arrive `late` cycles after they were taken."""
        if self.estimator.measures_all:
            return 1
        return Queue(late).length - 1 + max(self.estimator.fills(plant.chains[name]) for name in plant.controlled_names)

    @property
    def drawn(self) -> tuple[Signal, ...]:
        """The signal of all random series; empty where there is none."""
        return (Signal("sensing", self._columns),) if self._columns else ()

    def table(self, times: Array, seed: int) -> Array:
        """Noise and lost samples (1: lost) of every cycle, shape (cycles, size of `drawn`); each column has its own stream."""
        streams = np.random.SeedSequence((seed, _STREAM)).spawn(2 * len(self.sensors))
        columns = []
        for k, sensor in enumerate(self.sensors.values()):
            noise, lost = (np.random.default_rng(s) for s in streams[2 * k : 2 * k + 2])
            columns += [sensor.noise.values(times, noise)] if sensor.noise is not None else []
            columns += [(lost.random(times.size) < sensor.dropout).astype(float)] if sensor.dropout else []
        return np.column_stack(columns) if columns else np.zeros((times.size, 0))

    def raw(self, plant: Plant, first: Mapping[str, float], late: Queue | None) -> Signal:
        """Signal of the raw measurements as they arrive, with their values at the start.

        Args:
            plant: the plant that is measured.
            first: value at the start of everything that a sensor may show, by name.
            late: dead time of the measurement; None: none.
        """
        names = self.measures(plant)
        name = "arrived" if late is not None else "measured"
        return vector(name, names, [unit_of(plant, n) for n in names], [first[n] for n in names])

    def blocks(
        self, plant: Plant, first: Mapping[str, float], late: Queue | None, true: Sequence[Signal]
    ) -> list[Block]:
        """Blocks from the true motion and response to the raw measurements that arrive.

        Args:
            plant: the plant that is measured.
            first: value at the start of everything that a sensor may show, by name.
            late: dead time of the measurement; None: none.
            true: signals of the true state, of the outputs where the plant has some, and of the response.
        """
        arriving = self.raw(plant, first, late)
        measured = replace(arriving, name="measured", start=())
        sensors = self._sensor_block(plant, true, measured, arriving.start_vector())
        return (
            [sensors, delay_block("see", measured, arriving, [late] * measured.size)] if late is not None else [sensors]
        )

    def rounded(self, name: str, value: Expression) -> Expression:
        """Return a measured quantity in whole quanta of its sensor; the value itself where it has none."""
        sensor = self.sensors.get(name)
        if sensor is None or sensor.quantum is None:
            return value
        quanta = sensor.quantum * ca.floor(value / sensor.quantum + 0.5)
        # The same number, but CasADi would multiply a quantum that is a constant by the weights of the estimator behind it: that
        # rounds otherwise than an open quantum does, and a last place of a sample is now and then a whole one of the next.
        return ca.copysign(ca.fabs(quanta), quanta)

    def lost(self, column: Expression) -> Expression | None:
        """Return whether a sample of this row of `drawn` is lost; None where none can be."""
        lost = [column[k] for k, name in enumerate(self._columns) if name.endswith(" lost")]
        return ca.mmax(ca.vertcat(*lost)) if lost else None

    @cached_property
    def _columns(self) -> tuple[str, ...]:
        noisy = [(n, "noise", s.noise is not None) for n, s in self.sensors.items()]
        lossy = [(n, "lost", s.dropout > 0) for n, s in self.sensors.items()]
        pairs = [p for both in zip(noisy, lossy, strict=True) for p in both]
        return tuple(f"{n} {what}" for n, what, there in pairs if there)

    def _sensor_block(self, plant: Plant, true: Sequence[Signal], measured: Signal, first: Array) -> Block:
        """Block (true motion, true response, random series) -> measured quantities."""
        every = [e for signal in true[:-1] for e in signal.elements] + list(response_names(plant))
        columns, drawn = self._columns, self.drawn
        lossy = [n for n in measured.elements if f"{n} lost" in columns]
        starts = [float(first[measured.elements.index(n)]) for n in lossy]
        memory = (Signal("sensor_last", tuple(lossy), start=tuple(starts)),) if lossy else ()

        def step(s: Signals) -> dict[str, Expression]:
            column = ca.vertcat(*(getattr(s, signal.name) for signal in true))
            seen = {n: column[every.index(n)] for n in measured.elements}
            for name, sensor in self.sensors.items():
                if sensor.noise is not None:
                    seen[name] = seen[name] + s.sensing[columns.index(f"{name} noise")]
                seen[name] = self.rounded(name, seen[name])
                if name in lossy:
                    lost = s.sensing[columns.index(f"{name} lost")] > 0.5
                    seen[name] = ca.if_else(lost, s.sensor_last[lossy.index(name)], seen[name])
            results = {"measured": ca.vertcat(*(seen[n] for n in measured.elements))}
            return {**results, "sensor_last_next": ca.vertcat(*(seen[n] for n in lossy))} if lossy else results

        return Block("sensors", Layout((*true, *drawn)), Layout((measured,)), step, Layout(memory))
