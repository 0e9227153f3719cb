"""Bounds of states, inputs and response errors that hold for every plant of a box of parameters, along a controller's run.

The proof, line by line, is docs/certificate.md, whose names are used here: x state, w the controlled response just after an update,
p exact parameters, J the response Jacobian, a the effective gain, e = w - d the response error, xi the deviation of the state
and eps that of e from the run of the box's centre.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.certificate.enclosures import Box, Enclosure
from fpirhc.plant.plant import Plant

_SWEEPS = 60
_WIDER = 1.05  # bounds that are tried next, as multiples of those that followed from the last ones
_LEAST = 1e-9
_SAFE = 1 + 1e-9  # on sums of bounds, for their rounding
_GRAIN = 1e-13  # of the run's sizes: rounding of the differences of its numbers
_LOST = 1e6  # bounds, as multiples of the run's own sizes, that will not close any more


class Chains:
    """Where each coordinate and its derivatives stand in the state, and how they move over a cycle with a constant response."""

    def __init__(self, plant: Plant, period: float, gains: Mapping[str, Sequence[float]]) -> None:
        """Of a plant with the gains of a law, by controlled coordinate: of the errors of q, q', ..."""
        elements, nx = plant.state.elements, plant.state.size
        powers = [period**n / math.factorial(n) for n in range(max(plant.orders) + 2)]
        # places of q, q', ... in the state by coordinate
        self.places = {
            name: [elements.index(name + "'" * j) for j in range(order)]
            for name, order in zip(plant.names, plant.orders, strict=True)
        }
        self.plant, self.period = plant, period
        self.free = np.eye(nx)  # A: the state one cycle later, without a response
        self.ramp = np.zeros(nx)  # how a response that grows at unit rate within a cycle moves every state
        self.coordinate = np.zeros(nx, dtype=int)  # number of the coordinate to which every state belongs
        self.pushed: dict[str, np.ndarray] = {}  # b: how a constant response moves the chain of a coordinate in a cycle
        self.feedback = np.zeros((len(gains), nx))  # G: what the law subtracts from the desired response
        for k, (name, own) in enumerate(self.places.items()):
            for j, place in enumerate(own):
                self.free[place, own[j:]] = powers[: len(own) - j]
                self.ramp[place], self.coordinate[place] = powers[len(own) - j + 1], k
            self.pushed[name] = np.array([powers[len(own) - j] for j in range(len(own))])
        self.closed: dict[str, np.ndarray] = {}  # A - b G of every controlled coordinate
        for row, name in zip(self.feedback, plant.controlled_names, strict=True):
            own = self.places[name]
            row[own] = gains[name]
            self.closed[name] = self.free[np.ix_(own, own)] - np.outer(self.pushed[name], row[own])


class Expressions:
    """The functions of (x, w, p) whose ranges are needed; the command is the plant's inverse response of w.

    Derivatives of the response follow from those of the inverse, which in mechanics has no division, so their bounds are tighter.
    """

    def __init__(self, plant: Plant, believed: np.ndarray) -> None:
        """Of a plant and the parameters of its model, shape (np,)."""
        equations, names, controlled = plant.equations, plant.names, list(plant.controlled_names)
        x, u, p = plant.symbols()
        w, r, q = ca.SX.sym("w", len(controlled)), ca.SX.sym("r", len(controlled)), ca.DM(believed)
        y, command = ca.vertcat(x, w, p), equations.inverse(x, w, p)
        responses = ca.substitute(equations.response(x, u, p), u, command)
        every = ca.vertcat(*(w[controlled.index(n)] if n in controlled else responses[k] for k, n in enumerate(names)))
        elements, entries = plant.state.elements, ca.vertsplit(every)
        higher = {e: x[elements.index(e + "'")] for e in elements if e + "'" in elements}
        motion = ca.vertcat(*(higher.get(e, entries[names.index(e.rstrip("'"))]) for e in elements))
        own_inverse = ca.inv(ca.jacobian(command, w))
        modelled, believed_command = equations.controlled_response(x, command, q), equations.inverse(x, r, q)
        of_request, of_state = (ca.substitute(ca.jacobian(believed_command, z), r, modelled) for z in (r, x))
        own, model = -own_inverse @ (ca.jacobian(command, x) @ motion), -ca.inv(of_request) @ (of_state @ motion)
        rate = ca.jacobian(every, x) @ motion + ca.jacobian(every, w) @ own
        self.slopes = Enclosure(
            ca.jacobian(every, y), y
        )  # of the highest derivatives of every coordinate (N, nx + n + np)
        self.motion, self.rate = (
            Enclosure(motion, y),
            Enclosure(rate, y),
        )  # x', and the rate of `every` with the command held
        self.own, self.model = (
            Enclosure(own, y),
            Enclosure(model, y),
        )  # the rates of the controlled responses of plant and model
        self.drift = Enclosure(own - model, y)
        self.gain, self.command = (
            Enclosure(own_inverse @ of_request, y),
            Enclosure(command, y),
        )  # J column by column, and u
        self.realised = Enclosure(equations.controlled_response(x, u, p), ca.vertcat(x, u, p))


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
        numbers = (self.deviation <= other.deviation).all() and (self.error <= other.error).all()
        return bool(numbers) and self.states.within(other.states) and self.responses.within(other.responses)

    def widened(self, last: Bounds) -> Bounds:
        """Return bounds to try next: these and the last ones, and a little more."""
        deviation = np.maximum(last.deviation, _WIDER * self.deviation + _LEAST)
        error = np.maximum(last.error, _WIDER * self.error + _LEAST)
        deviation[:, 0] = 0.0
        return Bounds(deviation, error, _grown(self.states, last.states), _grown(self.responses, last.responses))


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


class Sweep:
    """What follows from assumed bounds, of one box of parameters around the run of its centre."""

    def __init__(
        self, functions: Expressions, chains: Chains, centre: Centre, believed: np.ndarray, gain: float
    ) -> None:
        """Of the functions of plant and model, the plant's chains with its law, the run, the model's parameters and a."""
        self.functions, self.chains, self.centre, self.gain = functions, chains, centre, gain
        x, u, d, cycles = centre.states, centre.commands, centre.desired, centre.cycles
        respond, middle, one = chains.plant.equations.controlled_response, centre.parameters, np.eye(len(d))[:, :, None]
        self.responses = w = _values(respond, x, u, middle)  # w
        self.errors = e = w - d  # the response errors e
        self.points = np.vstack([x, w, np.tile(middle[:, None], (1, cycles + 1))])  # (x, w, p)
        self.box = tuple(np.tile(v[:, None], (1, cycles + 1)) for v in (centre.lower, centre.upper))
        # how the responses of plant and model to the held command change in every cycle, shape (n, K)
        held = u[:, :-1]
        ends = ((_values(respond, z, held, p) for z in (x[:, 1:], x[:, :-1])) for p in (middle, believed))
        self.own, self.model = (after - before for after, before in ends)
        self.jacobians = self._square(functions.gain.at(self.points))[:, :, 1:]  # J after every cycle, shape (n, n, K)
        # what |J - J_c| multiplies, and by how much the recursion of e fails
        before, ahead = e[:, :-1] + self.own - self.model, self.model - np.diff(d, axis=1)
        after = _times(one - gain * self.jacobians, before) + _times(one - self.jacobians, ahead)
        self.driven = np.abs(gain * before + ahead)
        self.residuals = np.abs(e[:, 1:] - after) + _GRAIN * (1 + np.abs(w).max())
        # what a constant response in every cycle does not explain of the states, shape (nx, K)
        self.left = x[:, 1:] - chains.free @ x[:, :-1]
        for row, (name, own) in zip(
            _values(chains.plant.equations.response, x, u, middle), chains.places.items(), strict=True
        ):
            self.left[own] -= np.outer(chains.pushed[name], row[:-1])
        # |eps_0|: the first command is the same for every plant
        first = Box(*(np.concatenate([x[:, 0], u[:, 0], p])[:, None] for p in (centre.lower, centre.upper)))
        self.first_error = functions.realised.over(first).distance(w[:, :1])[:, 0]

    @property
    def residual(self) -> float:
        """By how much the run fails the recursion that the proof is about, in units of the largest response."""
        return float(self.residuals.max() / (_LEAST + np.abs(self.responses).max()))

    def tube(self) -> Tube | str:
        """Return bounds that follow from themselves, or why none were found."""
        with np.errstate(all="ignore"):  # bounds that are not finite are no bounds, below
            return self._closed()

    def _closed(self) -> Tube | str:
        bounds = self._first()
        largest = _LOST * (1 + max(np.abs(self.centre.states).max(), np.abs(self.responses).max()))
        for _ in range(_SWEEPS):
            factor = self._factor(bounds)
            if not factor < 1:
                return (
                    f"the iteration need not contract: with the effective gain {self.gain:g} the bound of the spectral radius of "
                    f"|I - a J| over all plants and states of the run is {factor:.3g}, and it must be below 1"
                )
            follows = self._follow(bounds)
            if follows.within(bounds):
                commands = self.functions.command.over(self._at_cycles(bounds))
                drift = self.functions.drift.over(self._within(bounds)).distance(0.0).max(axis=1)
                return Tube(follows, commands, np.abs(self.errors) + follows.error, self._factor(bounds), drift)
            sizes = follows.deviation, follows.error, follows.responses.distance(0.0)
            if not all(np.max(size) < largest for size in sizes):
                break
            bounds = follows.widened(bounds)
        where = self.chains.plant.state.elements[int(np.argmax(np.nan_to_num(bounds.deviation).max(axis=1)))]
        return f"the bounds do not close: each round needs wider ones than the last, of '{where}' first"

    def _square(self, columns: np.ndarray) -> np.ndarray:
        n = len(self.chains.feedback)
        return columns.reshape(n, n, -1).swapaxes(0, 1)

    def _first(self) -> Bounds:
        x, w = self.centre.states, self.responses
        deviation, error = np.full(x.shape, _LEAST), np.full(w.shape, _LEAST)
        deviation[:, 0], error[:, 0] = 0.0, self.first_error
        return Bounds(deviation, error, _between(x[:, :-1], x[:, 1:]), _between(w[:, :-1], w[:, :-1] + self.own))

    def _at_cycles(self, bounds: Bounds) -> Box:
        """(x, w, p) just after the updates."""
        x, w, away = self.centre.states, self.responses, self._response_deviation(bounds.deviation, bounds.error)
        (low, high), xi = self.box, bounds.deviation
        return Box(np.vstack([x - xi, w - away, low]), np.vstack([x + xi, w + away, high]))

    def _within(self, bounds: Bounds) -> Box:
        """(x, w, p) within the cycles."""
        low, high = (v[:, 1:] for v in self.box)
        x, w = bounds.states, bounds.responses
        return Box(np.vstack([x.lower, w.lower, low]), np.vstack([x.upper, w.upper, high]))

    def _response_deviation(self, deviation: np.ndarray, error: np.ndarray) -> np.ndarray:
        return np.abs(self.chains.feedback) @ deviation + error

    def _factors(self, bounds: Bounds) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Bounds of |I - a J|, |I - J| and |J - J_c| after every cycle, shape (n, n, K) each."""
        gain, jacobians, one = self.functions.gain, self.jacobians, np.eye(len(self.jacobians))[:, :, None]
        unsure = self._square(gain.over(self._at_cycles(bounds)).distance(gain.at(self.points)))[:, :, 1:]
        return np.abs(one - self.gain * jacobians) + self.gain * unsure, np.abs(one - jacobians) + unsure, unsure

    def _factor(self, bounds: Bounds) -> float:
        matrices = self._factors(bounds)[0].transpose(2, 0, 1)
        return float(np.abs(np.linalg.eigvals(matrices)).max()) if np.isfinite(matrices).all() else math.inf

    def _follow(self, bounds: Bounds) -> Bounds:
        """The bounds that follow: the inequalities of the proof in their order."""
        within, period = self._within(bounds), self.chains.period
        functions = self.functions
        slip = functions.drift.over(within).scaled(period).distance(self.own - self.model)
        ahead = functions.model.over(within).scaled(period).distance(self.model)
        pushed = self._pushes(functions.rate.over(within))
        ahead = ahead + np.abs(self.chains.feedback) @ self._steps(bounds, pushed)
        error = self._error(bounds, slip, ahead)
        deviation = self._deviation(bounds, error, pushed)
        at, w = self.centre.states[:, :-1], self.responses[:, :-1]
        xi, away = bounds.deviation[:, :-1], self._response_deviation(bounds.deviation, bounds.error)[:, :-1]
        moved, turned = (f.over(within).scaled(period) for f in (functions.motion, functions.own))
        return Bounds(deviation, error, _moved(at, xi, moved), _moved(w, away, turned))

    def _pushes(self, rates: Box) -> np.ndarray:
        """gamma: what the change of the responses within a cycle adds to |xi|, shape (nx, K)."""
        chains = self.chains
        rows = [Box(rates.lower[k], rates.upper[k]) for k in chains.coordinate]
        sizes = [row.scaled(s).distance(data) for row, s, data in zip(rows, chains.ramp, self.left, strict=True)]
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
        added = _times(contracting, slip) + _times(coupled, ahead) + _times(unsure, self.driven) + self.residuals
        error = np.empty_like(self.responses)
        error[:, 0] = self.first_error
        for k in range(self.centre.cycles):
            error[:, k + 1] = _SAFE * (contracting[:, :, k] @ error[:, k] + added[:, k])
        return error

    def _deviation(self, bounds: Bounds, error: np.ndarray, pushed: np.ndarray) -> np.ndarray:
        """|xi|: of controlled chains by the powers of A - b G, of the others by their own recursion."""
        chains, cycles = self.chains, self.centre.cycles
        deviation = np.zeros_like(bounds.deviation)
        for row, (name, closed) in zip(error, chains.closed.items(), strict=True):
            own = chains.places[name]
            late = np.empty((cycles, *closed.shape))  # I, M, M^2, ...
            late[0] = np.eye(len(own))
            for k in range(1, cycles):
                late[k] = closed @ late[k - 1]
            sizes, forced = np.abs(late), np.abs(late @ chains.pushed[name])
            for j, place in enumerate(own):
                parts = [np.convolve(sizes[:, j, i], pushed[p])[:cycles] for i, p in enumerate(own)]
                deviation[place, 1:] = _SAFE * (np.convolve(forced[:, j], row[:-1])[:cycles] + np.sum(parts, axis=0))
        self._uncontrolled(bounds, deviation, error, pushed)
        return deviation

    def _uncontrolled(self, bounds: Bounds, deviation: np.ndarray, error: np.ndarray, pushed: np.ndarray) -> None:
        """Fill in |xi| of the coordinates that no input controls, from the slopes of their responses."""
        c, chains = self.centre, self.chains
        names = [n for n in chains.places if n not in chains.closed]
        if not names:
            return
        count, entries = len(chains.plant.names), len(self.points)
        flat = self.functions.slopes.over(self._at_cycles(bounds))
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


def _values(function: ca.Function, states: np.ndarray, commands: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    count = states.shape[1]
    return np.asarray(function.map(count)(states, commands, np.tile(parameters[:, None], (1, count))).full())


def _times(matrices: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Products of (n, n, K) and (n, K)."""
    return np.asarray(np.einsum("ijk,jk->ik", matrices, columns))


def _between(one: np.ndarray, other: np.ndarray) -> Box:
    return Box(np.minimum(one, other) - _LEAST, np.maximum(one, other) + _LEAST)


def _moved(centre: np.ndarray, radius: np.ndarray, step: Box) -> Box:
    """Everything between the start and the end of a cycle."""
    return Box(centre - radius + np.minimum(step.lower, 0.0), centre + radius + np.maximum(step.upper, 0.0))
