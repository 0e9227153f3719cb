"""The way from the plant to the controller: sensors, their dead time, and an estimator of unmeasured quantities.

    true plant -> sensors -> measurement dead time -> [estimator -> controller]

Where sensing is not ideal, a run's `state` and `realised` are the estimates that the controller receives. The true signals are
`plant_state` and `plant_realised`, the sensors' output is `measured`, which reaches the estimator after the dead time as `arrived`,
and `true_error` counts in the metrics. Random series are drawn before the run, so the loop itself stays a function.

An estimator and the controller behind it are one step from raw measurements to the command (`fpirhc.controllers.seeing`): a
controller on a machine is given what its sensors show.

Before the run there are no samples, so the first estimates of the response are not measured ones. The deformation therefore waits
for `warm_up_cycles`, until the estimator's window holds samples of this run alone; until then the deformed response is the desired
one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from fpirhc.errors import FpirhcError, Mistakes
from fpirhc.fields.checked import Checked
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import Array, DerivativeEstimator, response_names
from fpirhc.sensing.belief import Belief
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
        measured: names of the quantities that sensors show; None: all that the estimator needs.
        belief: how the states that no sensor shows are known: ModelStates, KalmanFilter. See `fpirhc.sensing.belief`.
    """

    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    estimator: DerivativeEstimator = field(default_factory=Measured)
    measured: Sequence[str] | None = field(default=None, kw_only=True, metadata={"setting": "where given"})
    belief: Belief | None = field(default=None, kw_only=True, metadata={"setting": "where given"})

    @property
    def ideal(self) -> bool:
        """Whether the controller receives the true state and response."""
        return not self.sensors and not self.estimates

    @property
    def estimates(self) -> bool:
        """Whether state or response are estimated, so that a controller's step begins with raw measurements."""
        return not self.estimator.measures_all or self.measured is not None

    def measures(self, plant: Plant) -> tuple[str, ...]:
        """Names of the measured quantities: state elements, and highest derivatives of controlled coordinates."""
        if self.measured is None:
            return self.estimator.measures(plant)
        return tuple(n for n in (*plant.state.elements, *response_names(plant)) if n in self.measured)

    def known(self, plant: Plant) -> tuple[str, ...]:
        """State elements that follow from what is measured."""
        return self.estimator.known(plant, self.measures(plant))

    def believed(self, plant: Plant) -> tuple[str, ...]:
        """State elements that a controller is given from the belief."""
        return self.belief.believes(plant, self.known(plant)) if self.belief is not None else ()

    def believed_response(self, plant: Plant) -> tuple[str, ...]:
        """Quantities that the response follows from and no sensor shows."""
        return tuple(n for n in self.estimator.answers(plant) if n not in self.measures(plant))

    def check(self, plant: Plant) -> None:
        """Raise if a sensor's quantity is unknown or not measured, or the estimator cannot serve the plant.

        Raises:
            InvalidProblem: all mistakes together.
        """
        mistakes = Mistakes("sensing")
        measures, every = self.measures(plant), plant.state.elements + response_names(plant)
        mistakes.unknown("sensors: quantity", self.sensors, every)
        for name in self.sensors:
            if name in every and name not in measures:
                by = self.belief if name in self.believed(plant) else self.estimator
                what = f"'{name}' is estimated by {type(by).__name__}, not measured"
                mistakes.add(f"sensors: {what}; sensors are those of {', '.join(measures)}")
        mistakes.unknown("measured: quantity", self.measured or (), every)
        checks = (self.estimator.check, lambda _: self._check_belief(plant, mistakes))
        for check in checks:
            try:
                check(plant)
            except FpirhcError as error:
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

    def raw(self, plant: Plant, start: Array, late: Wait | None, resting: Array) -> Signal:
        """Signal of the raw measurements as they arrive, with their values at the start.

        Args:
            plant: the plant that is measured.
            start: first state of the problem, shape (nx,).
            late: dead time of the measurement; None: none.
            resting: response at the start, shape (n,).
        """
        names = self.measures(plant)
        first = _start(plant, start, names, resting)
        return vector(
            "arrived" if late is not None else "measured", names, [_unit(plant, n) for n in names], first.tolist()
        )

    def blocks(
        self, plant: Plant, start: Array, late: Wait | None, true: tuple[Signal, Signal], resting: Array
    ) -> list[Block]:
        """Blocks from the true state and response to the raw measurements that arrive.

        Args:
            plant: the plant that is measured.
            start: first state of the problem, shape (nx,).
            late: dead time of the measurement; None: none.
            true: signals of the true state and response.
            resting: response at the start, shape (n,).
        """
        arriving = self.raw(plant, start, late, resting)
        measured = replace(arriving, name="measured", start=())
        sensors = self._sensor_block(plant, true, measured, arriving.start_vector())
        return (
            [sensors, delay_block("see", measured, arriving, [late] * measured.size)] if late is not None else [sensors]
        )

    def _check_belief(self, plant: Plant, mistakes: Mistakes) -> None:
        """Add a mistake where a quantity is neither measured nor believed, or a belief stands without need."""
        names, measured = self.estimator.measures(plant), self.measures(plant)
        missing = [n for n in names if n not in measured]
        if self.measured is not None and not measured:
            mistakes.add(
                "measured: name at least one quantity; Sensing() without it measures all that the estimator needs"
            )
        elif self.belief is not None and self.measured is None:
            mistakes.add(
                f"belief: everything that {type(self.estimator).__name__} needs is measured; name what sensors show: "
                f"Sensing(measured={list(measured)!r}, ...)"
            )
        elif self.belief is None and missing:
            mistakes.add(
                f"measured: {type(self.estimator).__name__} also needs {', '.join(missing)}; measure it, or state how it is "
                "believed: Sensing(measured=..., belief=ModelStates())"
            )
        if self.belief is not None:
            self.belief.check(plant, measured)

    def _columns(self) -> tuple[str, ...]:
        noisy = [(n, "noise", s.noise is not None) for n, s in self.sensors.items()]
        lossy = [(n, "lost", s.dropout > 0) for n, s in self.sensors.items()]
        pairs = [p for both in zip(noisy, lossy, strict=True) for p in both]
        return tuple(f"{n} {what}" for n, what, there in pairs if there)

    def _sensor_block(self, plant: Plant, true: tuple[Signal, Signal], measured: Signal, first: Array) -> Block:
        """Block (true state, true response, random series) -> measured quantities."""
        every = [e for signal in true[:-1] for e in signal.elements] + list(response_names(plant.face))
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
