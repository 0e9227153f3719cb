"""Laws that every deformation keeps: about one step, and about its facts in many cycles.

The facts are compared with the map itself, which runs without a plant, with prescribed response errors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.conformance.laws import Array, Broken, Draw, keep
from fpirhc.contraction.delayed import delayed, radius
from fpirhc.deformation.base import Deformation, RequestChange, automatic, scaled_for
from fpirhc.describe import describe
from fpirhc.symbolic.layout import Layout
from fpirhc.task.dead_time import Queue

_TRIALS = 5
_SEEN = 1e-9  # a shorter step drowns in the rounding of the request
_FADES = 1e-6  # of the longest step that a smaller error causes
_WARM = 60  # cycles of history beyond those that a pairing needs
_SMALL_GAIN = 1e-3
_FAR = 1e9  # changes, an error with which a map whose steps are bounded makes its largest one
_SAME, _LEAKS = 1e-2, 0.4  # of an error's decay: rounding, and what is left where dead time makes a form leak


def check_deformation(deformation: Deformation, *, elements: Sequence[str] = ("q1", "q2"), seed: int) -> None:
    """Check every law on a deformation that iterates; Identity does not iterate.

    Laws about one pair of request and response are tried where the map's facts say that it is given one: without pairing and
    model.

    Args:
        deformation: the deformation; scales that it leaves open are those for changes of 1, the size of typical responses.
    """
    settled = scaled_for(deformation, RequestChange(1.0, sudden=True))
    keep(_Map(deformation, settled, tuple(elements)), seed)


@dataclass(frozen=True, eq=False)
class _Map:
    """A deformation as numeric functions (request, response, desired, memory) -> (request, memory)."""

    given: Deformation
    map: Deformation  # with a scale
    elements: tuple[str, ...]

    @property
    def size(self) -> int:
        return len(self.elements)

    @cached_property
    def layout(self) -> Layout:
        return self.map.memory(self.elements)

    @cached_property
    def function(self) -> ca.Function:
        arguments = request, response, desired = [ca.SX.sym(n, self.size) for n in ("request", "response", "desired")]
        memory = ca.SX.sym("memory", self.layout.size)
        deformed, after = self.map.step(request, response, desired, self.layout.split(memory))
        return ca.Function("map", [*arguments, memory], [ca.densify(deformed), ca.densify(self.layout.join(after))])

    def __call__(self, request: Array, response: Array, desired: Array) -> Array:
        return np.asarray(self.function(request, response, desired, self.layout.start())[0].full())[:, 0]

    def vector(self, draw: Draw) -> Array:
        return draw.normal(size=self.size)


def derivatives_are_finite(trial: _Map, draw: Draw) -> Broken:
    """Value, gradient and Hessian are finite at zero error, so that an optimiser can use the map."""
    request, desired = trial.vector(draw), trial.vector(draw)
    z = ca.MX.sym("z", 3 * trial.size)
    deformed = trial.function(*ca.vertsplit(z, trial.size), trial.layout.start())[0]
    gradient = ca.jacobian(deformed, z)
    parts = {"value": deformed, "gradient": gradient, "Hessian": ca.jacobian(ca.vec(gradient), z)}
    for what, expression in parts.items():
        numbers = ca.Function("f", [z], [expression])(np.concatenate([request, desired, desired])).full()
        if not np.isfinite(numbers).all():
            yield f"the {what} is not finite at response = desired; guard the 0/0 without a division in a dead branch"


def gain_can_be_set(trial: _Map, draw: Draw) -> Broken:
    """`with_effective_gain` returns the same kind of map with that gain, of either sign."""
    for gain in draw.uniform(0.1, 1.5, size=_TRIALS) * (-1) ** np.arange(_TRIALS):
        changed = trial.map.with_effective_gain(float(gain))
        got = changed.effective_gain()
        if type(changed) is not type(trial.map) or abs(got - gain) > 1e-12:
            yield f"with_effective_gain({gain:.6g}) is a {type(changed).__name__} with the effective gain {got:.6g}"


def step_is_bounded(trial: _Map, draw: Draw) -> Broken:
    """From zero a request moves by at most |secant_gain()| times the error, and without one any request stays."""
    if trial.map.form.pairs:
        return
    secant, effective = abs(trial.map.secant_gain()), abs(trial.map.effective_gain())
    if secant < effective * (1 - 1e-12):
        yield f"secant_gain() {secant:.6g} is below the effective gain {effective:.6g}"
    for size in (0.0, *np.logspace(-6, 6, 200)):
        request = np.zeros(trial.size) if size else trial.vector(draw)
        desired = trial.vector(draw) * draw.choice([0.0, 1.0, size])
        response = desired + size * trial.vector(draw)
        error = float(np.linalg.norm(response - desired))
        step = float(np.linalg.norm(trial(request, response, desired) - request))
        if not step <= secant * error * (1 + 1e-9) + 1e-12 * (size == 0):
            yield f"an error of {error:.3g} moves the request by {step:.9g}, above |secant_gain()| times it"


def only_desired_is_fixed(trial: _Map, draw: Draw) -> Broken:
    """A larger error of the same direction moves the request the same way, so no response but the desired one leaves it alone.

    A map that turns back, or that fades far out, as a wavelet does, has false fixed points: there the iteration rests although
    the plant does something else.
    """
    if trial.map.form.pairs:
        return
    sizes = np.logspace(-6, 6, 2000)
    for request in (np.zeros(trial.size), *(trial.vector(draw) for _ in range(_TRIALS))):
        desired, direction = trial.vector(draw), draw.normal(size=trial.size)
        responses = desired[:, None] + direction[:, None] / np.linalg.norm(direction) * sizes
        after = trial.function(request, responses, desired, trial.layout.start())[0].full()
        steps = np.asarray(after) - request[:, None]
        lengths = np.linalg.norm(steps, axis=0)
        seen = np.flatnonzero(lengths > _SEEN)
        if not seen.size:
            yield f"no error up to {sizes[-1]:.3g} moves the request"
            return
        begin = seen[0]
        kept = steps[:, begin] @ steps[:, begin:] / lengths[begin] > _FADES * np.maximum.accumulate(lengths[begin:])
        if not kept.all():
            yield (
                f"an error of {sizes[begin + int(np.argmin(kept))]:.3g} does not move the request the way a smaller one does, so a "
                "false fixed point is near: use a step that grows with the error or saturates"
            )


def nan_shows(trial: _Map, draw: Draw) -> Broken:
    """A response that is not a number never acts: the request is not one either, or it is the desired response."""
    if trial.map.form.pairs:
        return
    for place in range(trial.size):
        response, desired = trial.vector(draw), trial.vector(draw)
        response[place] = np.nan
        deformed = trial(trial.vector(draw), response, desired)
        if np.isfinite(deformed).all() and not np.array_equal(deformed, desired):
            yield "a response of NaN is hidden: the request is finite, and not the desired response"


def automatic_settings_are_chosen(trial: _Map, draw: Draw) -> Broken:
    """`scaled_for` leaves no automatic setting open, and one step then covers the change; it leaves given settings alone."""
    for sudden in (False, True):
        change = float(draw.uniform(2.0, 20.0))
        ready = scaled_for(trial.given, RequestChange(change, sudden))
        zero, far = np.zeros(trial.size), _FAR * change * trial.vector(draw)
        step = float(np.linalg.norm(replace(trial, map=ready)(zero, far, zero)))
        fits = step >= 0.99 * change if automatic(trial.given) else describe(ready) == describe(trial.given)
        if automatic(ready) or not fits:
            yield f"the scale for changes of {change:.3g} gives {ready}, whose largest step is {step:.3g}"


def gain_and_pairs_are_told(trial: _Map, draw: Draw) -> Broken:
    """Where the response is as late as it believes, an error shrinks by about its effective gain per pair, at small gains."""
    form, sign = trial.map.form, math.copysign(1.0, trial.map.effective_gain())
    if not (form.steady and trial.map.adapts):
        return
    small, plant = trial.map.with_effective_gain(sign * _SMALL_GAIN), sign * np.eye(form.channels or 1)
    if form.weights is not None:
        plant = plant @ np.linalg.inv(np.array(form.weights))
    left = radius(small, plant, [delayed(np.ones(1), form.late)] * len(plant))
    share = (1 - left) * (1 + form.late) / _SMALL_GAIN
    least = 1 - _SAME if form.compares == "request" else _LEAKS
    if not least <= share <= 1 + _SAME:
        yield (
            f"with the gain {_SMALL_GAIN:g} and a response {form.late:g} cycles late a pair takes {share:.3g} times the gain off "
            "an error, not about once: its gain is another one, or it compares the response with another request than it says"
        )


def compares_as_it_says(trial: _Map, draw: Draw) -> Broken:
    """A right model leaves the desired response alone, an increment passes a jump of it on, and a request without error stays."""
    form, memory, jump = trial.map.form, trial.layout.start(), np.ones(trial.size)
    if form.modelled:
        for response, desired in draw.normal(size=(_WARM, 2, 1)) * jump:
            request, memory = trial.function(response, response, desired, memory)
            missed = np.abs(request.full()[:, 0] - desired).max()
            if missed > 1e-9:
                yield f"given the model's response as the plant's, the request misses the desired one by {missed:.3g}"
    elif trial.map.adapts:
        for _ in range(_WARM + 3 * Queue(form.late).length):  # until every pair is one of this run
            memory = trial.function(0.0, 0.0, 0.0, memory)[1]
        passes = form.compares == "increment"
        request = trial.function(0.0, 0.0 if passes else jump, jump, memory)[0].full()[:, 0]
        if np.abs(request - passes * jump).max() > 1e-9:
            told = f"it compares with the {form.compares}, but after a jump of the desired response to {jump[0]:g}"
            yield f"{told} it requests {request[0]:.4g} and not {passes * jump[0]:g}"
