"""The way from the plant to the controller: sensors, their dead time, and an estimator of unmeasured quantities.

    true plant -> sensors -> measurement dead time -> estimator -> controller

Where sensing is not ideal, a run's `state` and `realised` are the estimates that the controller receives. The true signals are
`plant_state` and `plant_realised`, the sensors' output is `measured`, and `true_error` counts in the metrics. Random series are
drawn before the run, so the loop itself stays a function.

Before the run there are no samples, so the first estimates of the response are not measured ones. The deformation therefore waits
for `warm_up_cycles`, until the estimator's window holds samples of this run alone; until then the deformed response is the desired
one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.fields.checked import Checked
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import Array, DerivativeEstimator, response_names
from fpirhc.sensing.measured import Measured
from fpirhc.sensing.sensor import Sensor
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.functions import ceil
from fpirhc.symbolic.layout import Expression, Layout, Signal, vector
from fpirhc.task.dead_time import Wait, delay_block

_STREAM = 1  # separates the sensors' random series from the series of disturbances


@dataclass(frozen=True, eq=False)
class Sensing(Checked):
    """Sensors and estimator between plant and controller; ideal by default.

    Args:
        sensors: by name of the measured quantity, which is a state element ("q1", "q1'") or, where the estimator measures it, the
            highest derivative of a controlled coordinate ("q1''"). A quantity that is not named is measured perfectly.
        estimator: of state and response from the measured quantities: Measured, VelocityDifference, LowPassDifference,
            PositionDifference, SavitzkyGolay, StateVariableFilter.
    """

    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    estimator: DerivativeEstimator = field(default_factory=Measured)

    @property
    def ideal(self) -> bool:
        """Whether the controller receives the true state and response."""
        return not self.sensors and self.estimator.measures_all

    def check(self, plant: Plant) -> None:
        """Raise if a sensor's quantity is unknown or not measured, or the estimator cannot serve the plant.

        Raises:
            InvalidProblem: all mistakes together.
        """
        mistakes = Mistakes("sensing")
        measures, every = self.estimator.measures(plant), plant.state.elements + response_names(plant)
        mistakes.unknown("sensors: quantity", self.sensors, every)
        for name in self.sensors:
            if name in every and name not in measures:
                what = f"'{name}' is estimated by {type(self.estimator).__name__}, not measured"
                mistakes.add(f"sensors: {what}; sensors are those of {', '.join(measures)}")
        try:
            self.estimator.check(plant)
        except InvalidValue as error:
            mistakes.add(str(error))
        mistakes.raise_if_any()

    def delay(self, plant: Plant, period: float) -> float:
        """Delay of the estimated response in cycles beyond the ideal pair; the largest of the controlled coordinates."""
        return max(self.estimator.delay(plant.orders[k], period) for k in plant.controlled_indices)

    def warm_up_cycles(self, plant: Plant, late: float) -> float:
        """Number of the first cycle whose response may be used; samples arrive `late` cycles after they were taken."""
        if self.estimator.measures_all:
            return 1
        return ceil(late) + max(self.estimator.fills(plant.orders[k]) for k in plant.controlled_indices)

    @property
    def drawn(self) -> tuple[Signal, ...]:
        """The signal of all random series; empty where there is none."""
        columns = self._columns()
        return (Signal("sensing", columns),) if columns else ()

    def table(self, times: Array, seed: int) -> Array:
        """Noise and lost samples (1: lost) of every cycle, shape (cycles, size of `drawn`); each column has its own stream."""
        streams = np.random.SeedSequence((seed, _STREAM)).spawn(2 * len(self.sensors))
        columns = []
        for k, sensor in enumerate(self.sensors.values()):
            noise, lost = (np.random.default_rng(s) for s in streams[2 * k : 2 * k + 2])
            columns += [sensor.noise.values(times, noise)] if sensor.noise is not None else []
            columns += [(lost.random(times.size) < sensor.dropout).astype(float)] if sensor.dropout else []
        return np.column_stack(columns) if columns else np.zeros((times.size, 0))

    def blocks(
        self, plant: Plant, period: float, start: Array, late: Wait | None, true: tuple[Signal, Signal], resting: Array
    ) -> list[Block]:
        """Blocks from the true state and response to 'state' and 'realised'.

        Args:
            plant: the plant that is measured.
            period: control cycle, s.
            start: first state of the problem, shape (nx,).
            late: dead time of the measurement; None: none.
            true: signals of the true state and response.
            resting: response at the start, shape (n,).
        """
        names = self.estimator.measures(plant)
        first = _start(plant, start, names, resting)
        measured = vector("measured", names, [_unit(plant, n) for n in names])
        sensors = self._sensor_block(plant, true, measured, first)
        if late is None:
            return [sensors, self.estimator.block(plant, period, start, measured)]
        arrived = replace(measured, name="_arrived", start=tuple(map(float, first)))
        waiting = delay_block("see", measured, arrived, [late] * len(names))
        return [sensors, waiting, self.estimator.block(plant, period, start, replace(arrived, start=()))]

    def _columns(self) -> tuple[str, ...]:
        noisy = [(n, "noise", s.noise is not None) for n, s in self.sensors.items()]
        lossy = [(n, "lost", s.dropout > 0) for n, s in self.sensors.items()]
        pairs = [p for both in zip(noisy, lossy, strict=True) for p in both]
        return tuple(f"{n} {what}" for n, what, there in pairs if there)

    def _sensor_block(self, plant: Plant, true: tuple[Signal, Signal], measured: Signal, first: Array) -> Block:
        """Block (true state, true response, random series) -> measured quantities."""
        every = plant.state.elements + response_names(plant)
        columns, drawn = self._columns(), self.drawn
        lossy = [n for n in measured.elements if f"{n} lost" in columns]
        starts = [float(first[measured.elements.index(n)]) for n in lossy]
        memory = (Signal("sensor_last", tuple(lossy), start=tuple(starts)),) if lossy else ()

        def step(s: Signals) -> dict[str, Expression]:
            both = ca.vertcat(getattr(s, true[0].name), getattr(s, true[1].name))
            seen = {n: both[every.index(n)] for n in measured.elements}
            for name, sensor in self.sensors.items():
                if sensor.noise is not None:
                    seen[name] = seen[name] + s.sensing[columns.index(f"{name} noise")]
                if sensor.quantum is not None:
                    seen[name] = sensor.quantum * ca.floor(seen[name] / sensor.quantum + 0.5)
                if sensor.dropout:
                    lost = s.sensing[columns.index(f"{name} lost")] > 0.5
                    seen[name] = ca.if_else(lost, s.sensor_last[lossy.index(name)], seen[name])
            results = {"measured": ca.vertcat(*(seen[n] for n in measured.elements))}
            return {**results, "sensor_last_next": ca.vertcat(*(seen[n] for n in lossy))} if lossy else results

        return Block("sensors", Layout((*true, *drawn)), Layout((measured,)), step, Layout(memory))


def _start(plant: Plant, start: Array, names: tuple[str, ...], response: Array) -> Array:
    """The measured quantities at the start."""
    known = dict(zip(plant.state.elements + response_names(plant), np.concatenate([start, response]), strict=True))
    return np.array([known[n] for n in names])


def _unit(plant: Plant, name: str) -> str:
    if name in plant.state.elements:
        return plant.state.entry_units[plant.state.elements.index(name)]
    return plant.response_units[plant.names.index(name.rstrip("'"))]
