"""A problem: a plant, its nominal motion, its limits, and the length of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from fpirhc.fields.checked import Checked, fact
from fpirhc.fields.kinds import Duration, Finite
from fpirhc.horizon.cost import Cost, Horizon
from fpirhc.horizon.nominal import nominal_run
from fpirhc.plant.chain import response_names
from fpirhc.plant.integrators import USUAL, Integrator, own_steps
from fpirhc.plant.motion import with_exact_parameters
from fpirhc.plant.plant import Plant, plant_facts
from fpirhc.sensing.sensing import Sensing
from fpirhc.summary import line
from fpirhc.symbolic.layout import Signal
from fpirhc.task.checks import check_problem, settled
from fpirhc.task.dead_time import DeadTime
from fpirhc.task.disturbance import Disturbance
from fpirhc.task.exogenous import Exogenous, real_values, rows_of, signals_of
from fpirhc.task.external_plant import ExternalPlant
from fpirhc.task.limits import Limits
from fpirhc.task.reality import Reality
from fpirhc.task.reference import Reference


@dataclass(frozen=True, eq=False)
class Problem(Checked):
    """One control task.

    Args:
        plant: the system, with approximate and exact parameters.
        reference: the nominal motion of every coordinate.
        start: first value of every coordinate by name; derivatives (q1', ...) that are not named start at zero.
        period: control cycle, in the plant's unit of time, as are all times.
        duration: length of a run, which has the nearest whole number of cycles.
        limits: of inputs, states, rates and paths.
        disturbances: by name of the input, coordinate or output to which they add; a name of both a coordinate of the moving plant
            and an output is the coordinate's, and adds to its response.
        dead_time: of inputs and measurement. A controller may assume another one.
        sensing: sensors and estimator between the plant and the controller; ideal by default.
        horizon: stages over which a receding-horizon controller plans.
        cost: of such a plan.
        integrator: of the simulated plant; a map has none.
        input_before: inputs before the first cycle, by name. The first rate and the first weight of a rate are counted from them,
            and they act until the first command arrives. An input that is not named is at zero, moved into its limits.
        measure_from: time from which metrics count; the transient before it is left out.
        judged: coordinates, or outputs of a plant that has some, whose errors are logged and measured; None: the controlled ones,
            and those that the cost weighs.
        reality: what a run moves, where it is not `plant` with its exact parameters: another plant (`Reality`), or an object
            outside (`ExternalPlant`). `plant` is then the model alone.
        signals: values over time of every signal from outside that the plants declare, by name: `Known` or `Unknown`.
        name: of the problem in results; the problem of a file has the name of the file.

    Raises:
        InvalidProblem: all mistakes together.
    """

    _WRITTEN: ClassVar[str] = "fp.load_problem({}).problem"
    """How a value of a name or a file is written, with the name as {}: for who gives the name alone."""

    plant: Plant
    reference: Reference
    start: Mapping[str, Finite]
    period: Duration
    duration: Duration
    limits: Limits = field(default_factory=Limits)
    disturbances: Mapping[str, Disturbance] = field(default_factory=dict)
    dead_time: DeadTime = field(default_factory=DeadTime)
    sensing: Sensing = field(default_factory=Sensing)
    horizon: Horizon | None = None
    cost: Cost | None = None
    integrator: Integrator = USUAL
    measure_from: float = 0.0
    judged: Sequence[str] | None = None
    input_before: Mapping[str, float] = field(default_factory=dict, kw_only=True)
    reality: Reality | ExternalPlant | None = field(default=None, kw_only=True)
    signals: Mapping[str, Exogenous] = field(default_factory=dict, kw_only=True)
    name: str = field(default="", kw_only=True)

    def __post_init__(self) -> None:
        for name, value in settled(self).items():
            object.__setattr__(self, name, value)
        check_problem(self)

    def __repr__(self) -> str:
        named = (self.name,) if self.name else ()
        return line(self, *named, f"{self.cycles} cycles of {self.period:g} {self.time_unit}", *plant_facts(self.plant))

    @property
    def time_unit(self) -> str:
        """Unit of every time and rate, as the plant names it."""
        return self.plant.time_unit

    @property
    def cycles(self) -> int:
        """Number of control cycles in a run."""
        return round(self.duration / self.period)

    @fact
    def judged_names(self) -> tuple[str, ...]:
        """Coordinates whose errors are logged and measured."""
        if self.judged is not None:
            return tuple(self.judged)
        weighed = (self.cost.tracked if self.cost is not None else None) or {}
        controlled = self.plant.controlled_names
        return tuple(n for n in self.plant.followed if n in controlled or (n in weighed and self.moves.shows(n)))

    @property
    def moves(self) -> Reality | ExternalPlant:
        """What a run moves: the reality, or the model itself with its exact parameters."""
        return self.reality or self.reality_or_model

    @cached_property
    def reality_or_model(self) -> Reality:
        """What a run moves, where its equations are known; else the model itself."""
        return self.reality if isinstance(self.reality, Reality) else Reality(self.plant)

    @property
    def random(self) -> bool:
        """Whether runs of other seeds differ."""
        return bool(self.disturbances) or not self.sensing.ideal or not self.moves.simulated

    @property
    def real_plant(self) -> Plant:
        """The plant that a run moves, with its exact parameters: the reality's, or the model's own."""
        return self.reality_or_model.plant

    @cached_property
    def disturbed_outputs(self) -> Mapping[str, int]:
        """Relative orders of the disturbed outputs by name; a name of a coordinate of the moving plant is none."""
        plant, moved = self.plant, self.real_plant.coordinates
        orders = plant.equations.output_orders
        return {n: orders[n] for n in self.disturbances if n in orders and n not in moved}

    def with_exact(self, exact: np.ndarray) -> Problem:
        """Return the problem with other exact parameters of what moves, shape (np,).

        Raises:
            InvalidProblem: the plant is not invertible at the start with them, or one of them leaves its bounds.
            NotSupported: an external plant without parameters.
        """
        if self.reality is not None:
            return replace(self, reality=self.reality.with_exact(exact))
        return replace(self, plant=with_exact_parameters(self.plant, exact))

    @property
    def of_model(self) -> Problem:
        """The problem without its reality: the model's own plant moves, and disturbances of what it does not have are left out."""
        if self.reality is None:
            return self
        known = {*self.plant.inputs, *self.plant.coordinates, *self.plant.chains}
        disturbances = {name: one for name, one in self.disturbances.items() if name in known}
        signals = signals_of(self.plant, self.signals)
        return replace(self, reality=None, disturbances=disturbances, signals=signals)

    @cached_property
    def of_equations(self) -> Problem:
        """The problem as far as equations tell it: where an object outside moves, the model moves in its place."""
        return self if self.moves.simulated else replace(self, reality=None)

    @property
    def real_integrator(self) -> Integrator:
        """Integrator of the plant that a run moves."""
        return self.reality_or_model.integrator or self.integrator

    @cached_property
    def real_start(self) -> np.ndarray:
        """First state of the plant that a run moves."""
        return self.reality_or_model.start_state(self.plant, self.start_state)

    @property
    def signal_steps(self) -> int:
        """Steps of its own that a reality makes in a cycle, each with the signals of its middle; 1 without signals.

        A plant that moves as its model does has the signals of the middle of the cycle, as the model has them.
        """
        if self.reality is None or not self.moves.simulated or real_values(self.real_plant, self.signals) is None:
            return 1
        return own_steps(self.real_plant, self.real_integrator, self.period)

    @property
    def real_parameters(self) -> np.ndarray:
        """Parameters of the plant that a run moves in its first cycle: the exact ones, with the real values of signals."""
        plant, middle = self.real_plant, self.period / 2 / self.signal_steps
        return rows_of(real_values(plant, self.signals), np.array([middle]), plant.exact)[0]

    @cached_property
    def start_state(self) -> np.ndarray:
        """First state, shape (nx,)."""
        return np.array([float(self.start.get(e, 0.0)) for e in self.plant.state.elements])

    @cached_property
    def inputs_before(self) -> np.ndarray:
        """Inputs before the first cycle, shape (nu,)."""
        lower, upper = self.limits.input_bounds(self.plant)
        resting = np.clip(np.zeros(len(self.plant.inputs)), lower, upper)
        values = [self.input_before.get(name, rest) for name, rest in zip(self.plant.inputs, resting, strict=True)]
        return np.array(values, dtype=float)

    def _at_start(self, quantities: Sequence[str], *, seen: bool) -> np.ndarray:
        """Values of quantities of the model, of the plant that moves, as they are judged or measured at the start."""
        at = self.real_start, self.inputs_before, self.real_parameters, np.zeros(len(self.real_plant.names))
        return np.asarray(self.reality_or_model.function(quantities, seen=seen)(*at).full()).ravel()

    @cached_property
    def start_output(self) -> np.ndarray:
        """First value of the outputs and their derivatives, of the plant that moves; without outputs the first state, as stated."""
        outputs = self.plant.output.elements
        return self._at_start(outputs, seen=False) if self.plant.outputs else self.start_state

    @cached_property
    def first_shown(self) -> Mapping[str, float]:
        """What sensors without noise show at the start, by name; of states that what moves does not have, the model's value."""
        plant = self.plant
        motion = self.reality_or_model.shown((*plant.state.elements, *plant.output.elements))
        names = tuple(dict.fromkeys((*motion, *response_names(plant))))
        believed = dict(zip(plant.state.elements, self.start_state.tolist(), strict=True))
        return believed | dict(zip(names, self._at_start(names, seen=True).tolist(), strict=True))

    @property
    def first_output(self) -> np.ndarray:
        """What sensors without noise show of the outputs, or of the state, at the start."""
        return np.array([self.first_shown[e] for e in self.plant.output.elements])

    @property
    def given_signals(self) -> tuple[Signal, ...]:
        """What a controller is given from outside for the reference."""
        return self.reference.given(self.plant)

    @property
    def own_signals(self) -> tuple[Signal, ...]:
        """The reference's own signals, which its block writes."""
        return self.reference.own(self.plant)

    @cached_property
    def sample(self) -> tuple[Signal, ...]:
        """What a controller's step is given: the state, outputs and the response, or raw measurements, and beside them states."""
        plant, sensing, shown = self.plant, self.sensing, self.plant.motion
        if not sensing.estimates:
            return (*shown, plant.response_signal("realised"))
        late = self.dead_time.measurement_wait(self.period)
        return (*(shown[:-1] if sensing.observer is None else ()), sensing.raw(plant, self.first_shown, late))

    @property
    def sampled(self) -> tuple[str, ...]:
        """Names of the quantities of a sample, entry by entry."""
        *first, last = self.sample
        names = last.elements if self.sensing.estimates else response_names(self.plant)
        return (*(e for signal in first for e in signal.elements), *names)

    @cached_property
    def nominal_run(self) -> np.ndarray:
        """States (nx, m) of the model that follows the reference of its outputs, by cycles."""
        lower, upper = self.limits.input_bounds(self.plant)
        bounds, start = (tuple(map(float, lower)), tuple(map(float, upper))), tuple(map(float, self.start_state))
        return nominal_run(self.plant, self.reference, self.integrator, start, bounds, (self.period, self.cycles))

    @property
    def response_delay(self) -> float:
        """Cycles from a request to its estimated response, beyond the one cycle of every loop: `Paired(map, cycles=...)`.

        It is the sum of dead time and estimator, for the slowest input and coordinate.
        """
        return self.dead_time.longest / self.period + self.sensing.delay(self.plant, self.period)

    @property
    def warm_up_cycles(self) -> int:
        """Number of the first cycle whose realised response may be used; no deformation acts before it."""
        return self.sensing.warm_up_cycles(self.plant, self.dead_time.measurement / self.period)
