"""Statuses for what is wrong but finite: a command that stays at a limit, and an iteration that does not contract.

    SATURATED         some command has been at a limit in every cycle for longer than a stated time
    NOT_CONTRACTING   the measured factor |1 - a lambda| has been above 1.05 in every cycle of a window

lambda is the slope of the response over the request, fitted to the last changes of both with exponential forgetting,

    lambda = sum w^j dr.df / sum w^j dr.dr,      w = exp(-1 / window),

and a is the effective gain of the map. Small changes have no slope: the mean square of dr must exceed (|r| / 1000)^2. The
watch changes no command. It is for maps that compare the last request with its response, without dead time or estimators.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import casadi as ca
import numpy as np

from fpirhc.controllers.contract import Controller
from fpirhc.controllers.step_outcome import was_skipped
from fpirhc.plant.plant import Plant
from fpirhc.status import Status
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.finite import every_finite
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar, vector
from fpirhc.task.problem import Problem

_DIVERGES = 1.05  # measured factor from which a cycle counts
_FLOOR = 1e-18  # square of a change that is no change, in units of the response
_KEPT = ("watch_saturated", "watch_cycles", "watch_growing", "watch_requests")  # what reaches the next cycle by itself
_SMALL = 1e-3  # change of the request, as a share of it, that has a slope


def watch_block(problem: Problem, controller: Controller, status: str, *, longest: int, window: int) -> Block:
    """Return the block (command, status, request, response) -> 'status'.

    Args:
        problem: of the controller.
        controller: resolved.
        status: name of the signal with the status so far.
        longest: cycles at a limit, beyond which the status is SATURATED.
        window: cycles of the fit, and of the factor above one.
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
    plain = (
        deformation.mirror is None and deformation.iteration.pairing is None and not deformation.iteration.error_pole
    )
    direct = not problem.answers_late and controller.response(problem) is None and controller.deforms == "response"
    return deformation.adapts and plain and direct and deformation.effective_gain() != 0


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
    enough = sums[1] > window * _SMALL**2 * ca.dot(last, last) + _FLOOR
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
