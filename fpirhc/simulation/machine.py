"""A controller as it runs against a machine: behind its gate, with a fingerprint in its memory, and watched.

fingerprint, clock -> gate (controller) -> watch -> count of skipped cycles
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.built import Built
from fpirhc.controllers.gate import Gate, was_skipped
from fpirhc.controllers.seeing import sensor_ranges
from fpirhc.deformation.base import of_last_pair
from fpirhc.describe import describe
from fpirhc.errors import require
from fpirhc.plant.motion import SECONDS
from fpirhc.plant.plant import Plant
from fpirhc.simulation.replay import CLOCK, clock_block, clock_status_block, known_samples
from fpirhc.status import Status
from fpirhc.symbolic.block import Block, Composite, compose, fed, under_names
from fpirhc.symbolic.driver import every_finite
from fpirhc.symbolic.expression import FINITE, Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar, vector
from fpirhc.task.problem import Problem

_DIVERGES = 1.05  # measured factor from which a cycle counts
_KEPT = ("watch_saturated", "watch_cycles", "watch_growing", "watch_requests")  # what reaches the next cycle by itself
_SMALL = 1e-3  # change of the request, as a share of it, that has a slope


def watch_block(problem: Problem, controller: Controller, status: str, *, longest: int, window: int) -> Block:
    """Return the block (command, status, request, response) -> 'status', which says what is wrong but finite.

    SATURATED is a command that has been at a limit in every cycle for longer than stated; NOT_CONTRACTING a measured factor
    |1 - a lambda| above 1.05 in every cycle of a window. a is the gain of the map, and lambda the slope of the response over the
    request: lambda = sum w^j dr.df / sum w^j dr.dr, with w = exp(-1 / window). Small changes have no slope: the mean square of dr
    must exceed (|r| / 1000)^2. The watch changes no command.

    Args:
        longest: cycles at a limit, beyond which the status is SATURATED.
    """
    plant, watched = problem.plant, _iterates(problem, controller)
    pair = (plant.response_signal("deformed"), plant.response_signal("realised")) if watched else ()
    own = _fit_memory(plant) if watched else ()
    reads = Layout((scalar(status), plant.input, *pair))
    gain = controller.deformation.effective_gain()
    lower, upper = problem.limits.input_bounds(plant)

    parts = Layout((scalar("watch_saturated"), *own))
    # One signal, because a graph copies every signal by itself.
    memory = Signal("watch", parts.columns)

    def step(s: Signals) -> dict[str, Expression]:
        before = getattr(s, status)
        usable = every_finite(s.watch)
        past = parts.split(s.watch)
        past |= {name: ca.if_else(usable, past[name], 0) for name in _KEPT if name in past}
        at_limit = _any(
            [s.command[k] <= v for k, v in enumerate(lower) if np.isfinite(v)]
            + [s.command[k] >= v for k, v in enumerate(upper) if np.isfinite(v)]
        )
        now = {"watch_saturated": ca.if_else(at_limit, _counted(past["watch_saturated"], longest + 1), 0)}
        worse = ca.if_else(now["watch_saturated"] > longest + 0.5, int(Status.SATURATED), before)
        if watched:
            now |= _fit(past, s.deformed, s.realised, gain, window)
            worse = ca.if_else(now["watch_growing"] > window - 0.5, int(Status.NOT_CONTRACTING), worse)
        fine = before < int(Status.NOT_CONVERGED) + 0.5
        counts = ca.logic_not(was_skipped(before))  # a skipped cycle is no evidence
        stays = ca.logic_and(ca.logic_not(counts), usable)
        # The two are never both other than zero, and NaN in the one that is dropped does no harm.
        remembered = ca.if_else(counts, parts.join(now), 0) + ca.if_else(stays, s.watch, 0)
        return {"status": ca.if_else(fine, worse, before), "watch_next": remembered}

    return Block("watch", reads, Layout((scalar("status"),)), step, Layout((memory,)))


def _iterates(problem: Problem, controller: Controller) -> bool:
    """Whether the map compares the last request with its response, undelayed."""
    deformation = controller.deformation
    direct = not problem.response_delay and controller.deforms == "response"
    return deformation.adapts and of_last_pair(deformation) and direct and deformation.effective_gain() != 0


def _fit_memory(plant: Plant) -> tuple[Signal, ...]:
    names = plant.controlled_names
    requests = vector("watch_requests", [f"{n}@{k}" for k in (1, 2) for n in names])
    return (
        requests,
        vector("watch_response", names),
        vector("watch_sums", ("fr", "rr")),
        *map(scalar, ("watch_cycles", "watch_growing")),
    )


def _fit(
    past: Mapping[str, Expression], request: Expression, response: Expression, gain: float, window: int
) -> dict[str, Expression]:
    """The memory of the fit one cycle later."""
    size, forget = request.numel(), math.exp(-1 / window)
    last, older = past["watch_requests"][:size], past["watch_requests"][size:]
    change, answer = last - older, response - past["watch_response"]
    # Before three cycles have been counted there is no pair of changes, and what is remembered of them may be anything.
    summed = forget * past["watch_sums"] + ca.vertcat(ca.dot(change, answer), ca.dot(change, change))
    sums = ca.if_else(past["watch_cycles"] > 2.5, summed, 0)
    enough = sums[1] > window * _SMALL**2 * ca.dot(last, last)
    grows = ca.fabs(sums[1] - gain * sums[0]) > _DIVERGES * sums[1]
    growing = ca.if_else(ca.logic_and(enough, grows), _counted(past["watch_growing"], window), 0)
    return {
        "watch_requests": ca.vertcat(request, last),
        "watch_response": response,
        "watch_sums": sums,
        "watch_cycles": _counted(past["watch_cycles"], 3),
        "watch_growing": growing,
    }


def _counted(count: Expression, most: int) -> Expression:
    """One more, up to `most`; a comparison, because fmin is a call in C."""
    return count + (count < most - 0.5)


def _any(conditions: list[Expression]) -> Expression | float:
    result: Expression | float = 0.0
    for condition in conditions:
        result = ca.logic_or(result, condition)
    return result


FINGERPRINT = "fingerprint"  # first entry of the memory
SKIPPED = "skipped"  # number of skipped cycles since the start
_STATUS, _GATED = "_status_of_cycle", "_status_of_gate"


@dataclass(frozen=True)
class RunMonitor:
    """How long something may be wrong before a cycle's status says so.

    Args:
        saturated_after: time at a limit: s; in the plant's own unit where its time has no seconds, as of a map that counts weeks.
        window: cycles over which the contraction is measured.
    """

    saturated_after: float = 1.0
    window: int = 50


def machine_step(problem: Problem, controller: Controller, gate: Gate, monitor: RunMonitor) -> Composite:
    """Return the step (memory, sample, parameters) -> (memory, trace, command); `Gate.named` names its memory.

    `gate`: around the controller's step.
    """
    block = under_names(gate.block(), {"status": _GATED})
    longest = round(monitor.saturated_after / (problem.period * SECONDS.get(problem.plant.time_unit, 1.0)))
    watched = watch_block(problem, controller, _STATUS, longest=longest, window=monitor.window)
    own = fingerprint(problem, controller, block.memory)
    memory = Layout((scalar(FINGERPRINT, start=own),))
    identity = Block("identity", Layout(), Layout(), lambda _: {f"{FINGERPRINT}_next": own}, memory)
    judged = clock_status_block(problem, _GATED, _STATUS)
    blocks = [identity, clock_block(problem), fed(block, "time", Signal(CLOCK)), judged, watched, _count_block()]
    return compose("machine", gate.reads, blocks, outputs=("command",))


def fingerprint(problem: Problem, controller: Controller, memory: Layout) -> float:
    """Return a number that another controller, or the same one on another problem, does not have."""
    facts = json.dumps([describe(problem), describe(controller), memory.columns], sort_keys=True, default=str)
    return float(int.from_bytes(hashlib.sha256(facts.encode()).digest()[:6], "big") + 1)


def _count_block() -> Block:
    """Block (status) -> number of skipped cycles; a count that is not finite begins anew."""
    count = Signal(f"{SKIPPED}_before")

    def step(s: Signals) -> dict[str, Expression]:
        before = getattr(s, count.name)
        safe = ca.if_else(ca.fabs(before) <= FINITE, before, 0)
        total = safe + was_skipped(s.status)
        return {SKIPPED: total, f"{count.name}_next": total}

    return Block("count", Layout((scalar("status"),)), Layout((scalar(SKIPPED),)), step, Layout((count,)))


def composed_step(
    composed: Callable[[Callable[[Built], Composite]], Composite],
    problem: Problem,
    ready: Controller,
    monitor: RunMonitor,
) -> tuple[Composite, Layout]:
    """Return the step behind its gate, and the layout of its memory.

    `composed`: what is made of the built controller; gate and monitor have the numbers of the problem and of `ready`.
    """
    gates: list[Gate] = []

    def compose(built: Built) -> Composite:
        ranges, samples = sensor_ranges(problem), known_samples(problem)
        gates.append(Gate(problem, built.step, ranges=ranges, samples=samples))
        return machine_step(problem, ready, gates[-1], monitor)

    composite = composed(compose)
    return composite, gates[-1].named(composite.memory)


def refuse_unbounded(controller: Controller) -> None:
    """Refuse a controller whose optimiser may take any time."""
    planner = controller.planner
    why = planner.optimiser.unbounded if planner is not None else ""
    require(not why, f"{why}; Stepper(..., bounded=False) accepts it away from a machine")
