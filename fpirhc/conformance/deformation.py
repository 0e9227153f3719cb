"""Laws that every deformation keeps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from fpirhc.conformance.deformation_facts import check_deformation_facts
from fpirhc.conformance.laws import hold, is_a_frozen_value, keep
from fpirhc.deformation.base import Deformation, of_last_pair
from fpirhc.symbolic.layout import Layout

Array = npt.NDArray[Any]

_TRIALS = 5


def check_deformation(
    deformation: Deformation, *, elements: Sequence[str] = ("q1", "q2"), seed: int, amplitude: float = 1.0
) -> None:
    """Check every law on a deformation that iterates; Identity does not iterate.

    Laws about one pair of request and response are tried where the map's facts say that it is given one: without filter,
    pairing and mirror.

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
    laws = LAWS if of_last_pair(deformation) else ANY
    keep(deformation, _Trial(deformation, tuple(elements), amplitude), laws, seed)
    check_deformation_facts(deformation, seed=seed, amplitude=amplitude)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A deformation as numeric functions of (request, response, desired, memory)."""

    deformation: Deformation
    elements: tuple[str, ...]
    amplitude: float

    @property
    def size(self) -> int:
        return len(self.elements)

    @cached_property
    def layout(self) -> Layout:
        return self.deformation.memory(self.elements)

    @cached_property
    def scalar_function(self) -> ca.Function:
        return self._function(ca.SX)

    @cached_property
    def matrix_function(self) -> ca.Function:
        return self._function(ca.MX)

    def _function(self, kind: Any) -> ca.Function:
        request, response, desired = (kind.sym(name, self.size) for name in ("request", "response", "desired"))
        memory = kind.sym("memory", self.layout.size)
        deformed, next_memory = self.deformation.step(request, response, desired, self.layout.split(memory))
        hold(
            set(next_memory) == set(self.layout.names),
            f"step remembers {sorted(next_memory)} but memory() lays out {sorted(self.layout.names)}",
        )
        column = kind(deformed)
        hold(column.shape == (self.size, 1), f"step gives a request of shape {column.shape}, expected ({self.size}, 1)")
        outputs = [ca.densify(column), ca.densify(kind(self.layout.join(next_memory)))]
        hold(outputs[1].numel() == self.layout.size, "step remembers vectors of another size than memory() lays out")
        return ca.Function("map", [request, response, desired, memory], outputs)

    def __call__(self, request: Array, response: Array, desired: Array) -> Array:
        return np.asarray(self.scalar_function(request, response, desired, self.layout.start())[0].full())[:, 0]

    def vector(self, generator: np.random.Generator) -> Array:
        return self.amplitude * generator.normal(size=self.size)


def frozen_value(trial: _Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """A deformation is a frozen value that can be hashed, copied and described."""
    is_a_frozen_value(trial.deformation)


def fixed_point_stays(trial: _Trial, generator: np.random.Generator) -> None:
    """A response that is the desired one leaves the request alone, to rounding."""
    for _ in range(_TRIALS):
        request, desired = trial.vector(generator), trial.vector(generator)
        step = np.abs(trial(request, desired, desired) - request).max()
        hold(step <= 1e-12 * trial.amplitude, f"at response = desired the request moved by {step:.3g} instead of 0")


def derivatives_are_finite(trial: _Trial, generator: np.random.Generator) -> None:
    """Value, gradient and Hessian are finite at zero error, in SX and in MX, so that an optimiser can use the map."""
    request, desired = trial.vector(generator), trial.vector(generator)
    for function in (trial.scalar_function, trial.matrix_function):
        symbols = ca.MX.sym("z", 3 * trial.size)
        parts = ca.vertsplit(symbols, trial.size)
        deformed = function(*parts, trial.layout.start())[0]
        gradient = ca.jacobian(deformed, symbols)
        hessian = ca.jacobian(ca.vec(gradient), symbols)
        for what, expression in (("value", deformed), ("gradient", gradient), ("Hessian", hessian)):
            evaluated = ca.Function("f", [symbols], [expression])(np.concatenate([request, desired, desired]))
            hold(
                bool(np.isfinite(evaluated.full()).all()),
                f"the {what} is not finite at response = desired; guard the 0/0 without a division in a dead branch",
            )


def first_step_is_effective_gain(trial: _Trial, generator: np.random.Generator) -> None:
    """A small response error moves the request by -effective_gain() times the error."""
    gain, zero = trial.deformation.effective_gain(), np.zeros(trial.size)
    for _ in range(_TRIALS):
        error = 1e-7 * trial.vector(generator)
        missed = np.abs(trial(zero, error, zero) + gain * error).max() / np.abs(gain * error).max()
        hold(missed <= 1e-4, f"the first-order step misses effective_gain()={gain:.6g} by the share {missed:.3g}")


def gain_can_be_set(trial: _Trial, generator: np.random.Generator) -> None:
    """`with_effective_gain` returns the same kind of map with that gain, of either sign."""
    for gain in generator.uniform(0.1, 1.5, size=_TRIALS) * (-1) ** np.arange(_TRIALS):
        changed = trial.deformation.with_effective_gain(float(gain))
        hold(type(changed) is type(trial.deformation), f"with_effective_gain returned a {type(changed).__name__}")
        got = changed.effective_gain()
        hold(abs(got - gain) <= 1e-12, f"with_effective_gain({gain:.6g}) returned a map with effective gain {got:.6g}")


def contraction_is_predicted(trial: _Trial, generator: np.random.Generator) -> None:
    """On linear plants with J similar to a positive definite matrix the error shrinks by max|1 - a lambda|."""
    for _ in range(_TRIALS):
        mass, model = (_positive_definite(generator, trial.size) for _ in range(2))
        plant = np.linalg.solve(mass, model)
        eigenvalues = np.linalg.eigvals(plant).real
        gain = float(generator.uniform(0.2, 1.8)) / eigenvalues.max()
        changed = _Trial(trial.deformation.with_effective_gain(gain), trial.elements, trial.amplitude)
        predicted = float(np.abs(1 - gain * eigenvalues).max())
        measured = _measured_factor(changed, plant, mass, generator)
        hold(
            abs(measured - predicted) <= 1e-3,
            f"the error shrinks by {measured:.5f} per cycle, predicted max|1 - a lambda| = {predicted:.5f}",
        )


def secant_is_bounded(trial: _Trial, generator: np.random.Generator) -> None:
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


_SEEN = 1e-9  # of the amplitude: a shorter step drowns in the rounding of the request
_FADES = 1e-6  # of the longest step that a smaller error causes


def only_desired_is_fixed(trial: _Trial, generator: np.random.Generator) -> None:
    """A larger error of the same direction moves the request the same way, so no response but the desired one leaves it alone.

    A map that turns back, or that fades far out, as a wavelet does, has false fixed points: there the iteration rests although
    the plant does something else.
    """
    sizes = trial.amplitude * np.logspace(-6, 6, 2000)
    for request in (np.zeros(trial.size), *(trial.vector(generator) for _ in range(_TRIALS))):
        desired, direction = trial.vector(generator), generator.normal(size=trial.size)
        responses = desired[:, None] + direction[:, None] / np.linalg.norm(direction) * sizes
        moved = np.asarray(trial.scalar_function(request, responses, desired, trial.layout.start())[0].full())
        steps = moved - request[:, None]
        lengths = np.linalg.norm(steps, axis=0)
        seen = np.flatnonzero(lengths > _SEEN * trial.amplitude)
        hold(seen.size > 0, f"no error up to {sizes[-1]:.3g} moves the request")
        begin = seen[0]
        along = steps[:, begin] @ steps[:, begin:] / lengths[begin]
        kept = along > _FADES * np.maximum.accumulate(lengths[begin:])
        where = sizes[begin + int(np.argmin(kept))]
        hold(
            bool(kept.all()),
            f"an error of {where:.3g} does not move the request the way a smaller one does, so a false fixed point is near: use a "
            "step that grows with the error or saturates",
        )


def step_is_bounded(trial: _Trial, generator: np.random.Generator) -> None:
    """No error moves the request by more than largest_step()."""
    bound = trial.deformation.largest_step()
    for size in np.logspace(-3, 6, 50):
        request, desired = trial.vector(generator), trial.vector(generator)
        response = desired + size * trial.vector(generator)
        step = float(np.linalg.norm(trial(request, response, desired) - request))
        hold(step <= bound * (1 + 1e-9), f"the request moved by {step:.9g}, above largest_step() = {bound:.9g}")


def graphs_agree(trial: _Trial, generator: np.random.Generator) -> None:
    """The map built from SX and from MX gives the same request and memory."""
    for size in np.logspace(-6, 3, 10):
        desired = trial.vector(generator)
        arguments = (trial.vector(generator), desired + size * trial.vector(generator), desired, trial.layout.start())
        for one, other in zip(trial.scalar_function(*arguments), trial.matrix_function(*arguments), strict=True):
            difference = float(ca.norm_inf(one - other)) if one.numel() else 0.0
            scale = max(1.0, float(ca.norm_inf(one))) if one.numel() else 1.0
            hold(difference <= 1e-12 * scale, f"SX and MX graphs differ by {difference:.3g}")


def nan_shows(trial: _Trial, generator: np.random.Generator) -> None:
    """A response that is not a number never acts: the request is not one either, or it is the desired response."""
    for place in range(trial.size):
        response, desired = trial.vector(generator), trial.vector(generator)
        response[place] = np.nan
        deformed = trial(trial.vector(generator), response, desired)
        hold(
            bool(np.isnan(deformed).any()) or np.array_equal(deformed, desired),
            "a response of NaN is hidden: the request is finite, and not the desired response",
        )


ANY = (frozen_value, derivatives_are_finite, gain_can_be_set, graphs_agree)
LAWS = (
    frozen_value,
    fixed_point_stays,
    derivatives_are_finite,
    first_step_is_effective_gain,
    gain_can_be_set,
    contraction_is_predicted,
    secant_is_bounded,
    only_desired_is_fixed,
    step_is_bounded,
    graphs_agree,
    nan_shows,
)


def _positive_definite(generator: np.random.Generator, size: int) -> Array:
    factor = generator.normal(size=(size, size))
    return np.asarray(factor @ factor.T + 0.5 * size * np.eye(size))


def _measured_factor(trial: _Trial, plant: Array, mass: Array, generator: np.random.Generator) -> float:
    """Mean shrinking of the request in the mass norm, where J is normal, on the plant f(r) = J r with desired 0."""
    zero = np.zeros(trial.size)
    small = 1e-6 * trial.amplitude
    request, logarithms = trial.vector(generator), []
    for _ in range(400):
        request *= small / np.sqrt(request @ mass @ request)
        next_request = trial(request, plant @ request, zero)
        logarithms.append(0.5 * np.log(next_request @ mass @ next_request) - np.log(small))
        request = next_request
    later = logarithms[200:]
    hold(all(b >= a - 1e-6 for a, b in pairwise(later)), "the shrinking per cycle does not settle on a linear plant")
    return float(np.exp(np.mean(later)))
