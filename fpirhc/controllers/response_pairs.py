"""The state and the command to which a measured response belongs, behind dead time and an estimator.

    f_k = response at x_{k-D} to u_{k-1-D-d},      d: dead time of input and measurement, D: delay of the estimator, in cycles

A measured state is as late as the response, by the dead time of the measurement, so it waits for the estimator's delay alone; the
command waits for all three. Fractions of a cycle are interpolated, as the dead times themselves are. A learner that is given this
pair has the same regressors as one without dead time, d + D cycles later.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from fpirhc.controllers.model_inputs import MEASURED, measured_output, measured_state
from fpirhc.symbolic.block import straightened
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.functions import ceil, larger
from fpirhc.symbolic.layout import Expression, Signal
from fpirhc.symbolic.live import nominal
from fpirhc.symbolic.queue import Queue
from fpirhc.task.dead_time import DeadTime
from fpirhc.task.problem import Problem

_STATES, _COMMANDS, _OUTPUTS = "pair_states", "pair_commands", "pair_outputs"
_NONE = 1e-9  # a fraction of a cycle below this counts as zero


@dataclass(frozen=True, eq=False)
class ResponsePairs:
    """Pairs of a learner."""

    problem: Problem  # with the plant that is measured
    dead_time: DeadTime  # that is believed
    with_outputs: bool = False  # whether the measured outputs of that instant belong to a pair
    # cycles by which the state is older; a map's response belongs to the state of the cycle before (`response_age`)
    age: int = 0

    @property
    def waiting(self) -> bool:
        """Whether a response belongs to another pair than the measured state and the last command."""
        return self._states.length > 1 or self._commands.length > 1

    @property
    def state(self) -> Signal:
        """The signal of the measured state; behind dead time a controller may act on a predicted one."""
        return measured_state(self.problem.plant) if self.waiting else self.problem.plant.state

    @property
    def seen(self) -> Signal:
        """The signal of the measured outputs; behind dead time a controller may act on predicted ones."""
        return measured_output(self.problem.plant) if self.waiting else self.problem.plant.output

    @property
    def cycles(self) -> float:
        """Number of the first cycle whose pair belongs to this run: before it, samples show the start."""
        late = self.dead_time.measurement / self.problem.period
        first = self.problem.sensing.warm_up_cycles(self.problem.plant, late)
        return larger(first, ceil(late - _NONE) + 1)

    @property
    def late(self) -> float:
        """How long before the cycle the response was realised, in units of time."""
        return self.dead_time.measurement + self._delay * self.problem.period

    @property
    def memory(self) -> tuple[Signal, ...]:
        """Past states and commands."""
        problem = self.problem
        states = self._states.memory(_STATES, problem.plant.state.elements, problem.start_state.tolist())
        commands = self._commands.memory(_COMMANDS, problem.plant.input.elements, problem.inputs_before.tolist())
        if not self.with_outputs:
            return (*states, *commands)
        outputs = self._states.memory(_OUTPUTS, problem.plant.output.elements, problem.start_output.tolist())
        return (*states, *commands, *outputs)

    @property
    def gaps(self) -> bool:
        """Whether past states or outputs wait, which a gap moves."""
        return self._states.length > 1

    def moved(self, s: Signals) -> Signals:
        """Return the signals of a cycle after a gap: past states and outputs on the line from the last ones to these."""
        if not self.gaps:
            return s
        now = {_STATES: getattr(s, self.state.name)}
        now |= {_OUTPUTS: getattr(s, self.seen.name)} if self.with_outputs else {}
        return Signals({**vars(s), **{n: straightened(getattr(s, n), value, s.gap) for n, value in now.items()}})

    def waited(self, s: Signals, newest: Expression) -> tuple[Expression, dict[str, Expression]]:
        """Return the command of the response in a cycle without a sample, and what is remembered: the last state once more."""
        command, remembered = self._commands.arrived(s, _COMMANDS, newest)
        plant = self.problem.plant
        for name, size in ((_STATES, plant.state.size), (_OUTPUTS, plant.output.size)):
            if self.gaps and (name == _STATES or self.with_outputs):
                remembered |= self._states.arrived(s, name, getattr(s, name)[:size])[1]
        return command, remembered

    def pair(self, s: Signals, newest: Expression) -> tuple[Expression, Expression, dict[str, Expression]]:
        """Return state and command of the response, and what is remembered."""
        state = getattr(s, MEASURED if self.waiting else self.problem.plant.state.name)
        state, states = self._states.arrived(s, _STATES, state)
        command, commands = self._commands.arrived(s, _COMMANDS, newest)
        return state, command, {**states, **commands}

    def output(self, s: Signals) -> tuple[Expression | None, dict[str, Expression]]:
        """Return the measured outputs of that instant, and what is remembered; None where they do not belong to a pair."""
        if not self.with_outputs:
            return None, {}
        return self._states.arrived(s, _OUTPUTS, getattr(s, self.seen.name))

    @cached_property
    def _delay(self) -> float:
        delay = self.problem.sensing.delay(self.problem.plant, self.problem.period)
        return delay if delay > _NONE else 0.0

    @property
    def _states(self) -> Queue:
        return Queue(self._delay + self.age)

    @property
    def _commands(self) -> Queue:
        cycles = self._cycles(self.dead_time)
        return Queue.up_to(cycles, max(self._cycles(nominal(self.dead_time).at_longest)))

    def _cycles(self, late: DeadTime) -> tuple[float, ...]:
        waits = (late.inputs.get(name, 0.0) + late.measurement for name in self.problem.plant.inputs)
        return tuple(wait / self.problem.period + self._delay for wait in waits)
