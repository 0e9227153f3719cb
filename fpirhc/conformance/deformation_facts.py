"""Laws about the facts of a deformation: they are compared with the map itself.

The map runs without a plant, with zero desired response and prescribed response errors, so that its memory goes through many
cycles. An impulse of the error in one of two runs that are otherwise the same shows the gain, the filter and the pairing of the
map at that time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from fpirhc.conformance.laws import hold, keep
from fpirhc.deformation.base import Deformation, RequestChange, automatic, innermost, with_inner
from fpirhc.describe import describe
from fpirhc.symbolic.layout import Layout

Array = npt.NDArray[Any]

_WARM = 60  # cycles of history beyond those that a pairing needs
_SHOWN = 24  # cycles after an impulse
_SMALL = 1e-4  # errors, in units of the amplitude: the map is linear there
_SAME = 1e-2  # relative


def check_deformation_facts(deformation: Deformation, *, seed: int, amplitude: float = 1.0) -> None:
    """Check the facts of a deformation; maps that pair with earlier requests keep these laws too."""
    keep(deformation, _Cycles(deformation, amplitude), LAWS, seed)


@dataclass(frozen=True, eq=False)
class _Cycles:
    """A deformation in many cycles of one coordinate, without a plant."""

    deformation: Deformation
    amplitude: float

    @cached_property
    def layout(self) -> Layout:
        return self.deformation.memory(("q",))

    @cached_property
    def function(self) -> ca.Function:
        """Function (request, response, desired, memory) -> (request, memory)."""
        settled = self.deformation.with_scale_for(RequestChange(self.amplitude, sudden=True))
        request, response, desired = (ca.SX.sym(name) for name in ("request", "response", "desired"))
        memory = ca.SX.sym("memory", self.layout.size)
        deformed, next_memory = settled.step(request, response, desired, self.layout.split(memory))
        return ca.Function(
            "map", [request, response, desired, memory], [deformed, ca.densify(self.layout.join(next_memory))]
        )

    @cached_property
    def wait(self) -> int:
        """Cycles after which every pair is one of this run."""
        pairing = self.deformation.iteration.pairing
        return 0 if pairing is None else int(np.ceil(pairing.cycles)) + pairing.uncertainty + 2

    def __call__(self, errors: Array) -> Array:
        """Requests after every cycle with these response errors; the first is zero."""
        request, memory, requests = 0.0, self.layout.start(), np.empty(len(errors))
        for k, error in enumerate(errors):
            request, memory = (v.full() for v in self.function(request, error, 0.0, memory))
            requests[k] = request.item()
        return requests

    def calm_memory(self) -> Array:
        """The memory after cycles without errors, in which every pair has become one of this run."""
        request, memory = ca.DM(0.0), ca.DM(self.layout.start())
        for _ in range(_WARM + 2 * self.wait):
            request, memory = self.function(request, 0.0, 0.0, memory)
        return np.asarray(memory.full())[:, 0]

    def impulse_response(self, history: Array) -> Array:
        """Change of the requests by one error after a history of errors, per unit of the error."""
        size = _SMALL * self.amplitude
        calm = np.concatenate([history, np.zeros(_SHOWN + self.wait)])
        struck = calm.copy()
        struck[len(history)] += size
        return np.asarray((self(struck) - self(calm))[len(history) :]) / size

    def history(self, signs: Array) -> Array:
        return _SMALL * self.amplitude * signs


def inner_can_be_exchanged(trial: _Cycles, generator: np.random.Generator) -> None:  # noqa: ARG001
    """The inner map can be replaced: around its own inner map a wrapper stays the same."""
    deformation = trial.deformation
    if deformation.inner is not None:
        same = with_inner(deformation, deformation.inner)
        hold(describe(same) == describe(deformation), f"around its own inner map it is {same}")


def gain_is_proportional_to_its_field(trial: _Cycles, generator: np.random.Generator) -> None:
    """The field that `gain_name` names is proportional to the effective gain: advice in units of one is advice in the other."""
    gain, factor = trial.deformation.effective_gain(), float(generator.uniform(1.2, 1.9))
    if gain == 0:
        return
    before = innermost(trial.deformation)
    after = innermost(trial.deformation.with_effective_gain(factor * gain))
    one, other = (getattr(own, own.gain_name, None) for own in (before, after))
    told = (
        isinstance(one, int | float)
        and isinstance(other, int | float)
        and abs(other - factor * one) <= _SAME * abs(one)
    )
    hold(told, f"with {factor:.3g} times its effective gain its '{before.gain_name}' is {other}, and was {one}")


def exact_model_is_left_alone(trial: _Cycles, generator: np.random.Generator) -> None:
    """With a `mirror` it is given the model's response, and where this is the plant's the request is the desired response."""
    if not trial.deformation.mirror.share:
        return
    memory = trial.layout.start()
    for response, desired in generator.normal(size=(_WARM, 2)) * trial.amplitude:
        request, memory = trial.function(response, response, desired, memory)
        missed = abs(float(request) - desired)
        hold(
            missed <= 1e-9 * trial.amplitude,
            f"given the model's response as the plant's, the request misses the desired one by {missed:.3g}",
        )


def shown_is_remembered(trial: _Cycles, generator: np.random.Generator) -> None:  # noqa: ARG001
    """Every signal that `shown` logs is a scalar of the memory."""
    for name, source in trial.deformation.shown().items():
        scalar = source in trial.layout and trial.layout[source].size == 1
        hold(scalar, f"it shows '{source}' as '{name}', which is no scalar of its memory {list(trial.layout.names)}")


def automatic_settings_are_chosen(trial: _Cycles, generator: np.random.Generator) -> None:
    """`with_scale_for` leaves no automatic setting open, and one step then covers the change; it leaves given settings alone."""
    deformation = trial.deformation
    for sudden in (False, True):
        change = float(generator.uniform(2.0, 20.0))
        ready = deformation.with_scale_for(RequestChange(change, sudden))
        hold(not automatic(ready), f"with_scale_for() leaves {automatic(ready)} open")
        if not automatic(deformation):
            hold(
                describe(ready) == describe(deformation), f"no setting is automatic, but with_scale_for() gives {ready}"
            )
        else:
            step = ready.largest_step()
            hold(step >= 0.99 * change, f"with the scale for changes of {change:.3g} its largest step is {step:.3g}")


def constant_map_keeps_its_gain(trial: _Cycles, generator: np.random.Generator) -> None:
    """A map whose `iteration` is constant responds to an error in the same way after every history of errors."""
    if not trial.deformation.iteration.constant or not trial.deformation.adapts:
        return
    cycles = _WARM + 2 * trial.wait
    alternating = (-1.0) ** np.arange(cycles)
    histories = [np.zeros(cycles), alternating, alternating * 1.05 ** np.arange(cycles), np.ones(cycles)]
    histories.append(generator.choice([-1.0, 1.0], size=cycles))
    first, *others = (trial.impulse_response(trial.history(h)) for h in histories)
    for other in others:
        missed = float(np.abs(other - first).max() / max(np.abs(first).max(), 1e-300))
        hold(
            missed <= _SAME,
            f"`constant` is true, but its response to an error changes by the share {missed:.3g} with earlier errors",
        )


def filter_and_pairing_are_told(trial: _Cycles, generator: np.random.Generator) -> None:  # noqa: ARG001
    """An error changes the request at once and permanently, unless `error_pole` spreads it or `pairing` repeats it."""
    deformation = trial.deformation
    if not deformation.iteration.constant or not deformation.adapts:
        return
    answer, gain = trial.impulse_response(np.zeros(_WARM + 2 * trial.wait)), deformation.effective_gain()
    pairing, pole = deformation.iteration.pairing, deformation.iteration.error_pole
    if pairing is None:
        expected = -gain * (1 - pole ** np.arange(1, answer.size + 1))
        facts = f"the pole {pole:g} and no pairing"
    elif pole == 0 and pairing.uncertainty == 0 and float(pairing.cycles).is_integer():
        expected = -gain * (np.arange(answer.size) % (int(pairing.cycles) + 1) == 0)
        facts = f"pairs {pairing.cycles:g} cycles apart"
    else:
        return
    missed = np.abs(answer - expected) / abs(gain)
    worst = int(np.argmax(missed))
    hold(
        bool(missed[worst] <= _SAME),
        f"its facts are {facts}, but {worst} cycles after an error of one the request has changed by {answer[worst]:.4g}, not by "
        f"{expected[worst]:.4g}",
    )


def reach_is_told(trial: _Cycles, generator: np.random.Generator) -> None:
    """The gain holds for requests a thousand times smaller than `reach`; without reach, for requests of any size."""
    deformation, reach = trial.deformation, trial.deformation.iteration.reach
    if trial.layout.size or not deformation.adapts:
        return
    gain, error = deformation.effective_gain(), _SMALL * trial.amplitude
    largest = 1e3 * trial.amplitude if reach is None else 1e-3 * reach.size
    for share in generator.uniform(-1, 1, size=5):
        request = float(share * largest)
        step = float(trial.function(request, error, 0.0, trial.layout.start())[0]) - request
        missed = abs(step + gain * error) / abs(gain * error)
        what = "its reach is None" if reach is None else f"its reach is {reach.size:.3g}"
        hold(
            missed <= _SAME,
            f"{what}, but at the request {request:.3g} the step misses the gain by the share {missed:.3g}",
        )


def adaptation_is_told(trial: _Cycles, generator: np.random.Generator) -> None:  # noqa: ARG001
    """`adapts` is true where a response changes a request, and only there: a map that says no is compared as no adaptation."""
    changed = float(np.abs(trial.impulse_response(np.zeros(_WARM + 2 * trial.wait))).max())
    adapts = trial.deformation.adapts
    hold(
        changed > 0 if adapts and trial.deformation.iteration.constant else adapts or changed == 0,
        f"`adapts` is {str(adapts).lower()}, but an error of the response changes the request by {changed:.3g} per unit",
    )


def leak_is_told(trial: _Cycles, generator: np.random.Generator) -> None:  # noqa: ARG001
    """An error changes the next request by the effective gain times 1 - `leak` times 1 - `error_pole`."""
    deformation = trial.deformation
    if not deformation.iteration.constant or not deformation.adapts:
        return
    first = float(trial.impulse_response(np.zeros(_WARM + 2 * trial.wait))[0])
    gain, leak, pole = deformation.effective_gain(), deformation.iteration.leak, deformation.iteration.error_pole
    expected = -gain * (1 - leak) * (1 - pole)
    hold(
        abs(first - expected) <= _SAME * abs(gain),
        f"its leak is {leak:g}, its error_pole {pole:g} and its gain {gain:.4g}, but an error of one changes the next request by "
        f"{first:.4g} and not by {expected:.4g}: limits of its gain would be those of another map",
    )


LAWS = (
    inner_can_be_exchanged,
    automatic_settings_are_chosen,
    adaptation_is_told,
    constant_map_keeps_its_gain,
    filter_and_pairing_are_told,
    reach_is_told,
    leak_is_told,
    gain_is_proportional_to_its_field,
    exact_model_is_left_alone,
    shown_is_remembered,
)
