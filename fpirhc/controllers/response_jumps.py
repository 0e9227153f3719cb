"""A response that jumps by itself is doubted for one sample: a spike is gone in the next one, and a jump is still there.

    |f_k - f_(k-1)| <= 4 s_k + L / 10 000,      s_k = max(|f_(k-1) - f_(k-2)|, 2 |df/du| |u_(k-1) - u_(k-2)|, 0.98 s_(k-1))

in every controlled coordinate, with the change s that is usual of late: noise, the motion itself, and what the own command causes,
which is no surprise. A sample beyond it is passed on as NaN, so its cycle is skipped. It is believed when the next one is as near
to it as samples usually are. While samples are doubted s doubles, so that nothing is doubted for long. It begins with L / 2.

L is the largest response of the limits and df/du the largest slope, by the model along the reference. A response of which neither
is known is not doubted. A spike that is believed is therefore worth four usual changes, whatever its size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.controllers.base import fed, like
from fpirhc.controllers.gate import HELD
from fpirhc.controllers.reference_states import Scale, response_scale
from fpirhc.controllers.sensing_chain import raw_signal
from fpirhc.sensing.base import response_names
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import FINITE, Signals
from fpirhc.symbolic.functions import nan_where
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.task.problem import Problem

_USUAL, _FADES, _LEAST, _CAUSED = 4.0, 0.98, 1e-4, 2.0
JUMPS = "jumps"  # in the memory: last believed responses, last doubted ones, usual changes, last but one command, cycles so far


@dataclass(frozen=True, eq=False)
class Jumps:
    """The check of one signal.

    Args:
        problem: the task.
        signal: that holds the responses.
        places: of the responses in it that are checked.
        scale: of these responses.
    """

    problem: Problem
    signal: Signal
    places: Sequence[int]
    scale: Scale

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
    """Return the check of the responses that a step reads, of those whose scale is known; None where there are none.

    Args:
        problem: the task, with the numbers of the build.
        reads: of the step.
    """
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
