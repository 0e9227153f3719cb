"""The estimated parameters of a controller that learns: the block that moves them, and the checks before a run.

    h = M_hat^-1 (u - Q(q, q', q''; p_hat)) = M_hat^-1 Y(q, q', q'') (p - p_hat)

with the last command u and the response q'' to it: u = Q(q, q', q''; p) is exact. Theory: docs/theory.md.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import cast

import casadi as ca
import numpy as np

from fpirhc.controllers.base import clip
from fpirhc.controllers.built import Built
from fpirhc.errors import InvalidValue, refuse
from fpirhc.learning.rules import Bounds, Evidence, Pair, Rule
from fpirhc.plant.plant import Plant
from fpirhc.plant.regressor import Regressor
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import Signals, is_finite
from fpirhc.symbolic.layout import Expression, Layout, Signal, like, scalar
from fpirhc.task.problem import Problem

Gradient = Callable[[Signals, Expression, Expression], Pair]  # (signals, state of the response, estimate) -> (G, w)
_STATES = 25  # places along the reference at which the mass matrix is tried
_CORNERS = 4096  # corners of the box that are tried at most
_DEFINITE = 1e-9  # smallest over largest eigenvalue of a mass matrix that counts as positive definite


@dataclass(frozen=True, eq=False)
class Learning:
    """Which parameters are learned, within which bounds, by which rule.

    Args:
        rule: moves the estimate.
        bounds: parameter -> (lower, upper); these are learned.
    """

    rule: Rule
    bounds: Bounds

    def regressor(self, plant: Plant) -> Regressor:
        """Return the plant's regressor for the learned parameters; the same one for the same plant."""
        names = tuple(self.bounds)
        return _REGRESSORS.of((plant,), names, lambda: Regressor(plant, names))

    def check(self, problem: Problem, *, inverts: bool) -> None:
        """Raise if plant, bounds, or rule do not fit each other.

        Args:
            inverts: whether the controller inverts the mass matrix.
        """
        refuse(_against(problem.plant))
        regressor = self.regressor(problem.plant)
        self.rule.check(self.bounds)
        _check_bounds(regressor, self.bounds)
        states = _states(problem)
        resting = states * [name in problem.plant.coordinates for name in problem.plant.state.elements]
        coefficients = _mass_coefficients(regressor, states)
        refuse(_against_masses(coefficients, _mass_coefficients(regressor, resting)))
        if inverts or self.rule.reads_response:
            _check_definite(self.bounds, coefficients)

    def block(self, built: Built, extra: Sequence[Signal], gradient: Gradient) -> Block:
        """Return Block (what every controller reads, last command, `extra`) -> (estimate, _believed).

        '_believed' holds the plant's parameters, the learned ones among them.

        Args:
            extra: signals that `gradient` reads.
            gradient: of the Lyapunov function, for rules that follow it.
        """
        plant, regressor = built.plant, self.regressor(built.plant)
        believed = like(plant.parameter, "_believed")
        lower, upper = ([b[k] for b in self.bounds.values()] for k in (0, 1))
        equation = equation_function(regressor)
        learned = replace(regressor.signal, name="learned", start=())
        pairs = built.pairs
        begins = built.warm_up if self.rule.reads_response else 1
        reads = (
            plant.state,
            pairs.state,
            plant.response_signal("realised"),
            plant.parameter,
            like(plant.input, "_command_before"),
            scalar("warm_up"),
            scalar("_clipped_before"),
            *extra,
        )

        def step(s: Signals) -> dict[str, Expression]:
            running = s.warm_up > begins - 0.5
            state, command, waiting = pairs.pair(s, s._command_before)
            old = ca.if_else(running, s.learned, clip(s.parameters[regressor.places], lower, upper))
            evidence = Evidence(
                lambda: gradient(s, state, old),
                lambda: cast(Pair, equation(state, s.realised, command, old, s.parameters)),
                s._clipped_before,
            )
            candidate = old + self.rule.change(evidence, self.bounds, built.period)
            good = ca.logic_and(running, is_finite(candidate))
            new = ca.if_else(good, clip(candidate, lower, upper), old)
            return {"estimate": new, "_believed": regressor.believed(new, s.parameters), "learned_next": new, **waiting}

        return Block(
            "learn", Layout(reads), Layout((regressor.signal, believed)), step, Layout((learned, *pairs.memory))
        )


_REGRESSORS: Latest[Regressor] = Latest(4)  # checks, blocks and other compositions of a controller ask for the same one


def learning_delays() -> list[Delay]:
    """Return the delays of learning, besides those of the closing blocks."""
    return [Delay(scalar("_clipped_before"), "clipped")]


def equation_function(regressor: Regressor) -> ca.Function:
    """Return Function (state, response, last command, estimate, parameters) -> (M_hat^-1 Y, h)."""
    (x, r, p, theta), u = regressor.symbols(), ca.SX.sym("u", len(regressor.plant.inputs))
    y, rest = regressor.function(x, r, p)
    both = ca.solve(regressor.mass_function(x, theta, p), ca.horzcat(y, u - rest - ca.mtimes(y, theta)))
    return ca.Function("fpirhc_equation", [x, r, u, theta, p], [both[:, :-1], both[:, -1]])


_MECHANICS = "learning inverse dynamics is for mechanics"


def _against(plant: Plant) -> Iterator[str]:
    """Reasons against a plant in which other quantities than coordinates of mechanics, of order 2, follow the reference."""
    if not plant.equations.follows_state:
        yield (
            f"{_MECHANICS} in its own coordinates, whose inertia matrix it learns; "
            f"{', '.join(plant.controlled_names)} are other functions of the state; use ComputedTorque with a deformation"
        )
    for name, order in zip(plant.names, plant.orders, strict=True):
        if order != 2:
            yield (
                f"{_MECHANICS}, order 2 throughout, but this plant has '{name}' of order {order}; "
                "use ComputedTorque with a deformation"
            )


def _check_bounds(regressor: Regressor, bounds: Bounds) -> None:
    first = regressor.plant.approximate[regressor.places]
    for (name, (lower, upper)), value in zip(bounds.items(), first, strict=True):
        if not lower < upper:
            raise InvalidValue(f"bounds of '{name}' are ({lower!r}, {upper!r}); expected lower < upper")
        if not lower <= value <= upper:
            raise InvalidValue(
                f"the first estimate of '{name}', {value:g} by the approximate parameters, is outside its bounds "
                f"({lower:g}, {upper:g}); widen them"
            )


def _states(problem: Problem) -> np.ndarray:
    """The start and states along the reference, shape (count, nx)."""
    times = np.linspace(0.0, problem.duration, _STATES)
    along = problem.reference.function(problem.plant).map(times.size)(times[None, :])[0]
    return np.vstack([problem.start_state, np.asarray(along.full()).T])


def _mass_coefficients(regressor: Regressor, states: np.ndarray) -> np.ndarray:
    """M = A_0 + sum_j theta_j A_j at every state, shape (count, m + 1, n, n)."""
    x, _, p, theta = regressor.symbols()
    mass = ca.vec(regressor.mass_function(x, theta, p))
    zero = ca.substitute(mass, theta, ca.SX.zeros(theta.numel()))
    function = ca.Function("fpirhc_coefficients", [x, p], [ca.densify(ca.horzcat(zero, ca.jacobian(mass, theta)))])
    n = len(regressor.plant.names)
    blocks = [np.asarray(function(state, regressor.plant.approximate).full()) for state in states]
    return np.stack([f.T.reshape((-1, n, n)) for f in blocks])


def _against_masses(coefficients: np.ndarray, resting: np.ndarray) -> Iterator[str]:
    skew = np.abs(coefficients - coefficients.transpose(0, 1, 3, 2)).max()
    moving = np.abs(coefficients - resting).max()
    if not max(skew, moving) <= 1e-6 * np.abs(coefficients).max():
        what = "symmetric" if moving <= skew else "independent of q'"
        yield (
            f"{_MECHANICS}, but the matrix dQ/dq'' of this plant is not {what}; write the "
            "response so that input k does work along coordinate k and inertia does not depend on velocity"
        )


def _check_definite(bounds: Bounds, coefficients: np.ndarray) -> None:
    """Raise where a corner of the box is not definite: the smallest eigenvalue is concave in theta, so least at a corner."""
    entering = np.abs(coefficients[:, 1:]).max(axis=(0, 2, 3)) > 0
    ends = np.array([b if e else (0.0, 0.0) for b, e in zip(bounds.values(), entering, strict=True)], dtype=float)
    if not np.isfinite(ends).all():
        name = list(bounds)[int(np.argmin(np.isfinite(ends).all(axis=1)))]
        raise InvalidValue(f"'{name}' enters the mass matrix, which must stay positive definite: give it finite bounds")
    if 2 ** int(entering.sum()) <= _CORNERS:
        corners = np.array(list(itertools.product(*(sorted(set(pair)) for pair in ends.tolist()))))
    else:  # a random sample of them
        sides = np.random.default_rng(0).integers(2, size=(_CORNERS, len(ends)))
        corners = ends[np.arange(len(ends)), sides]
    for at in coefficients:
        masses = at[0] + np.einsum("cj,jab->cab", corners, at[1:])
        sizes = np.sqrt(np.abs(np.diagonal(masses, axis1=1, axis2=2)))  # coordinates have units of their own
        sizes = np.where(sizes > 0, sizes, 1.0)
        values = np.linalg.eigvalsh(masses / (sizes[:, :, None] * sizes[:, None, :]))
        worst = int(np.argmin(values[:, 0]))
        if not values[worst, 0] > _DEFINITE * values[worst, -1]:
            corner = ", ".join(f"{n} = {v:g}" for n, v, e in zip(bounds, corners[worst], entering, strict=True) if e)
            raise InvalidValue(
                f"the bounds admit a mass matrix that is not positive definite (smallest eigenvalue {values[worst, 0]:.3g}) at "
                f"{corner}; narrow them, or learn parameters for which every positive value is possible (masses and inertias)"
            )
