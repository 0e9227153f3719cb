"""The outputs of a map at the steps to come, which nobody can measure yet: the model brings the last measured ones forward.

A law of relative order r needs y_k, delta y_k ... delta^(r-1) y_k. The forward difference delta^j y_k contains y_{k+1} ... y_{k+j}:
they follow from the state without the command of this cycle, but they are not measured before cycle k + j. What is measured is
delta^j y_{k-j}, and the model has both at the measured states,

    delta^j y_k = y^_j(x_k) + (delta^j y_{k-j} - y^_j(x_{k-j})),      j = 1 ... r - 1.

With an exact model it is exact, so that a law may be deadbeat. With a wrong one it is the measured difference of j cycles ago and
the model's change since then; at rest the model does not count, and for short cycles the measured difference alone is left. A
model's prediction without the last measured difference would keep its error for ever.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, bridged
from fpirhc.symbolic.expression import Signals, Value
from fpirhc.symbolic.gap import GAP, straightened
from fpirhc.symbolic.layout import Expression, Layout, Signal

_MEASURED, _PAST, _COUNT = "_differences", "outputs_expected", "outputs_measured"


def with_steps_ahead(plant: Plant, estimate: Block) -> list[Block]:
    """Return the estimator, and behind it the block that brings its differences to this cycle where an order is above one.

    Args:
        plant: a map, or any other plant, whose estimator then stays alone.
        estimate: writes the signal of the outputs.
    """
    if plant.step is None or max(plant.face.orders) == 1:
        return [estimate]
    measured = replace(plant.output, name=_MEASURED)

    def step(s: Signals) -> dict[str, Value]:
        return {_MEASURED if name == plant.output.name else name: value for name, value in estimate.step(s).items()}

    writes = Layout(tuple(measured if w.name == plant.output.name else w for w in estimate.writes.signals))
    lossy = None if estimate.bridged is None else lambda: with_steps_ahead(plant, bridged(estimate))[0]
    return [replace(estimate, step=step, writes=writes, bridged=lossy), _ahead_block(plant, measured)]


def _ahead_block(plant: Plant, measured: Signal, *, lost: bool = False) -> Block:
    """Block (differences of the last cycles, state, parameters) -> outputs and their differences at this cycle.

    Over a gap the expected outputs of the last cycles are on the line from the last ones to those of now.
    """
    elements = plant.output.elements
    powers = [e.count("'") for e in elements]
    x, u, p = plant.symbols()
    no_input, calm = ca.SX.zeros(u.numel()), ca.SX.zeros(len(plant.names))
    expected_at = ca.Function("fpirhc_expected", [x, p], [plant.output_function(x, no_input, p, calm)])
    past = Signal(_PAST, tuple(f"{e}@{i}" for e, j in zip(elements, powers, strict=True) for i in range(1, j + 1)))
    counted = Signal(_COUNT)

    def step(s: Signals) -> dict[str, Expression]:
        now, arrived = expected_at(s.state, s.parameters), getattr(s, _MEASURED)
        before, count, at = getattr(s, _PAST), getattr(s, _COUNT), 0
        outputs, remembered = [], []
        for k, power in enumerate(powers):
            past_outputs = [before[at + i] for i in range(power)]
            if lost and power:
                past_outputs = ca.vertsplit(straightened(ca.vertcat(*past_outputs), now[k], s.gap))
            queue = [now[k], *past_outputs]
            at += power
            brought = now[k] + ca.if_else(count > power - 0.5, arrived[k] - queue[-1], 0)
            outputs.append(brought if power else arrived[k])
            remembered += queue[:power]
        return {
            plant.output.name: ca.vertcat(*outputs),
            f"{_PAST}_next": ca.vertcat(*remembered),
            f"{_COUNT}_next": ca.fmin(count + 1, max(powers)),
        }

    reads = Layout((measured, plant.state, plant.parameter))
    writes, memory = Layout((plant.output,)), Layout((past, counted))
    if not lost:
        lossy = lambda: _ahead_block(plant, measured, lost=True)  # noqa: E731
        return Block("steps_ahead", reads, writes, step, memory, bridged=lossy)

    def wait(s: Signals) -> dict[str, Expression]:
        before, at, again = getattr(s, _PAST), 0, list[Expression]()
        for power in powers:
            again += [before[at + max(i - 1, 0)] for i in range(power)]
            at += power
        return {f"{_PAST}_next": ca.vertcat(*again), f"{_COUNT}_next": getattr(s, _COUNT)}

    waits = Block("steps_wait", Layout(), Layout(), wait, memory)
    return Block("steps_ahead", reads + Layout((GAP,)), writes, step, memory, waits=waits)
