"""A controller as it runs against a real plant: behind its gate, with a fingerprint in its memory, and watched.

fingerprint, clock -> gate (controller) -> watch
"""

from __future__ import annotations

import hashlib
import json
from functools import reduce

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.gate import Gate, behind_gate
from fpirhc.controllers.seeing import sensor_ranges
from fpirhc.describe import describe
from fpirhc.plant.motion import SECONDS
from fpirhc.simulation.replay import CLOCK, clock_block, clock_status_block, known_samples
from fpirhc.status import Status
from fpirhc.symbolic.block import Block, Composite, compose, fed, under_names
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.problem import Problem

FINGERPRINT = "fingerprint"  # first entry of the memory
_STATUS, _GATED = "_status_of_cycle", "_status_of_gate"


def watch_block(problem: Problem, status: str, longest: int) -> Block:
    """Return the block (command, status) -> 'status': SATURATED after more than `longest` cycles in a row at a limit."""
    plant, held = problem.plant, Signal("watch_saturated")
    lower, upper = problem.limits.input_bounds(plant)

    def step(s: Signals) -> dict[str, Expression]:
        before, count = getattr(s, status), getattr(s, held.name)
        ends = [s.command[k] <= v for k, v in enumerate(lower) if np.isfinite(v)]
        ends += [s.command[k] >= v for k, v in enumerate(upper) if np.isfinite(v)]
        longer = count + (count < longest + 0.5)  # a comparison, because fmin is a call in C
        count = ca.if_else(reduce(ca.logic_or, ends, 0.0), longer, 0)
        fine = before < int(Status.NOT_CONVERGED) + 0.5
        now = ca.if_else(ca.logic_and(fine, count > longest + 0.5), int(Status.SATURATED), before)
        return {"status": now, f"{held.name}_next": count}

    return Block("watch", Layout((scalar(status), plant.input)), Layout((scalar("status"),)), step, Layout((held,)))


def machine_step(problem: Problem, controller: Controller, inner: Composite, saturated_after: float) -> Composite:
    """Return the step (memory, sample, parameters) -> (memory, trace, command); gate and watch have the problem's numbers.

    `inner`: the controller's step.
    """
    gate = Gate(problem, inner, ranges=sensor_ranges(problem), samples=known_samples(problem))
    block = under_names(gate.block(), {"status": _GATED})
    longest = round(saturated_after / (problem.period * SECONDS.get(problem.plant.time_unit, 1.0)))
    own = fingerprint(problem, controller, block.memory)
    memory = Layout((scalar(FINGERPRINT, start=own),))
    identity = Block("identity", Layout(), Layout(), lambda _: {f"{FINGERPRINT}_next": own}, memory)
    judged = clock_status_block(problem, _GATED, _STATUS)
    watch = behind_gate(watch_block(problem, _STATUS, longest), _STATUS)
    blocks = [identity, clock_block(problem), fed(block, "time", Signal(CLOCK)), judged, watch]
    return compose("machine", gate.reads, blocks, outputs=("command",))


def fingerprint(problem: Problem, controller: Controller, memory: Layout) -> float:
    """Return a number that another controller, or the same one on another problem, does not have."""
    facts = json.dumps([describe(problem), describe(controller), memory.columns], sort_keys=True, default=str)
    return float(int.from_bytes(hashlib.sha256(facts.encode()).digest()[:6], "big") + 1)
