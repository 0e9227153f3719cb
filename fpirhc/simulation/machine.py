"""A controller as it runs against a machine: behind its gate, with a fingerprint in its memory, and watched.

fingerprint, clock -> gate (controller) -> watch -> count of skipped cycles
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca

from fpirhc.controllers.base import Controller, fed
from fpirhc.controllers.gap import across_gaps, gap_of
from fpirhc.controllers.gate import Gate
from fpirhc.controllers.live_settings import LiveSettings
from fpirhc.controllers.monitor import watch_block
from fpirhc.controllers.response_jumps import response_jumps
from fpirhc.controllers.sensing_chain import compose_seeing, given_states, raw_signal
from fpirhc.controllers.step_outcome import was_skipped
from fpirhc.describe import describe
from fpirhc.errors import NotSupported
from fpirhc.plant.chain import measured_signals
from fpirhc.sensing.base import names_of_responses
from fpirhc.simulation.clock import CLOCK, clock_block, clock_status_block
from fpirhc.symbolic.block import Block, Composite, compose
from fpirhc.symbolic.expression import FINITE, Signals, expression
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.symbolic.live import nominal
from fpirhc.task.limits import Interval
from fpirhc.task.problem import Problem

FINGERPRINT = "fingerprint"  # first entry of the memory
SKIPPED = "skipped"  # number of skipped cycles since the start
_STATUS, _GATED = "_status_of_cycle", "_status_of_gate"


@dataclass(frozen=True)
class RunMonitor:
    """How long something may be wrong before a cycle's status says so.

    Args:
        saturated_after: time at a limit, s.
        window: cycles over which the contraction is measured.
    """

    saturated_after: float = 1.0
    window: int = 50


def machine_step(problem: Problem, controller: Controller, gate: Gate, monitor: RunMonitor) -> Composite:
    """Return the step (memory, sample, parameters) -> (memory, trace, command); `Gate.named` names its memory.

    Args:
        problem: of the controller.
        controller: resolved.
        gate: around the controller's step.
        monitor: the limits of the monitor.
    """
    block = _renamed(gate.block(), "status", _GATED)
    longest = round(monitor.saturated_after / problem.period)
    watched = watch_block(problem, controller, _STATUS, longest=longest, window=monitor.window)
    own = _identity_block(fingerprint(problem, controller, block.memory))
    block, jumps = fed(block, "time", Signal(CLOCK)), response_jumps(nominal(problem), gate.reads)
    gated = [block] if jumps is None else jumps.around(block)
    judged = clock_status_block(problem, _GATED, _STATUS)
    blocks = [own, clock_block(problem), *gated, judged, watched, _count_block()]
    return compose("controller", gate.reads, blocks, outputs=("command",))


def fingerprint(problem: Problem, controller: Controller, memory: Layout) -> float:
    """Return a number that another controller, or the same one on another problem, does not have."""
    facts = json.dumps([describe(problem), describe(controller), memory.columns], sort_keys=True, default=str)
    return float(int.from_bytes(hashlib.sha256(facts.encode()).digest()[:6], "big") + 1)


def _identity_block(number: float) -> Block:
    memory = Layout((scalar(FINGERPRINT, start=number),))
    return Block("identity", Layout(), Layout(), lambda _: {f"{FINGERPRINT}_next": number}, memory)


def _count_block() -> Block:
    """Block (status) -> number of skipped cycles; a count that is not finite begins anew."""
    count = Signal(f"{SKIPPED}_before")

    def step(s: Signals) -> dict[str, Expression]:
        before = getattr(s, count.name)
        safe = ca.if_else(ca.fabs(before) <= FINITE, before, 0)
        total = safe + was_skipped(s.status)
        return {SKIPPED: total, f"{count.name}_next": total}

    return Block("count", Layout((scalar("status"),)), Layout((scalar(SKIPPED),)), step, Layout((count,)))


def _renamed(block: Block, name: str, other: str) -> Block:
    """The block with one of its written signals under another name."""
    writes = Layout(tuple(replace(s, name=other) if s.name == name else s for s in block.writes.signals))

    def step(s: Signals) -> dict[str, Expression]:
        values = dict(block.step(s))
        values[other] = values.pop(name)
        return {key: expression(value) for key, value in values.items()}

    return replace(block, writes=writes, step=step)


def composed_step(
    live: LiveSettings,
    ready: Controller,
    plausible: Mapping[str, Interval],
    max_age: float | None,
    monitor: RunMonitor,
    bridged: int,
) -> tuple[Composite, Layout]:
    """Return the step behind its gate, and the layout of its memory.

    Gate and monitor have the numbers of the build, and no live ones.
    """
    gates: list[Gate] = []

    def compose(problem: Problem, controller: Controller) -> Composite:
        gap = gap_of(live.problem, bridged)
        inner = across_gaps(compose_seeing(problem, controller))
        gates.append(Gate(live.problem, inner, plausible=plausible, max_age=max_age, gap=gap))
        return machine_step(live.problem, ready, gates[-1], monitor)

    composite = live.composed(compose) if live.paths else compose(live.problem, ready)
    return composite, gates[-1].named(composite.memory)


def measures(problem: Problem, controller: Controller) -> tuple[str, ...]:
    """Return the names of what a step is given: the state and the responses, or what the sensors show."""
    raw, plant, own = raw_signal(problem), problem.plant, controller.response(problem)
    if raw is not None:
        return (*(e for signal in given_states(problem) for e in signal.elements), *raw.elements)
    responses = plant.response_signal("realised") if own is None else own.signal
    motions = (e for signal in measured_signals(plant) for e in signal.elements)
    return (*motions, *names_of_responses(plant, responses))


def refuse_unbounded(controller: Controller) -> None:
    """Refuse a controller whose optimiser may take any time.

    Raises:
        NotSupported: its planner's optimiser says that its time has no bound.
    """
    planner = controller.planner
    why = planner.optimiser.unbounded if planner is not None else ""
    if why:
        raise NotSupported(f"{why}; Stepper(..., bounded=False) accepts it away from a machine")
