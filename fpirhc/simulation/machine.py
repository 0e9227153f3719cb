"""A controller as it runs against a real plant: behind its gate, with a fingerprint in its memory, and watched.

fingerprint, clock -> gate (controller) -> watch
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from functools import reduce

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.built import Built
from fpirhc.controllers.gate import Gate, was_skipped
from fpirhc.controllers.seeing import sensor_ranges
from fpirhc.describe import describe
from fpirhc.plant.motion import SECONDS
from fpirhc.simulation.replay import CLOCK, clock_block, clock_status_block, known_samples
from fpirhc.status import Status
from fpirhc.symbolic.block import Block, Composite, compose, fed, under_names
from fpirhc.symbolic.expression import FINITE, Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.problem import Problem

FINGERPRINT = "fingerprint"  # first entry of the memory
SKIPPED = "skipped"  # number of skipped cycles since the start
_STATUS, _GATED = "_status_of_cycle", "_status_of_gate"


def watch_block(problem: Problem, status: str, longest: int) -> Block:
    """Return the block (command, status) -> 'status', and the number of skipped cycles; a count that is not finite begins anew.

    The status is SATURATED after more than `longest` cycles in a row with a command at a limit.
    """
    plant, names = problem.plant, ("watch_saturated", f"{SKIPPED}_before")
    lower, upper = problem.limits.input_bounds(plant)

    def step(s: Signals) -> dict[str, Expression]:
        before, skips = getattr(s, status), was_skipped(getattr(s, status))
        held, skipped = (ca.if_else(ca.fabs(one) <= FINITE, one, 0) for one in (getattr(s, name) for name in names))
        ends = [s.command[k] <= v for k, v in enumerate(lower) if np.isfinite(v)]
        ends += [s.command[k] >= v for k, v in enumerate(upper) if np.isfinite(v)]
        longer = held + (held < longest + 0.5)  # a comparison, because fmin is a call in C
        held = ca.if_else(skips, held, ca.if_else(reduce(ca.logic_or, ends, 0.0), longer, 0))
        fine = before < int(Status.NOT_CONVERGED) + 0.5
        now = ca.if_else(ca.logic_and(fine, held > longest + 0.5), int(Status.SATURATED), before)
        later = {f"{name}_next": count for name, count in zip(names, (held, skipped + skips), strict=True)}
        return {"status": now, SKIPPED: skipped + skips, **later}

    reads, writes = (scalar(status), plant.input), (scalar("status"), scalar(SKIPPED))
    return Block("watch", Layout(reads), Layout(writes), step, Layout(tuple(map(Signal, names))))


def machine_step(problem: Problem, controller: Controller, gate: Gate, saturated_after: float) -> Composite:
    """Return the step (memory, sample, parameters) -> (memory, trace, command); `Gate.named` names its memory.

    `gate`: around the controller's step.
    """
    block = under_names(gate.block(), {"status": _GATED})
    longest = round(saturated_after / (problem.period * SECONDS.get(problem.plant.time_unit, 1.0)))
    own = fingerprint(problem, controller, block.memory)
    memory = Layout((scalar(FINGERPRINT, start=own),))
    identity = Block("identity", Layout(), Layout(), lambda _: {f"{FINGERPRINT}_next": own}, memory)
    judged = clock_status_block(problem, _GATED, _STATUS)
    blocks = [identity, clock_block(problem), fed(block, "time", Signal(CLOCK)), judged]
    return compose("machine", gate.reads, [*blocks, watch_block(problem, _STATUS, longest)], outputs=("command",))


def fingerprint(problem: Problem, controller: Controller, memory: Layout) -> float:
    """Return a number that another controller, or the same one on another problem, does not have."""
    facts = json.dumps([describe(problem), describe(controller), memory.columns], sort_keys=True, default=str)
    return float(int.from_bytes(hashlib.sha256(facts.encode()).digest()[:6], "big") + 1)


def composed_step(
    composed: Callable[[Callable[[Built], Composite]], Composite],
    problem: Problem,
    ready: Controller,
    saturated_after: float,
) -> tuple[Composite, Layout]:
    """Return the step behind its gate, and the layout of its memory.

    `composed`: what is made of the built controller; gate and watch have the numbers of the problem and of `ready`.
    """
    gates: list[Gate] = []

    def compose(built: Built) -> Composite:
        ranges, samples = sensor_ranges(problem), known_samples(problem)
        gates.append(Gate(problem, built.step, ranges=ranges, samples=samples))
        return machine_step(problem, ready, gates[-1], saturated_after)

    composite = composed(compose)
    return composite, gates[-1].named(composite.memory)
