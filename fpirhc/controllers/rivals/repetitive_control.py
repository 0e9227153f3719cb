"""Repetitive control: what made the response wrong one period ago is taken off the request of now.

Theory: docs/theory.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import casadi as ca

from fpirhc.controllers.base import invert_block, law_blocks
from fpirhc.controllers.built import Built
from fpirhc.controllers.contract import PairedAtOnce
from fpirhc.errors import InvalidProblem
from fpirhc.fields.kinds import Duration, Positive, Range
from fpirhc.members import Example
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, is_finite
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Tracking

MOST = 20_000  # cycles of a period: each is one number per coordinate in the controller's memory


@dataclass(frozen=True)
class RepetitiveControl(PairedAtOnce):
    """Inverse dynamics of a request that is learned from period to period. Dead time is not compensated.

    Args:
        tracking: the law that gives the desired response.
        repeats: the period of the task, in its unit of time; a whole number of control cycles.
        gain: gamma; below 2 over the largest plant gain per model gain.
        smoothing: b of Q, from 0 to 1/4; above 0 what only changes from cycle to cycle is forgotten.
    """

    tracking: Tracking
    repeats: Duration
    gain: Positive = 0.5
    smoothing: Annotated[float, Range("a number from 0 to 0.25", lambda v: 0 <= v <= 0.25)] = 0.0

    def cycles(self, problem: Problem) -> int:
        """Return N.

        Raises:
            InvalidProblem: the period is no whole number of cycles, fewer than three, or more than 20 000.
        """
        ratio = self.repeats / problem.period
        if not 3 <= round(ratio) <= MOST or abs(ratio - round(ratio)) > 1e-6 * ratio:
            raise InvalidProblem(
                f"RepetitiveControl(repeats={self.repeats:g}): {ratio:g} cycles of {problem.period:g} {problem.time_unit}; a "
                f"period is a whole number of them, from 3 to {MOST}"
            )
        return round(ratio)

    def check(self, problem: Problem) -> None:
        self.cycles(problem)

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        plant = built.plant
        blocks, delays = law_blocks(built, self.tracking, self._repetition_block(built), invert_block(plant))
        desired, request = plant.response_signal("_desired_last"), plant.response_signal("_deformed_last")
        return blocks, [*delays, Delay(desired, "desired"), Delay(request, "deformed")]

    def _repetition_block(self, built: Built) -> Block:
        """Block (desired, realised, last request and desired response) -> request."""
        plant, size, warm_up_cycles = built.plant, len(built.plant.controlled_names), built.warm_up
        length = self.cycles(built.problem) + 1
        places = tuple(f"{name}@{k}" for k in range(length) for name in plant.controlled_names)
        lessons = Signal("lessons", places)

        def step(s: Signals) -> dict[str, Expression]:
            running = s.warm_up > warm_up_cycles - 0.5
            lesson = s._deformed_last - s._desired_last - self.gain * (s.realised - s._desired_last)
            # The newest lesson is that of the request of the last cycle; the one for the request of now is N - 1 lessons older.
            newest = ca.if_else(ca.logic_and(running, is_finite(lesson)), lesson, s.lessons[size : 2 * size])
            queue = ca.vertcat(s.lessons[size:], newest)
            before, same, after = (queue[size * k : size * (k + 1)] for k in (0, 1, 2))
            learned = self.smoothing * (before + after) + (1 - 2 * self.smoothing) * same
            return {"_deformed_unclipped": s.desired + learned, "_deformation": learned, "lessons_next": queue}

        names = ("desired", "realised", "_deformed_last", "_desired_last")
        reads = Layout((*map(plant.response_signal, names), scalar("warm_up")))
        writes = Layout(tuple(map(plant.response_signal, ("_deformed_unclipped", "_deformation"))))
        return Block("repetition", reads, writes, step, Layout((lessons,)), opaque=True)


EXAMPLES = (
    Example(problem="mrac_pendulum", controller="repetitive control", changes={"duration": 7.0, "measure_from": 0.0}),
)
