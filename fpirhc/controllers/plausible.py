"""The plausible range of a sample: what no working sensor shows. Theory: docs/theory-questions.md."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from fpirhc.controllers.base import fed, like
from fpirhc.controllers.gate import HELD
from fpirhc.controllers.reference_states import Scale, reference_states, response_scale
from fpirhc.controllers.sensing_chain import given_states, raw_signal
from fpirhc.errors import Mistakes
from fpirhc.plant.chain import measured_signals
from fpirhc.sensing.base import response_names
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import FINITE, Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.symbolic.live import nan_where, nominal
from fpirhc.task.limits import Interval
from fpirhc.task.problem import Problem

_MARGIN, _OVER_STATES = 10.0, 3.0
_LANDAU = 6.0  # the largest constant of all derivatives below an order of four
_DRAWN = 200  # plausible states at which the model is asked
_SAMPLES = 200  # instants at which the reference is looked at


def plausible_range(problem: Problem, own: Mapping[str, Interval] | None = None) -> dict[str, Interval]:
    """Return intervals by column of the sample: "state.q1", "state.q1'" or "realised.q1"; of a raw one "measured.q1".

    Of a plant with outputs they are those of its outputs, "output.y".

    Args:
        own: intervals by name, "q1", "q1'", or "q1''" for the response, that replace the automatic ones.
    """
    own, columns = own or {}, _columns(problem)
    _check(own, columns.values())
    known = _automatic(problem)
    # A state behind outputs may have the name of one.
    ranges = {column: own.get(name, known.get(column, known.get(name))) for column, name in columns.items()}
    return {column: interval for column, interval in ranges.items() if interval is not None}


@lru_cache(maxsize=8)  # every controller of a comparison has the same ones
def _automatic(problem: Problem) -> Mapping[str, Interval]:
    """Intervals by the name of the measured quantity; of states behind outputs by column."""
    plant, ranges = problem.plant, _behind_outputs(problem)
    responses, values = _largest_responses(problem), _values(problem)
    for name in plant.controlled_names:
        order = plant.chains[name]
        middle, reach = _about(values[name])
        limit = responses[plant.controlled_names.index(name)]
        for power in range(order + 1):
            half = _derivative(reach, limit, power, order, problem.period)
            if 0 < half < np.inf:
                centre = middle if power == 0 else 0.0
                ranges[name + "'" * power] = (centre - half, centre + half)
    return ranges


def _about(values: np.ndarray) -> tuple[float, float]:
    """Centre and half width of the range about some values; 0 where they give no scale."""
    if not values.size:
        return 0.0, 0.0
    size = max(np.ptp(values) / 2, np.abs(values).max() / 2)
    return float((values.max() + values.min()) / 2), float(_MARGIN * size)


def _derivative(reach: float, limit: float, power: int, order: int, period: float) -> float:
    """Half width of the range of a derivative: of the coordinate's range, and of the largest response or else the period."""
    in_half_a_cycle = reach * (2 / period) ** power
    if power == 0 or not np.isfinite(limit):
        return in_half_a_cycle
    share = power / order
    return min(in_half_a_cycle, limit if power == order else _LANDAU * reach ** (1 - share) * limit**share)


def _largest_responses(problem: Problem) -> tuple[float, ...]:
    """A of every controlled coordinate; infinite where an input has no limits."""
    task = nominal(problem)
    plant = task.plant
    along = _MARGIN * np.array(response_scale(problem).largest)
    lower, upper = task.limits.input_bounds(plant)
    if plant.outputs or plant.step is not None or not np.isfinite(upper - lower).all() or not np.isfinite(along).all():
        return tuple(along)
    generator = np.random.default_rng(0)
    states = _plausible_states(task, along, generator)
    corners = np.where(generator.random((lower.size, _DRAWN)) < 0.5, lower[:, None], upper[:, None])
    parameters = np.repeat(plant.approximate[:, None], _DRAWN, axis=1)
    sizes = np.abs(plant.equations.controlled_response.map(_DRAWN)(states, corners, parameters).full())
    over = _OVER_STATES * np.where(np.isfinite(sizes), sizes, 0.0).max(axis=1)
    return tuple(float(v) for v in np.maximum(along, over))


def _plausible_states(task: Problem, along: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Drawn states of the model, shape (nx, _DRAWN): controlled coordinates in their ranges, the others along the reference."""
    plant = task.plant
    states, values = reference_states(task, _DRAWN).copy(), _values(task)
    for name, limit in zip(plant.controlled_names, along, strict=True):
        order = plant.orders[plant.names.index(name)]
        middle, reach = _about(values[name])
        for power in range(order):
            at = plant.state.elements.index(name + "'" * power)
            half = _derivative(reach, limit, power, order, task.period)
            drawn = (middle if power == 0 else 0.0) + half * generator.choice([-1.0, 1.0], _DRAWN)
            low, high = plant.ranges.get(plant.state.elements[at], (-np.inf, np.inf))
            states[at] = np.clip(drawn, low, high)
    return states


def _behind_outputs(problem: Problem) -> dict[str, Interval]:
    """Intervals of the states of a plant with outputs, by column."""
    plant, ranges = problem.plant, {}
    behind = [
        one for signal in measured_signals(plant)[:-1] for one in zip(signal.elements, signal.columns, strict=True)
    ]
    along = reference_states(nominal(problem), _SAMPLES) if behind else np.zeros((0, 0))
    for k, (name, column) in enumerate(behind):
        ends = [*problem.limits.states.get(name, ()), *plant.ranges.get(name, ())]
        seen = np.array([*along[k], problem.start_state[k], *ends], dtype=float)
        middle, reach = _about(seen[np.isfinite(seen)])
        if reach > 0:
            ranges[column] = (middle - reach, middle + reach)
    return ranges


def _columns(problem: Problem) -> dict[str, str]:
    """Name of the measured quantity by column of the sample."""
    plant, raw = problem.plant, raw_signal(problem)
    signals = measured_signals(plant) if raw is None else (*given_states(problem), raw)
    columns = {c: e for signal in signals for c, e in zip(signal.columns, signal.elements, strict=True)}
    if raw is not None:
        return columns
    return columns | {f"realised.{c}": n for n, c in zip(response_names(plant), plant.controlled_names, strict=True)}


def _values(problem: Problem) -> dict[str, np.ndarray]:
    """Values of every coordinate that the problem names: reference, start, and finite limits."""
    plant, function = problem.plant, problem.reference.function(problem.plant)
    times = np.linspace(0.0, problem.duration, _SAMPLES)
    reference = np.asarray(function.map(_SAMPLES)(times[None, :])[0].full()).T
    values = {}
    for name in plant.chains:
        at = plant.output.elements.index(name)
        named = [*reference[:, at], problem.start_output[at], *problem.limits.states.get(name, ())]
        values[name] = np.array([v for v in named if np.isfinite(v)])
    return values


def _check(own: Mapping[str, Interval], names: Iterable[str]) -> None:
    mistakes = Mistakes("plausible")
    mistakes.unknown("measured quantity", own, dict.fromkeys(names))
    for name, interval in own.items():
        try:
            lower, upper = (float(v) for v in interval)
        except (TypeError, ValueError):
            mistakes.add(f"'{name}' needs two numbers (lower, upper), got {interval!r}")
            continue
        if not lower < upper:
            mistakes.add(f"'{name}' needs lower < upper, got {interval!r}")
    mistakes.raise_if_any()


_USUAL, _FADES, _LEAST, _CAUSED = 4.0, 0.98, 1e-4, 2.0
JUMPS = "jumps"  # in the memory: last believed responses, last doubted ones, usual changes, last but one command, cycles so far


@dataclass(frozen=True, eq=False)
class Jumps:
    """The check of one signal."""

    problem: Problem
    signal: Signal
    places: Sequence[int]  # of the responses in it that are checked
    scale: Scale  # of these responses

    @property
    def believed(self) -> Signal:
        """The signal with NaN in place of a sample that is doubted."""
        return like(self.signal, f"_believed_{self.signal.name}")

    @property
    def _held(self) -> Signal:
        """The last command, in the memory of the gate."""
        return like(self.problem.plant.input, HELD)

    @property
    def _inputs(self) -> tuple[str, ...]:
        return self.problem.plant.input.elements

    def around(self, gate: Block) -> list[Block]:
        """Return the blocks of a gate that is given what is believed."""
        return [self.block(), fed(gate, self.signal.name, self.believed)]

    def block(self) -> Block:
        """Block (signal, last command) -> the signal that is believed."""
        entries = [f"{what}.{k}" for what in ("last", "doubted", "usual") for k in self.places]
        starts = [0.0] * (2 * len(self.places)) + [float(v) / 2 for v in self.scale.largest]
        before = [float(v) for v in self.problem.inputs_before]
        elements = (*entries, *(f"before.{name}" for name in self._inputs), "begun", "doubts")
        memory = Layout((Signal(JUMPS, elements, start=(*starts, *before, 0.0, 0.0)),))
        return Block("jumps", Layout((self.signal, self._held)), Layout((self.believed,)), self._step, memory)

    def _step(self, s: Signals) -> dict[str, Expression]:
        size, inputs = len(self.places), len(self._inputs)
        sample, held, remembered = (getattr(s, name) for name in (self.signal.name, HELD, JUMPS))
        start = ca.DM(self.block().memory.start())
        sane = _all(ca.fabs(remembered) <= FINITE)
        ends = np.cumsum([0, size, size, size, inputs, 1, 1]).tolist()
        last, doubted, usual, before, begun, doubts = ca.vertsplit(ca.if_else(sane, remembered, start), ends)
        now = sample[list(self.places)]
        command = ca.if_else(_all(ca.fabs(held) <= FINITE), held, before)
        caused = ca.mtimes(ca.DM(self.scale.slope), ca.fabs(command - before))
        expected = ca.fmax(usual, _CAUSED * caused)
        most = _USUAL * expected + _LEAST * ca.DM(self.scale.largest)
        near = [_all(ca.fabs(now - other) <= most) for other in (last, doubted)]
        confirmed = ca.logic_and(doubts > 0.5, near[1])
        believed = ca.logic_or(begun < 0.5, ca.logic_or(near[0], confirmed))
        finite = _all(ca.fabs(sample) <= FINITE)
        change = ca.fabs(now - ca.if_else(confirmed, doubted, last))
        usual_next = ca.if_else(begun < 0.5, usual, ca.fmax(change, _FADES * expected))
        after = ca.vertcat(
            ca.if_else(believed, now, last),
            ca.if_else(believed, doubted, now),
            ca.if_else(believed, usual_next, 2 * expected),
            command,
            1,
            ca.if_else(believed, 0, 1),
        )
        return {
            self.believed.name: sample + nan_where(ca.logic_and(finite, ca.logic_not(believed))),
            f"{JUMPS}_next": ca.if_else(finite, after, ca.if_else(sane, remembered, start)),
        }


def response_jumps(problem: Problem, reads: Layout) -> Jumps | None:
    """Return the check of the responses that a step reads, of those whose scale is known; None where there are none."""
    raw, names = raw_signal(problem), response_names(problem.plant)
    signal = reads["realised"] if raw is None and "realised" in reads else raw
    if signal is None or (raw is None and signal.size != len(names)):
        return None
    seen = names if raw is None else tuple(signal.elements)
    scale = response_scale(problem)
    known = [k for k, v in enumerate(scale.largest) if np.isfinite(v) and names[k] in seen]
    if not known:
        return None
    return Jumps(problem, signal, [seen.index(names[k]) for k in known], scale.of(known))


def _all(conditions: Expression) -> Expression:
    first, *others = ca.vertsplit(conditions)
    for condition in others:
        first = ca.logic_and(first, condition)
    return first
