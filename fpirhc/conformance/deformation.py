"""Laws that every deformation keeps: about one step, and about its facts in many cycles.

The facts are compared with the map itself, which runs without a plant, with zero desired response and prescribed response errors.
An impulse of the error in one of two runs that are otherwise the same shows gain, filter and pairing of the map at that time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from fpirhc.conformance.laws import frozen_value, hold, keep
from fpirhc.contraction.delayed import delayed, radius
from fpirhc.deformation.base import Deformation, RequestChange, automatic, own_gain, scaled_for, with_inner
from fpirhc.describe import describe
from fpirhc.symbolic.layout import Layout

Array = npt.NDArray[Any]

_TRIALS = 5
_SEEN = 1e-9  # of the amplitude: a shorter step drowns in the rounding of the request
_FADES = 1e-6  # of the longest step that a smaller error causes
_WARM = 60  # cycles of history beyond those that a pairing needs
_SHOWN = 24  # cycles after an impulse
_SMALL = 1e-4  # errors, in units of the amplitude: the map is linear there
_SAME = 1e-2  # relative
_SMALL_GAIN = 1e-3
_LEAKS = 0.4  # share of an error's decay that a leak may cost


def check_deformation(
    deformation: Deformation, *, elements: Sequence[str] = ("q1", "q2"), seed: int, amplitude: float = 1.0
) -> None:
    """Check every law on a deformation that iterates; Identity does not iterate.

    Laws about one pair of request and response are tried where the map's facts say that it is given one: without pairing and
    model.

    Args:
        deformation: the deformation.
        elements: names of the coordinates.
        seed: of all draws.
        amplitude: size of typical responses in their unit. The effective gain is exact near zero request, so that laws
            about it use much smaller requests.

    Raises:
        AssertionError: the first law that does not hold, in one sentence.
        FpirhcError: the map is not complete, a Sigmoid without scale for instance.
    """
    laws = ANY if deformation.form.pairs else STEPS
    keep(deformation, _Map(deformation, deformation, tuple(elements), amplitude), laws, seed)
    settled = scaled_for(deformation, RequestChange(amplitude, sudden=True))
    keep(deformation, _Map(deformation, settled, ("q",), amplitude), FACTS, seed)


@dataclass(frozen=True, eq=False)
class _Map:
    """A deformation as numeric functions (request, response, desired, memory) -> (request, memory)."""

    deformation: Deformation
    settled: Deformation  # whose step is tried
    elements: tuple[str, ...]
    amplitude: float

    @property
    def size(self) -> int:
        return len(self.elements)

    @cached_property
    def layout(self) -> Layout:
        return self.deformation.memory(self.elements)

    @cached_property
    def function(self) -> ca.Function:
        return self._function(ca.SX)

    @cached_property
    def matrix_function(self) -> ca.Function:
        return self._function(ca.MX)

    def _function(self, kind: Any) -> ca.Function:
        arguments = request, response, desired = [kind.sym(n, self.size) for n in ("request", "response", "desired")]
        memory = kind.sym("memory", self.layout.size)
        deformed, after = self.settled.step(request, response, desired, self.layout.split(memory))
        told, size = sorted(self.layout.names), self.layout.size
        hold(sorted(after) == told, f"step remembers {sorted(after)} but memory() lays out {told}")
        shape = kind(deformed).shape
        hold(shape == (self.size, 1), f"step gives a request of shape {shape}, expected ({self.size}, 1)")
        outputs = [ca.densify(kind(deformed)), ca.densify(kind(self.layout.join(after)))]
        hold(outputs[1].numel() == size, "step remembers vectors of another size than memory() lays out")
        return ca.Function("map", [*arguments, memory], outputs)

    def __call__(self, request: Array, response: Array, desired: Array) -> Array:
        return np.asarray(self.function(request, response, desired, self.layout.start())[0].full())[:, 0]

    def vector(self, generator: np.random.Generator) -> Array:
        return self.amplitude * generator.normal(size=self.size)

    @cached_property
    def wait(self) -> int:
        """Cycles after which every pair is one of this run."""
        late = int(np.ceil(self.deformation.form.late))
        return 2 * late + 2 if late else 0

    def after(self, errors: Array) -> Array:
        """Requests after every cycle with these response errors; the first is zero."""
        request, memory, requests = 0.0, self.layout.start(), np.empty(len(errors))
        for k, error in enumerate(errors):
            request, memory = (v.full() for v in self.function(request, error, 0.0, memory))
            requests[k] = request.item()
        return requests

    @cached_property
    def impulse_response(self) -> Array:
        """Change of the requests by one error after cycles without errors, per unit of the error."""
        calm, size = np.zeros(_WARM + _SHOWN + 3 * self.wait), _SMALL * self.amplitude
        begin = _WARM + 2 * self.wait
        return np.asarray((self.after(size * (np.arange(len(calm)) == begin)) - self.after(calm))[begin:]) / size

    @property
    def linear(self) -> bool:
        """Whether it answers an error in the same way at any time."""
        return self.deformation.form.steady and self.deformation.adapts


def fixed_point_stays(trial: _Map, generator: np.random.Generator) -> None:
    """A response that is the desired one leaves the request alone, to rounding."""
    for _ in range(_TRIALS):
        request, desired = trial.vector(generator), trial.vector(generator)
        step = np.abs(trial(request, desired, desired) - request).max()
        hold(step <= 1e-12 * trial.amplitude, f"at response = desired the request moved by {step:.3g} instead of 0")


def derivatives_are_finite(trial: _Map, generator: np.random.Generator) -> None:
    """Value, gradient and Hessian are finite at zero error, in SX and in MX, so that an optimiser can use the map."""
    request, desired = trial.vector(generator), trial.vector(generator)
    for function in (trial.function, trial.matrix_function):
        z = ca.MX.sym("z", 3 * trial.size)
        deformed = function(*ca.vertsplit(z, trial.size), trial.layout.start())[0]
        gradient = ca.jacobian(deformed, z)
        parts = {"value": deformed, "gradient": gradient, "Hessian": ca.jacobian(ca.vec(gradient), z)}
        for what, expression in parts.items():
            numbers = ca.Function("f", [z], [expression])(np.concatenate([request, desired, desired])).full()
            hold(
                bool(np.isfinite(numbers).all()),
                f"the {what} is not finite at response = desired; guard the 0/0 without a division in a dead branch",
            )


def first_step_is_effective_gain(trial: _Map, generator: np.random.Generator) -> None:
    """A small response error moves the request by -effective_gain() times the error."""
    gain, zero = trial.deformation.effective_gain(), np.zeros(trial.size)
    if trial.linear and trial.layout.size:
        return  # what is remembered may spread an error over cycles; see `gain_and_pairs_are_told`
    for _ in range(_TRIALS):
        error = 1e-7 * trial.vector(generator)
        missed = np.abs(trial(zero, error, zero) + gain * error).max() / np.abs(gain * error).max()
        hold(missed <= 1e-4, f"the first-order step misses effective_gain()={gain:.6g} by the share {missed:.3g}")


def gain_can_be_set(trial: _Map, generator: np.random.Generator) -> None:
    """`with_effective_gain` returns the same kind of map with that gain, of either sign."""
    for gain in generator.uniform(0.1, 1.5, size=_TRIALS) * (-1) ** np.arange(_TRIALS):
        changed = trial.deformation.with_effective_gain(float(gain))
        hold(type(changed) is type(trial.deformation), f"with_effective_gain returned a {type(changed).__name__}")
        got = changed.effective_gain()
        hold(abs(got - gain) <= 1e-12, f"with_effective_gain({gain:.6g}) returned a map with effective gain {got:.6g}")


def secant_is_bounded(trial: _Map, generator: np.random.Generator) -> None:
    """From zero request no error, small or large, causes a larger step per unit than |secant_gain()|."""
    bound, zero = abs(trial.deformation.secant_gain()), np.zeros(trial.size)
    effective = abs(trial.deformation.effective_gain())
    hold(bound >= effective * (1 - 1e-12), f"secant_gain() {bound:.6g} is below the effective gain {effective:.6g}")
    for size in np.logspace(-6, 6, 200):
        desired = trial.vector(generator) * generator.choice([0.0, 1.0, size])
        response = desired + size * trial.vector(generator)
        error = float(np.linalg.norm(response - desired))
        secant = float(np.linalg.norm(trial(zero, response, desired))) / error
        hold(
            secant <= bound * (1 + 1e-9),
            f"an error of {error:.3g} causes a step of {secant:.6g} per unit, above |secant_gain()| = {bound:.6g}",
        )


def only_desired_is_fixed(trial: _Map, generator: np.random.Generator) -> None:
    """A larger error of the same direction moves the request the same way, so no response but the desired one leaves it alone.

    A map that turns back, or that fades far out, as a wavelet does, has false fixed points: there the iteration rests although
    the plant does something else.
    """
    sizes = trial.amplitude * np.logspace(-6, 6, 2000)
    for request in (np.zeros(trial.size), *(trial.vector(generator) for _ in range(_TRIALS))):
        desired, direction = trial.vector(generator), generator.normal(size=trial.size)
        responses = desired[:, None] + direction[:, None] / np.linalg.norm(direction) * sizes
        steps = (
            np.asarray(trial.function(request, responses, desired, trial.layout.start())[0].full()) - request[:, None]
        )
        lengths = np.linalg.norm(steps, axis=0)
        seen = np.flatnonzero(lengths > _SEEN * trial.amplitude)
        hold(seen.size > 0, f"no error up to {sizes[-1]:.3g} moves the request")
        begin = seen[0]
        kept = steps[:, begin] @ steps[:, begin:] / lengths[begin] > _FADES * np.maximum.accumulate(lengths[begin:])
        hold(
            bool(kept.all()),
            f"an error of {sizes[begin + int(np.argmin(kept))]:.3g} does not move the request the way a smaller one does, so a "
            "false fixed point is near: use a step that grows with the error or saturates",
        )


def step_is_bounded(trial: _Map, generator: np.random.Generator) -> None:
    """No error moves the request by more than largest_step()."""
    bound = trial.deformation.largest_step()
    for size in np.logspace(-3, 6, 50):
        request, desired = trial.vector(generator), trial.vector(generator)
        step = float(np.linalg.norm(trial(request, desired + size * trial.vector(generator), desired) - request))
        hold(step <= bound * (1 + 1e-9), f"the request moved by {step:.9g}, above largest_step() = {bound:.9g}")


def graphs_agree(trial: _Map, generator: np.random.Generator) -> None:
    """The map built from SX and from MX gives the same request and memory."""
    for size in np.logspace(-6, 3, 10):
        desired = trial.vector(generator)
        arguments = (trial.vector(generator), desired + size * trial.vector(generator), desired, trial.layout.start())
        one, other = (
            np.concatenate([v.full().ravel() for v in f(*arguments)]) for f in (trial.function, trial.matrix_function)
        )
        apart = float(np.abs(one - other).max())
        hold(apart <= 1e-12 * max(1.0, np.abs(one).max()), f"SX and MX graphs differ by {apart:.3g}")


def nan_shows(trial: _Map, generator: np.random.Generator) -> None:
    """A response that is not a number never acts: the request is not one either, or it is the desired response."""
    for place in range(trial.size):
        response, desired = trial.vector(generator), trial.vector(generator)
        response[place] = np.nan
        deformed = trial(trial.vector(generator), response, desired)
        shown = bool(np.isnan(deformed).any()) or np.array_equal(deformed, desired)
        hold(shown, "a response of NaN is hidden: the request is finite, and not the desired response")


# Facts, in many cycles of one coordinate


def inner_can_be_exchanged(trial: _Map, generator: np.random.Generator) -> None:  # noqa: ARG001
    """The inner map can be replaced: around its own inner map a wrapper stays the same."""
    deformation = trial.deformation
    if deformation.inner is not None:
        same = with_inner(deformation, deformation.inner)
        hold(describe(same) == describe(deformation), f"around its own inner map it is {same}")


def gain_is_proportional_to_its_field(trial: _Map, generator: np.random.Generator) -> None:
    """The gain that a user sets is proportional to the effective gain: advice in units of one is advice in the other."""
    gain, factor = trial.deformation.effective_gain(), float(generator.uniform(1.2, 1.9))
    if gain == 0:
        return
    (name, one), (_, other) = (
        own_gain(m) for m in (trial.deformation, trial.deformation.with_effective_gain(factor * gain))
    )
    told = abs(other - factor * one) <= _SAME * abs(one)
    hold(told, f"with {factor:.3g} times its effective gain its '{name}' is {other:.4g}, and was {one:.4g}")


def compares_as_it_says(trial: _Map, generator: np.random.Generator) -> None:
    """A right model leaves the desired response alone, an increment passes a jump of it on, and a request without error stays."""
    form, memory, jump = trial.deformation.form, trial.layout.start(), trial.amplitude
    for response, desired in generator.normal(size=(_WARM, 2)) * jump if form.modelled else ():
        request, memory = trial.function(response, response, desired, memory)
        missed = abs(float(request) - desired)
        hold(
            missed <= 1e-9 * jump,
            f"given the model's response as the plant's, the request misses the desired one by {missed:.3g}",
        )
    if form.modelled or not trial.deformation.adapts:
        return
    for _ in range(_WARM + trial.wait):
        memory = trial.function(0.0, 0.0, 0.0, memory)[1]
    passes = form.compares == "increment"
    request, expected = float(trial.function(0.0, 0.0 if passes else jump, jump, memory)[0]), jump if passes else 0.0
    hold(
        abs(request - expected) <= 1e-9 * jump,
        f"it compares with the {form.compares}, but after a jump of the desired response to {jump:g} it requests {request:.4g} and "
        f"not {expected:g}",
    )


def shown_is_remembered(trial: _Map, generator: np.random.Generator) -> None:  # noqa: ARG001
    """Every signal that `shown` logs is a scalar of the memory."""
    for name, source in trial.deformation.shown().items():
        scalar = source in trial.layout and trial.layout[source].size == 1
        hold(scalar, f"it shows '{source}' as '{name}', which is no scalar of its memory {list(trial.layout.names)}")


def automatic_settings_are_chosen(trial: _Map, generator: np.random.Generator) -> None:
    """`scaled_for` leaves no automatic setting open, and one step then covers the change; it leaves given settings alone."""
    given = not automatic(trial.deformation)
    for sudden in (False, True):
        change = float(generator.uniform(2.0, 20.0))
        ready = scaled_for(trial.deformation, RequestChange(change, sudden))
        hold(not automatic(ready), f"the scale for a change leaves {automatic(ready)} open")
        same, step = describe(ready) == describe(trial.deformation), ready.largest_step()
        hold(same or not given, f"no setting is automatic, but the scale for a change gives {ready}")
        covers = given or step >= 0.99 * change
        hold(covers, f"with the scale for changes of {change:.3g} its largest step is {step:.3g}")


def gain_and_pairs_are_told(trial: _Map, generator: np.random.Generator) -> None:  # noqa: ARG001
    """Where the response is as late as it believes, an error shrinks by about its effective gain per pair, at small gains."""
    deformation, gain = trial.settled, trial.deformation.effective_gain()
    if not trial.linear:
        return
    form, size = deformation.form, deformation.form.channels or 1
    late, sign = form.late, math.copysign(1.0, gain)
    small, plant = deformation.with_effective_gain(sign * _SMALL_GAIN), sign * np.eye(size)
    if form.weights is not None:
        plant = plant @ np.linalg.inv(np.array(form.weights))
    left = radius(small, plant, [delayed(np.ones(1), late)] * size)
    share = (1 - left) * (1 + late) / _SMALL_GAIN
    hold(
        _LEAKS <= share <= 1 + _SAME,
        f"with the gain {_SMALL_GAIN:g} and a response {late:g} cycles late a pair takes {share:.3g} times the gain off an error, "
        "not about once: its gain is another one, or it compares the response with another request than it says",
    )


def adaptation_is_told(trial: _Map, generator: np.random.Generator) -> None:  # noqa: ARG001
    """`adapts` is true where a response changes a request, and only there: a map that says no is compared as no adaptation."""
    changed, adapts = float(np.abs(trial.impulse_response).max()), trial.deformation.adapts
    hold(
        changed > 0 if trial.linear else adapts or changed == 0,
        f"`adapts` is {str(adapts).lower()}, but an error of the response changes the request by {changed:.3g} per unit",
    )


ANY = (frozen_value, derivatives_are_finite, gain_can_be_set, graphs_agree)
STEPS = (
    frozen_value,
    fixed_point_stays,
    derivatives_are_finite,
    first_step_is_effective_gain,
    gain_can_be_set,
    secant_is_bounded,
    only_desired_is_fixed,
    step_is_bounded,
    graphs_agree,
    nan_shows,
)
FACTS = (
    inner_can_be_exchanged,
    automatic_settings_are_chosen,
    adaptation_is_told,
    gain_and_pairs_are_told,
    gain_is_proportional_to_its_field,
    compares_as_it_says,
    shown_is_remembered,
)
LAWS = (*STEPS, *FACTS)
