"""Why a smaller error is no success: the plant left alone does better, the reference is not followed, or plans and limits decide.

Sentences of this module stand before a positive verdict, which is then doubtful.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from fpirhc.errors import FpirhcError
from fpirhc.plant.motion import with_space
from fpirhc.simulation.held_input import HeldInput
from fpirhc.simulation.metrics.entries.errors import rms_error
from fpirhc.simulation.simulate import judged_run, simulator
from fpirhc.studies.comparison.causes import chatter_cause, limit_cause, plan_cause, stuck_cause
from fpirhc.studies.comparison.changes import quarter_turns, ranges, scales
from fpirhc.task.problem import Problem

if TYPE_CHECKING:
    from fpirhc.studies.comparison.entry import Entry


@dataclass(frozen=True)
class Yardstick:
    """What errors are measured against, by judged coordinate.

    Args:
        scales: by which errors are judged, see `fpirhc.studies.comparison.changes`; 1 where not named.
        ranges: of the references that move, the start included; of one that moves from the start alone at least what the plant
            left alone has for an error, because disturbances and not the reference move it.
        turns: a quarter turn for angles whose references do not move.
        alone: rms error of the plant left alone; empty where it is not known.
    """

    scales: Mapping[str, float] = field(default_factory=dict)
    ranges: Mapping[str, float] = field(default_factory=dict)
    turns: Mapping[str, float] = field(default_factory=dict)
    alone: Mapping[str, float] = field(default_factory=dict)

    def beyond(self, entry: Entry, name: str) -> str:
        """What the rms error of a coordinate exceeds, in words: the range of its reference, or a quarter turn; else nothing."""
        error = entry.metrics.rms_error[name]
        if error > self.ranges.get(name, math.inf):
            return f"more than {self._range(name)}, {self.ranges[name]:.3g}{_unit(entry, name)}"
        if error > self.turns.get(name, math.inf):
            return f"more than a quarter turn, {self.turns[name]:.3g}{_unit(entry, name)}"
        return ""

    def _range(self, name: str) -> str:
        alone = self.alone.get(name) == self.ranges[name]
        return "the plant left alone" if alone else "the range of its reference"


def yardstick_of(problem: Problem, *, seed: int) -> Yardstick:
    """Return what errors of a problem are measured against; the seed is that of disturbances and noise of the plant left alone."""
    moving, alone = ranges(problem), error_left_alone(problem, seed=seed)
    held = {
        name: max(size, alone.get(name, 0.0))
        for name, size in moving.items()
        if name not in ranges(problem, start=False)
    }
    return Yardstick(scales(problem), {**moving, **held}, quarter_turns(problem), alone)


def error_left_alone(problem: Problem, *, seed: int) -> Mapping[str, float]:
    """Return the rms error of every judged coordinate under the input before the run; empty where that is not known.

    It is not known for a plant outside, which is not run for the sake of a comparison, and where the run ends early. The run has
    the start, disturbances and noise of the comparison. It is made in the virtual machine: it is shorter than a compilation.

    Args:
        problem: of the comparison.
        seed: of disturbances and noise.
    """
    try:
        problem.require_equations("a plant outside is not run for the sake of a comparison")
        run = judged_run(simulator(problem, HeldInput(), compiled=False), seed=seed)
    except FpirhcError:
        return {}
    return {} if run.stop is not None else rms_error(problem, run)


def not_followed(plain: Entry, adaptive: Entry, names: list[str], yardstick: Yardstick) -> str:
    """Return a sentence where neither controller stays near a reference; else nothing."""
    lost = [n for n in names if yardstick.beyond(plain, n) and yardstick.beyond(adaptive, n)]
    if not lost:
        return ""
    texts = "; ".join(
        f"the rms error of {n} is {plain.metrics.rms_error[n]:.3g} and {adaptive.metrics.rms_error[n]:.3g}{_unit(adaptive, n)}, "
        f"{yardstick.beyond(adaptive, n)}"
        for n in lost
    )
    return f"Neither {plain.name} nor {adaptive.name} follows the reference: {texts}."


def leaves_reference(entry: Entry, yardstick: Yardstick) -> str:
    """Return a sentence where a run that finished leaves the neighbourhood of its reference; else nothing."""
    errors = entry.metrics.rms_error if entry.run.stop is None else {}
    lost = [n for n in errors if yardstick.beyond(entry, n)]
    texts = "; ".join(f"rms error of {n} {errors[n]:.3g}{_unit(entry, n)}, {yardstick.beyond(entry, n)}" for n in lost)
    return (
        f"{entry.name} leaves the neighbourhood of its reference, for which its gains and its review are made: {texts}."
        if lost
        else ""
    )


def caveats(plain: Entry, adaptive: Entry, names: list[str], yardstick: Yardstick) -> str:
    """Return the reasons not to trust a smaller error, each a sentence; empty where there is none."""
    sentences = (
        left_alone_is_better(plain, adaptive, names, yardstick),
        plan_cause(plain, adaptive),
        stuck_cause(adaptive),
        limit_cause(plain, adaptive),
        chatter_cause(plain, adaptive),
    )
    return " ".join(sentence for sentence in sentences if sentence)


def left_alone_is_better(plain: Entry, adaptive: Entry, names: list[str], yardstick: Yardstick) -> str:
    """Return a sentence where the adaptive controller does worse than the plant left alone, in every judged coordinate."""
    alone = {n: yardstick.alone[n] for n in names if n in yardstick.alone}
    if not alone or not all(adaptive.metrics.rms_error[n] > value for n, value in alone.items()):
        return ""
    both = all(plain.metrics.rms_error[n] > value for n, value in alone.items())
    who = f"{plain.name} and {adaptive.name} do" if both else f"{adaptive.name} does"
    errors = ", ".join(f"{value:.3g}{_unit(adaptive, n)} in {n}" for n, value in alone.items())
    return f"{who} worse than the plant left alone, whose input stays as it was before the run: rms error {errors}."


def _unit(entry: Entry, name: str) -> str:
    return with_space(entry.run.unit(f"error.{name}"))
