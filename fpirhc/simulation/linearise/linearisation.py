"""The linear loops at points of an asked loop's run: all their entries that move, in scales of their own.

Theory: docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from fpirhc.errors import NotSupported
from fpirhc.simulation.linearise.asked_loop import AWAY, AskedLoop
from fpirhc.simulation.linearise.late_loop import Late, LateLoop
from fpirhc.simulation.linearise.linear_loop import LinearCycle, LinearLoop
from fpirhc.simulation.linearise.linear_map import NOISE, POLE, places_of
from fpirhc.simulation.linearise.slopes import LARGEST, Directions, Step, Way, along, reached
from fpirhc.symbolic.layout import Kind

_SHARE = 0.01  # of their sizes, by which states and inputs are moved to find the scales of all else
_SMALLEST = 1e-5  # scale of an entry, as a share of its value


class Linearisation:
    """The derivatives of a loop's step at memories of its run; it works in one thread only."""

    def __init__(self, asked: AskedLoop) -> None:
        """Note the loop, and the places of its memory that a linear loop shakes."""
        self.asked = asked
        self._poles, self._noises = (places_of(name, asked.loop) for name in (POLE, NOISE))
        self._known: dict[bytes, list[Directions]] = {}  # of the points of `at`
        self._at_limits: dict[bytes, np.ndarray] = {}  # scales at points of commands at limits

    def at(self, memory: np.ndarray) -> LinearLoop:
        """Return the linear loop of the period that begins at a memory; entries of long delay lines are not written out."""
        return self.late_at(memory, self._lines) if self._lines else self._among([self.asked.period(memory)])[0]

    def late_at(self, memory: np.ndarray, lines: Sequence[np.ndarray]) -> LateLoop:
        """Return the linear loop at a memory without the entries of some delay lines."""
        scales, free = self._scales(memory), self._free.copy()
        way, acting = self.asked.step.way(memory, scales), []
        for number, line in enumerate(lines):
            free[line] = False
            acting += [(number, k) for k in _acting(way, line, len(memory), self.asked.step.width)]
        places = [int(lines[number][k]) for number, k in acting]
        [found] = reached([[way]], free, self._places, self.asked.step.width, None, places)
        own = ~found.basis[places].any(axis=0) if places else np.ones(found.basis.shape[1], dtype=bool)
        onto = np.vstack([found.basis[:, own].T, np.eye(len(memory))[[line[-1] for line in lines]]])
        moved, traces, (kicked, _) = found.moved[0], found.traces[0], found.kicked[0]
        waiting = np.concatenate([line[:-1] for line in lines])
        if max(np.abs(moved[waiting][:, own]).max(initial=0.0), np.abs(kicked[waiting]).max(initial=0.0)) > _FELT:
            raise NotSupported(f"more than {LARGEST} entries of its memory move, and do not only wait")
        count, more = int(own.sum()), len(lines)
        late = []
        for (number, k), place in zip(acting, places, strict=True):
            column = int(np.argmax(np.abs(found.basis[place])))
            cycles = len(lines[number]) - 1 - k
            late.append(Late(count + number, cycles, onto @ moved[:, column], traces[self.asked.arriving, column]))
        wide = ((0, 0), (0, more))
        state = np.pad(found.basis[self.asked.state][:, own] * scales[self._places][:, None], wide)
        cycle = LinearCycle(
            np.pad(onto @ moved[:, own], wide), onto @ kicked, np.pad(traces[self.asked.arriving][:, own], wide), state
        )
        placed = np.pad((found.basis[self.asked.state][:, own] / scales[self._places][:, None]).T, ((0, more), (0, 0)))
        errors = np.pad(traces[self.asked.errors][:, own], wide)
        return LateLoop((cycle,), errors, placed, self.asked.problem.period, tuple(late))

    @cached_property
    def _lines(self) -> list[np.ndarray]:
        """Places of the entries of delay lines that are too long to be written out."""
        long = [np.array(places) for places in self._alike if len(places) > LARGEST]
        return [line for line in long if self._free[line].all() and self.asked.repeats == 1]

    def noisy(self, memory: np.ndarray, correlation: np.ndarray) -> LinearLoop:
        """Return the linear loop behind the noise of the sensors, n+ = c n + w, with the commands that are sent for v.

        Args:
            correlation: c, shape (noises,); zero for white noise.
        """
        if self._noise is None:
            raise NotSupported("no sensor has noise")
        period = self.asked.period(memory)
        scales = self._scales(period[0])
        ways = [[self._noise.way(at, scales)] for at in period]
        directions = self._directions(ways, self._noise.width, None)
        plain = self._linear(directions, 0, scales, self.asked.command)
        return plain.with_noise([at.kicked[0][1][self.asked.command] for at in directions], correlation)

    @cached_property
    def _noise(self) -> Step | None:
        """The step with the random series of the sensors for w."""
        drawn = self.asked.problem.sensing.drawn
        return Step(self.asked.loop, drawn[0].name) if drawn else None

    def between(self, memory: np.ndarray, gains: tuple[float, float], *, held: bool = False) -> tuple[LinearLoop, ...]:
        """Return the linear loops of two gains of a `LinearMap` in the same coordinates.

        What `at` has found of the second gain is not sought again.

        Args:
            held: whether plans are held for ever, as far as there are cycles between them.
        """
        period = self.asked.period(memory)
        some = period[1:2] or period if held else period
        return self._among([[self.asked.with_gain(one, gain) for one in some] for gain in gains])

    def shaken(self, memory: np.ndarray, corners: Sequence[tuple[float, float]]) -> tuple[LinearLoop, ...]:
        """Return linear loops behind white noise w of the response that a map sees, one for each (gain, pole of its filter)."""
        period, periods = self.asked.period(memory), []
        for gain, pole in corners:
            moved = [self.asked.with_gain(one, gain) for one in period]
            for one in moved:
                one[self._poles] = pole
            periods.append(moved)
        return self._among(periods)

    def _among(self, periods: list[list[np.ndarray]]) -> tuple[LinearLoop, ...]:
        """The linear loops along several periods, in the same coordinates."""
        scales, names = self._scales(periods[0][0]), [b"".join(map(bytes, period)) for period in periods]
        ways = [[self.asked.step.way(at, scales) for at in together] for together in zip(*periods, strict=True)]
        directions = self._directions(ways, self.asked.step.width, self._known.get(names[-1]))
        if len(periods) == 1 and self._sizes is not None:
            self._known[names[0]] = directions
        return tuple(self._linear(directions, k, scales, self.asked.arriving) for k in range(len(periods)))

    @property
    def _places(self) -> np.ndarray:
        """Places of the plant's state."""
        return np.arange(self.asked.state.start, self.asked.state.stop)

    def _directions(self, ways: list[list[Way]], width: int, begun: list[Directions] | None) -> list[Directions]:
        if self.asked.quick:
            return [along(some, np.eye(self._free.size)[:, self._free], width) for some in ways]
        with np.errstate(invalid="ignore", over="ignore"):  # a loop that runs away is infinite on both sides
            return reached(ways, self._free, self._places, width, begun, self._noises)

    def _linear(self, directions: list[Directions], number: int, scales: np.ndarray, sent: slice) -> LinearLoop:
        """The linear loop of one of the ways of every cycle, and the commands in one place of the trace."""
        cycles, shaken, scales = [], scales[self._noises], scales[self._places]
        for at, later in zip(directions, [*directions[1:], directions[0]], strict=True):
            state, onto, kicked = at.basis[self.asked.state] * scales[:, None], later.basis.T, at.kicked[number][0]
            entry = onto @ kicked if not self._noises else onto[:, self._noises] / shaken
            cycles.append(LinearCycle(onto @ at.moved[number], entry, at.traces[number][sent], state))
        first = directions[0]
        placed = (first.basis[self.asked.state] / scales[:, None]).T
        return LinearLoop(tuple(cycles), first.traces[number][self.asked.errors], placed, self.asked.problem.period)

    @cached_property
    def _free(self) -> np.ndarray:
        """Entries that may deviate: all states that are no parameters."""
        fixed = np.array([kind != Kind.STATE for kind in self.asked.loop.memory.kinds])
        for name in ("_exact", "parameters"):
            fixed[self.asked.loop.memory.slice(name)] = True
        fixed[self.asked.gain_places] = True
        return ~fixed

    def _scales(self, memory: np.ndarray) -> np.ndarray:
        """The size by which every entry deviates where states and inputs deviate by their own sizes.

        It is that of the first point inside the limits, for at a limit a plan feeds nothing back, and most deviates by nothing.
        """
        if self._sizes is not None:
            return self._sizes
        if self.asked.inside(memory):
            self._sizes = self._deviations(memory)
            return self._sizes
        name = memory.tobytes()
        if name not in self._at_limits:
            self._at_limits[name] = self._deviations(memory)
        return self._at_limits[name]

    _sizes: np.ndarray | None = None

    def _deviations(self, memory: np.ndarray) -> np.ndarray:
        lower, upper = self.asked.problem.limits.input_bounds(self.asked.problem.plant)
        inputs = np.where(np.isfinite(upper - lower), (upper - lower) / 2, 1.0)
        moved = memory.copy()
        moved[self.asked.state] *= 1 + _SHARE
        largest = np.abs(moved - memory)
        for start, w in ((moved, 0.0), (memory, _SHARE * inputs)):
            one, other = start, memory
            for k in range(2 * self.asked.longest):
                one, other = self.asked.step(one, w if k == 0 else 0.0)[0], self.asked.step(other)[0]
                with np.errstate(invalid="ignore"):  # both may have run away
                    deviation = np.abs(one - other)
                largest = np.maximum(largest, np.where(deviation < AWAY, deviation, 0.0))
        scales = np.maximum(largest / _SHARE, _SMALLEST * np.abs(memory))
        for places in self._alike:
            scales[places] = scales[places].max()
        scales[scales == 0] = 1.0
        return scales

    @cached_property
    def _alike(self) -> list[list[int]]:
        """Places of entries that are the same quantity at other times: those of a queue, or of a plan's stages."""
        groups: dict[str, list[int]] = {}
        for k, column in enumerate(self.asked.loop.memory.columns):
            groups.setdefault(column.split("@")[0], []).append(k)
        return [places for places in groups.values() if len(places) > 1]


_FELT = 1e-7  # of a deviation


def _acting(way: Way, line: np.ndarray, size: int, inputs: int) -> list[int]:
    """Which entries of a delay line, the oldest first, do more than wait; sought by halves, because few do."""
    random = np.random.default_rng(0).standard_normal(len(line))

    def felt(some: range) -> bool:
        deviation = np.zeros((size, 1))
        deviation[line[some], 0] = random[some]
        moved, traces = way(deviation, np.zeros((inputs, 1)))
        moved[line[:-1]] -= deviation[line[1:]]
        return bool(max(np.abs(moved).max(), np.abs(traces).max()) > _FELT)

    found, sought = [], [range(len(line))]
    while sought:
        some = sought.pop()
        if felt(some):
            half = len(some) // 2
            found += [some[0]] if not half else []
            sought += [some[:half], some[half:]] if half else []
    return sorted(found)
