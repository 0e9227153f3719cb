"""Bounds of states, inputs and response errors that hold for every plant of a box of parameters, along a controller's run.

The proof, line by line, is docs/certificate.md, whose names are used here: x state, w the controlled response just after an update,
p exact parameters, J the response Jacobian, a the effective gain, e = w - d the response error, xi the deviation of the state
and eps that of e from the run of the box's centre.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.errors import NotSupported
from fpirhc.plant.plant import Plant
from fpirhc.review.grid import each
from fpirhc.symbolic.enclosures import Box, Enclosure
from fpirhc.tracking.base import Tracking

_SWEEPS = 60
_WIDER = 1.05  # bounds that are tried next, as multiples of those that followed from the last ones
_LEAST = 1e-9
_SAFE = 1 + 1e-9  # on sums of bounds, for their rounding
_GRAIN = 1e-13  # of the run's sizes: rounding of the differences of its numbers
_LOST = 1e6  # bounds, as multiples of the run's own sizes, that will not close any more


@dataclass(frozen=True, eq=False)
class Chains:
    """Where each coordinate and its derivatives stand in the state, and how they move over a cycle with a constant response."""

    plant: Plant
    period: float  # T of the control cycle
    law: Tracking  # that feeds the errors of the controlled coordinates back, without an integral

    @cached_property
    def places(self) -> dict[str, list[int]]:
        """By coordinate the places of q, q', ... in the state."""
        elements = self.plant.state.elements
        orders = zip(self.plant.names, self.plant.orders, strict=True)
        return {name: [elements.index(name + "'" * j) for j in range(order)] for name, order in orders}

    @cached_property
    def free(self) -> np.ndarray:
        """A: the state one cycle later, without a response, shape (nx, nx)."""
        matrix = np.eye(self.plant.state.size)
        for own in self.places.values():
            for j, place in enumerate(own):
                for later in range(j + 1, len(own)):
                    matrix[place, own[later]] = self._power(later - j)
        return matrix

    @cached_property
    def pushed(self) -> dict[str, np.ndarray]:
        """By coordinate b: how a constant response moves its chain in a cycle."""
        return {
            name: np.array([self._power(len(own) - j) for j in range(len(own))]) for name, own in self.places.items()
        }

    @cached_property
    def ramp(self) -> np.ndarray:
        """How a response that grows at unit rate within a cycle moves every state, shape (nx,)."""
        rows = np.zeros(self.plant.state.size)
        for own in self.places.values():
            rows[own] = [self._power(len(own) - j + 1) for j in range(len(own))]
        return rows

    @cached_property
    def coordinate(self) -> np.ndarray:
        """Number of the coordinate to which every state belongs."""
        rows = np.zeros(self.plant.state.size, dtype=int)
        for k, own in enumerate(self.places.values()):
            rows[own] = k
        return rows

    @cached_property
    def feedback(self) -> np.ndarray:
        """G: what the law subtracts from the desired response per deviation of the state, shape (n, nx)."""
        rows = np.zeros((len(self.plant.controlled_names), self.plant.state.size))
        for row, name in zip(rows, self.plant.controlled_names, strict=True):
            law = self.law.feedback(len(self.places[name]))
            if law is None or law.integral:
                raise NotSupported(
                    f"no certificate with {type(self.law).__name__}: its gains must be constant and it must not integrate, such as "
                    "Exponential(rate=..., integral=False); the deformation removes what is constant"
                )
            row[self.places[name]] = law.gains
        return rows

    @cached_property
    def closed(self) -> dict[str, np.ndarray]:
        """A - b G of every controlled coordinate."""
        matrices = {}
        for row, name in zip(self.feedback, self.plant.controlled_names, strict=True):
            own = self.places[name]
            matrices[name] = self.free[np.ix_(own, own)] - np.outer(self.pushed[name], row[own])
        return matrices

    def _power(self, n: int) -> float:
        return self.period**n / math.factorial(n)


@dataclass(frozen=True, eq=False)
class Expressions:
    """The functions of (x, w, p) whose ranges are needed; the command is the plant's inverse response of w."""

    every: Enclosure  # highest derivative of every coordinate (N,)
    slopes: Enclosure  # its derivative with respect to (x, w, p)
    motion: Enclosure  # x' (nx,)
    rate: Enclosure  # rate of `every` along the motion while the command is held (N,)
    own: Enclosure  # those of the controlled coordinates (n,)
    model: Enclosure  # rate of the model's response to the held command (n,)
    drift: Enclosure  # own - model (n,)
    gain: Enclosure  # J (n, n), column by column
    command: Enclosure  # u (nu,)
    realised: Enclosure  # controlled response as a function of (x, u, p) (n,)


def expressions(plant: Plant, believed: np.ndarray) -> Expressions:
    """Return the functions of a plant and its model; derivatives of the response follow from those of the inverse.

    The inverse of mechanical systems has no division, so its bounds are the tighter ones.

    Args:
        believed: parameters of the model, shape (np,).
    """
    equations, names, controlled = plant.equations, plant.names, list(plant.controlled_names)
    x, u, p = plant.symbols()
    w, r, q = ca.SX.sym("w", len(controlled)), ca.SX.sym("r", len(controlled)), ca.DM(believed)
    command, answer = equations.inverse(x, w, p), equations.response(x, u, p)
    responses = ca.substitute(answer, u, command)
    every = ca.vertcat(*(w[controlled.index(n)] if n in controlled else responses[k] for k, n in enumerate(names)))
    elements, entries = plant.state.elements, ca.vertsplit(every)
    higher = {e: x[elements.index(e + "'")] for e in elements if e + "'" in elements}
    motion = ca.vertcat(*(higher.get(e, entries[names.index(e.rstrip("'"))]) for e in elements))
    own_inverse = ca.inv(ca.jacobian(command, w))
    modelled, believed_command = equations.controlled_response(x, command, q), equations.inverse(x, r, q)
    of_request, of_state = (ca.substitute(ca.jacobian(believed_command, z), r, modelled) for z in (r, x))
    own, model = -own_inverse @ (ca.jacobian(command, x) @ motion), -ca.inv(of_request) @ (of_state @ motion)
    rate = ca.jacobian(every, x) @ motion + ca.jacobian(every, w) @ own
    y = ca.vertcat(x, w, p)
    jacobian, realised = own_inverse @ of_request, equations.controlled_response(x, u, p)
    columns = (every, ca.jacobian(every, y), motion, rate, own, model, own - model, jacobian, command)
    pairs = [*((column, y) for column in columns), (realised, ca.vertcat(x, u, p))]
    return Expressions(*(Enclosure(*pair) for pair in pairs))


@dataclass(frozen=True, eq=False)
class Centre:
    """The run of the plant in the middle of a box: numbers, of which nothing is assumed."""

    states: np.ndarray  # x at the cycles, shape (nx, K + 1)
    commands: np.ndarray  # u, shape (nu, K + 1)
    desired: np.ndarray  # d, shape (n, K + 1)
    lower: np.ndarray  # least parameters of the box, shape (np,)
    upper: np.ndarray  # largest ones

    @property
    def cycles(self) -> int:
        """K, the number of whole cycles."""
        return self.states.shape[1] - 1

    @property
    def parameters(self) -> np.ndarray:
        """Those of the plant that ran, shape (np,)."""
        return 0.5 * (self.lower + self.upper)


@dataclass(frozen=True, eq=False)
class Bounds:
    """What is assumed, or follows: of every plant of the box.

    Args:
        deviation: |xi| at the cycles, shape (nx, K + 1).
        error: |eps|, shape (n, K + 1).
        states: x within the cycles, shape (nx, K).
        responses: w within the cycles, the command held, shape (n, K).
    """

    deviation: np.ndarray
    error: np.ndarray
    states: Box
    responses: Box

    def within(self, other: Bounds) -> bool:
        """Return whether these are inside the other ones."""
        sides = (self.states.within(other.states), self.responses.within(other.responses))
        return bool((self.deviation <= other.deviation).all() and (self.error <= other.error).all()) and all(sides)

    def widened(self, last: Bounds) -> Bounds:
        """Return bounds to try next: these and the last ones, and a little more."""
        deviation = np.maximum(last.deviation, _WIDER * self.deviation + _LEAST)
        error = np.maximum(last.error, _WIDER * self.error + _LEAST)
        deviation[:, 0] = 0.0
        return Bounds(deviation, error, *(_grown(*pair) for pair in self._pairs(last)))

    def _pairs(self, other: Bounds) -> tuple[tuple[Box, Box], tuple[Box, Box]]:
        return (self.states, other.states), (self.responses, other.responses)


def _grown(new: Box, old: Box) -> Box:
    more = (_WIDER - 1) * (new.upper - new.lower) + _LEAST
    return Box(np.minimum(old.lower, new.lower - more), np.maximum(old.upper, new.upper + more))


@dataclass(frozen=True, eq=False)
class Tube:
    """Bounds that follow from themselves, and so hold.

    Args:
        bounds: of deviations, and of states within the cycles.
        commands: u, shape (nu, K + 1).
        errors: |e|, shape (n, K + 1).
        factor: largest spectral radius of the bound of |I - a J|.
        drift: L, the largest rate at which the responses of plant and model part, shape (n,).
    """

    bounds: Bounds
    commands: Box
    errors: np.ndarray
    factor: float
    drift: np.ndarray


@dataclass(frozen=True, eq=False)
class Sweep:
    """What follows from assumed bounds, of one box of parameters around the run of its centre."""

    expressions: Expressions  # of plant and model
    chains: Chains  # of the plant with its law
    centre: Centre  # the run
    believed: np.ndarray  # parameters of the model, shape (np,)
    gain: float  # a

    def tube(self) -> Tube | str:
        """Return bounds that follow from themselves, or why none were found."""
        with np.errstate(all="ignore"):  # bounds that are not finite are no bounds, below
            return self._closed()

    def _closed(self) -> Tube | str:
        bounds = self._first()
        largest = _LOST * (1 + max(np.abs(v).max() for v in (self.centre.states, self._responses)))
        for _ in range(_SWEEPS):
            factor = self._factor(bounds)
            if not factor < 1:
                return _not_contracting(factor, self.gain)
            follows = self._follow(bounds)
            if follows.within(bounds):
                return self._proved(follows, bounds)
            sizes = np.concatenate([follows.deviation.ravel(), follows.error.ravel(), follows.responses.size.ravel()])
            if not np.max(sizes) < largest:
                break
            bounds = follows.widened(bounds)
        where = self.chains.plant.state.elements[int(np.argmax(np.nan_to_num(bounds.deviation).max(axis=1)))]
        return f"the bounds do not close: each round needs wider ones than the last, of '{where}' first"

    @cached_property
    def _box(self) -> tuple[np.ndarray, np.ndarray]:
        c = self.centre
        return tuple(np.tile(v[:, None], (1, c.cycles + 1)) for v in (c.lower, c.upper))  # type: ignore[return-value]

    def _of_plant(
        self, function: ca.Function, states: np.ndarray, commands: np.ndarray, parameters: np.ndarray
    ) -> np.ndarray:
        rows = np.tile(parameters, (states.shape[1], 1))
        return each(function, states.T, commands.T, rows).T

    @cached_property
    def _responses(self) -> np.ndarray:
        """The responses w of the run."""
        c, function = self.centre, self.chains.plant.equations.controlled_response
        return self._of_plant(function, c.states, c.commands, c.parameters)

    @cached_property
    def _points(self) -> np.ndarray:
        """(x, w, p) of the run."""
        c = self.centre
        return np.vstack([c.states, self._responses, np.tile(c.parameters[:, None], (1, c.cycles + 1))])

    def _change(self, parameters: np.ndarray) -> np.ndarray:
        """How the run's response to the held command changes in every cycle, with these parameters, shape (n, K)."""
        c, function = self.centre, self.chains.plant.equations.controlled_response
        held = c.commands[:, :-1]
        after = self._of_plant(function, c.states[:, 1:], held, parameters)
        return after - self._of_plant(function, c.states[:, :-1], held, parameters)

    @cached_property
    def _changes(self) -> tuple[np.ndarray, np.ndarray]:
        """Those of the plant and of the model."""
        return self._change(self.centre.parameters), self._change(self.believed)

    @cached_property
    def _jacobians(self) -> np.ndarray:
        """J of the run, shape (n, n, K + 1)."""
        return self._square(self.expressions.gain.at(self._points))

    def _square(self, columns: np.ndarray) -> np.ndarray:
        n = len(self.chains.feedback)
        return columns.reshape(n, n, -1).swapaxes(0, 1)

    @cached_property
    def _errors(self) -> np.ndarray:
        """The response errors e of the run, shape (n, K + 1)."""
        return self._responses - self.centre.desired

    @cached_property
    def _driven(self) -> tuple[np.ndarray, np.ndarray]:
        """In every cycle of the run: what |J - J_c| multiplies, and by how much the recursion of e fails, shape (n, K)."""
        own, model = self._changes
        slip, ahead = own - model, model - np.diff(self.centre.desired, axis=1)
        jacobians, one = self._jacobians[:, :, 1:], np.eye(len(own))[:, :, None]
        before = self._errors[:, :-1] + slip
        after = _times(one - self.gain * jacobians, before) + _times(one - jacobians, ahead)
        residual = np.abs(self._errors[:, 1:] - after) + _GRAIN * (1 + np.abs(self._responses).max())
        return np.abs(self.gain * before + ahead), residual

    @property
    def residual(self) -> float:
        """By how much the run fails the recursion that the proof is about, in units of the largest response."""
        return float(self._driven[1].max() / (_LEAST + np.abs(self._responses).max()))

    @cached_property
    def _left(self) -> np.ndarray:
        """What a constant response in every cycle does not explain of the run's states, shape (nx, K)."""
        c, chains = self.centre, self.chains
        left = c.states[:, 1:] - chains.free @ c.states[:, :-1]
        responses = self._of_plant(chains.plant.equations.response, c.states, c.commands, c.parameters)
        for row, (name, own) in zip(responses, chains.places.items(), strict=True):
            left[own] -= np.outer(chains.pushed[name], row[:-1])
        return left

    @cached_property
    def _first_error(self) -> np.ndarray:
        """|eps_0|: the first command is the same for every plant, shape (n,)."""
        c = self.centre
        ends = (np.concatenate([c.states[:, 0], c.commands[:, 0], p])[:, None] for p in (c.lower, c.upper))
        return self.expressions.realised.over(Box(*ends)).distance(self._responses[:, :1])[:, 0]

    def _first(self) -> Bounds:
        x, w = self.centre.states, self._responses
        deviation, error = np.full(x.shape, _LEAST), np.full(w.shape, _LEAST)
        deviation[:, 0], error[:, 0] = 0.0, self._first_error
        after = w[:, :-1] + self._changes[0]
        return Bounds(deviation, error, *(_between(a, b) for a, b in ((x[:, :-1], x[:, 1:]), (w[:, :-1], after))))

    def _at_cycles(self, bounds: Bounds) -> Box:
        """(x, w, p) just after the updates."""
        x, w, away = self.centre.states, self._responses, self._response_deviation(bounds.deviation, bounds.error)
        (low, high), xi = self._box, bounds.deviation
        return Box(np.vstack([x - xi, w - away, low]), np.vstack([x + xi, w + away, high]))

    def _within(self, bounds: Bounds) -> Box:
        """(x, w, p) within the cycles."""
        low, high = (v[:, 1:] for v in self._box)
        x, w = bounds.states, bounds.responses
        return Box(np.vstack([x.lower, w.lower, low]), np.vstack([x.upper, w.upper, high]))

    def _response_deviation(self, deviation: np.ndarray, error: np.ndarray) -> np.ndarray:
        return np.abs(self.chains.feedback) @ deviation + error

    def _gain_bounds(self, bounds: Bounds) -> np.ndarray:
        """|J - J_c| after every cycle, shape (n, n, K)."""
        over = self.expressions.gain.over(self._at_cycles(bounds)).distance(self.expressions.gain.at(self._points))
        return self._square(over)[:, :, 1:]

    def _factors(self, bounds: Bounds) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Bounds of |I - a J|, |I - J| and |J - J_c|."""
        unsure, jacobians = self._gain_bounds(bounds), self._jacobians[:, :, 1:]
        one = np.eye(len(jacobians))[:, :, None]
        return np.abs(one - self.gain * jacobians) + self.gain * unsure, np.abs(one - jacobians) + unsure, unsure

    def _factor(self, bounds: Bounds) -> float:
        matrices = self._factors(bounds)[0].transpose(2, 0, 1)
        if not np.isfinite(matrices).all():
            return math.inf
        return float(np.abs(np.linalg.eigvals(matrices)).max())

    def _follow(self, bounds: Bounds) -> Bounds:
        """The bounds that follow: the inequalities of the proof in their order."""
        within, period = self._within(bounds), self.chains.period
        own, model = self._changes
        rates, functions = self.expressions.rate.over(within), self.expressions
        slip = functions.drift.over(within).scaled(period).distance(own - model)
        ahead = functions.model.over(within).scaled(period).distance(model)
        pushed = self._pushes(rates)
        ahead = ahead + np.abs(self.chains.feedback) @ self._steps(bounds, pushed)
        error = self._error(bounds, slip, ahead)
        deviation = self._deviation(bounds, error, pushed)
        at, w = self.centre.states[:, :-1], self._responses[:, :-1]
        xi, away = bounds.deviation[:, :-1], self._response_deviation(bounds.deviation, bounds.error)[:, :-1]
        moved, turned = (f.over(within).scaled(period) for f in (functions.motion, functions.own))
        return Bounds(deviation, error, _moved(at, xi, moved), _moved(w, away, turned))

    def _pushes(self, rates: Box) -> np.ndarray:
        """gamma: what the change of the responses within a cycle adds to |xi|, shape (nx, K)."""
        chains, left = self.chains, self._left
        rows = [Box(rates.lower[k], rates.upper[k]) for k in chains.coordinate]
        sizes = [row.scaled(s).distance(data) for row, s, data in zip(rows, chains.ramp, left, strict=True)]
        return np.array(sizes) + _GRAIN * (1 + np.abs(self.centre.states).max())

    def _steps(self, bounds: Bounds, pushed: np.ndarray) -> np.ndarray:
        """|xi_{k+1} - xi_k| of the controlled chains, shape (nx, K)."""
        steps, chains = np.zeros_like(pushed), self.chains
        for row, (name, closed) in zip(bounds.error, chains.closed.items(), strict=True):
            own = chains.places[name]
            turned = np.abs(closed - np.eye(len(own))) @ bounds.deviation[own, :-1]
            steps[own] = turned + np.outer(chains.pushed[name], row[:-1]) + pushed[own]
        return steps

    def _error(self, bounds: Bounds, slip: np.ndarray, ahead: np.ndarray) -> np.ndarray:
        """|eps| by the recursion."""
        contracting, coupled, unsure = self._factors(bounds)
        driven, residual = self._driven
        added = _times(contracting, slip) + _times(coupled, ahead) + _times(unsure, driven) + residual
        error = np.empty_like(self._responses)
        error[:, 0] = self._first_error
        for k in range(self.centre.cycles):
            error[:, k + 1] = _SAFE * (contracting[:, :, k] @ error[:, k] + added[:, k])
        return error

    def _deviation(self, bounds: Bounds, error: np.ndarray, pushed: np.ndarray) -> np.ndarray:
        """|xi|: of controlled chains by the powers of A - b G, of the others by their own recursion."""
        chains, cycles = self.chains, self.centre.cycles
        deviation = np.zeros_like(bounds.deviation)
        for row, (name, closed) in zip(error, chains.closed.items(), strict=True):
            own, late = chains.places[name], _powers(closed, cycles)
            sizes, forced = np.abs(late), np.abs(late @ chains.pushed[name])
            for j, place in enumerate(own):
                parts = [np.convolve(sizes[:, j, i], pushed[p])[:cycles] for i, p in enumerate(own)]
                deviation[place, 1:] = _SAFE * (np.convolve(forced[:, j], row[:-1])[:cycles] + np.sum(parts, axis=0))
        others = [n for n in chains.places if n not in chains.closed]
        if others:
            self._uncontrolled(others, bounds, deviation, error, pushed)
        return deviation

    def _uncontrolled(
        self, names: list[str], bounds: Bounds, deviation: np.ndarray, error: np.ndarray, pushed: np.ndarray
    ) -> None:
        """Fill in |xi| of the coordinates that no input controls, from the slopes of their responses."""
        c, chains = self.centre, self.chains
        count, entries = len(chains.plant.names), len(self._points)
        flat = self.expressions.slopes.over(self._at_cycles(bounds))
        low, high = (v.reshape(entries, count, -1).swapaxes(0, 1) for v in (flat.lower, flat.upper))
        sizes, radius = np.maximum(np.abs(low), np.abs(high)), 0.5 * (c.upper - c.lower)
        for k in range(c.cycles):
            away = self._response_deviation(deviation[:, k], error[:, k])
            change = np.concatenate([deviation[:, k], away, radius])
            for name in names:
                row, own, pushes = chains.plant.names.index(name), chains.places[name], chains.pushed[name]
                outer = change.copy()
                outer[own] = 0.0
                free = chains.free[np.ix_(own, own)]
                ends = (free + np.outer(pushes, v[row, own, k]) for v in (low, high))
                turned = np.maximum.reduce([np.abs(end) for end in ends]) @ deviation[own, k]
                deviation[own, k + 1] = _SAFE * (turned + pushes * (sizes[row, :, k] @ outer) + pushed[own, k])

    def _proved(self, follows: Bounds, assumed: Bounds) -> Tube:
        commands = self.expressions.command.over(self._at_cycles(assumed))
        drift = self.expressions.drift.over(self._within(assumed)).size.max(axis=1)
        errors = np.abs(self._errors) + follows.error
        return Tube(follows, commands, errors, self._factor(assumed), drift)


def _not_contracting(factor: float, gain: float) -> str:
    return (
        f"the iteration need not contract: with the effective gain {gain:g} the bound of the spectral radius of |I - a J| over the "
        f"box is {factor:.3g}, and it must be below 1"
    )


def _times(matrices: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Products of (n, n, K) and (n, K)."""
    return np.asarray(np.einsum("ijk,jk->ik", matrices, columns))


def _between(one: np.ndarray, other: np.ndarray) -> Box:
    return Box(np.minimum(one, other) - _LEAST, np.maximum(one, other) + _LEAST)


def _moved(centre: np.ndarray, radius: np.ndarray, step: Box) -> Box:
    """Everything between the start and the end of a cycle."""
    return Box(centre - radius + np.minimum(step.lower, 0.0), centre + radius + np.maximum(step.upper, 0.0))


def _powers(matrix: np.ndarray, count: int) -> np.ndarray:
    """I, M, M^2, ..., shape (count, n, n)."""
    powers = np.empty((count, *matrix.shape))
    powers[0] = np.eye(len(matrix))
    for k in range(1, count):
        powers[k] = matrix @ powers[k - 1]
    return powers
