"""Limits of a plan: their units, their distances, what they add to a sweep, and how far a plan is from the first-order conditions.

Entry r of stage i is input r, or a limited state one stage later. Matrices of limits have the shape (rows, 2 N): lower limits of
all stages, then upper ones. With sign 1 for lower, -1 for upper ones, d = sign (w - limit) is a distance, and a multiplier z >= 0
adds -sign z to the gradient. A multiplier of a state is at most rho: beyond it the limit gives way (exact L1 penalty).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np

from fpirhc.horizon.problem import OptimalControl, answered_curvature
from fpirhc.horizon.riccati import Expansion, in_reverse
from fpirhc.optimisers.base import KEPT, clip, state_units
from fpirhc.symbolic.expression import FINITE, is_finite

_CAPACITY = 1e4  # largest multiplier of a hard limit, in units of cost per unit
ENOUGH = 0.99  # share of the largest multiplier from which a limit counts as given up
STIFF = 1e8  # weight of an equality, in units of 1 / gamma
BOUNDARY = 0.99  # largest share of the distance to the boundary in one step
_CLOSED = 1e-6  # scaled gap below which a plan counts as a trajectory
HAIR = 1e-8  # of the unit: how far inside the limits of inputs descents stay


@dataclass(frozen=True, eq=False)
class Scales:
    """Units of a problem."""

    inputs: np.ndarray  # shape (nu,)
    states: np.ndarray  # shape (ns,)
    cost: float  # C
    bounded: tuple[int, ...]  # places of the states that have a limit
    capacity: np.ndarray  # largest multipliers of the bounded states, in cost per unit
    hard: np.ndarray  # whether the limits of the bounded states have no price

    @property
    def rows(self) -> np.ndarray:
        """Units of the entries that can be limited: the inputs, then the bounded states."""
        return np.concatenate([self.inputs, self.states[list(self.bounded)]])


def scales(ocp: OptimalControl) -> Scales:
    """Return the scales of a problem, from its limits and its reference.

        inputs    half the range of the input; where it is free, the least move along the reference that shifts a limited state
                  by its unit, which is 1 for an input that shifts none
        states    half the range of the state's limits; without both, or where they are an equation, half the spread
                  of the reference and a tenth of its size
        cost      C = median over the inputs of Q_uu (half range)^2, with Q_uu the curvature that is left along an input of the
                  first stage once all later inputs answer it: without the answer it grows with every stage of an unstable model

    gamma = unit^2 / C turns a gradient into a move, and 1e4 C / unit is the largest multiplier that a limit of a state may have.
    """
    states = state_units(ocp)
    places = np.flatnonzero(np.isfinite(ocp.state_lower) | np.isfinite(ocp.state_upper))
    inputs = _input_units(ocp, states, places)
    cost = float(np.median(_answered_curvature(ocp) * inputs**2))
    hard = ocp.hard[places]
    capacity = np.where(hard, _CAPACITY * cost / states[places], ocp.state_price[places])
    return Scales(inputs, states, cost, tuple(int(k) for k in places), capacity, hard)


def tolerated(ocp: OptimalControl) -> np.ndarray:
    """Return the violation of every state's limits that still counts as kept, shape (ns,)."""
    return KEPT * state_units(ocp)


def _input_units(ocp: OptimalControl, states: np.ndarray, places: np.ndarray) -> np.ndarray:
    """The units of the inputs (nu,), with those of the states (ns,), of which some are limited at these places."""
    half = _half(ocp.input_lower, ocp.input_upper)
    free = ~np.isfinite(half)
    units = np.where(~free & (half > 0), half, 1.0)
    if not free.any() or not places.size:
        return units
    # A force of 1 N is nothing to a car: limits that a plan can keep were given up.
    slopes = np.abs(ocp.along.sensitivity()[:, places]).reshape(ocp.stages, places.size, ocp.stages, ocp.input.size)
    with np.errstate(divide="ignore", invalid="ignore"):
        moves = (states[places, None] / slopes.max(axis=(0, 2))).min(axis=0)
    return np.where(free & np.isfinite(moves) & (moves > 0), moves, units)


def _answered_curvature(ocp: OptimalControl) -> np.ndarray:
    """The curvature (nu,) along the inputs of the first stage once later inputs answer; that of later inputs at rest else."""
    diagonal = answered_curvature(ocp.along)
    usable = np.isfinite(diagonal) & (diagonal > 0)
    return np.where(usable, diagonal, ocp.step * ocp.curvature)


def _half(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return np.asarray(0.5 * (upper - lower))


_NONE = 10 * FINITE


class Interior(NamedTuple):
    """Slacks t, elastics e and multipliers z (rows, 2 N), or their moves."""

    t: ca.MX
    e: ca.MX
    z: ca.MX


class Limited:
    """The limits of one call.

    `lower`: lower limits of the inputs, shape (nu,). `upper`: upper limits of the inputs, shape (nu,).
    """

    def __init__(self, ocp: OptimalControl, scales: Scales, lower: ca.MX, upper: ca.MX) -> None:
        n, nu, places = ocp.stages, ocp.input.size, list(scales.bounded)
        self.places, self._n, self._nu, self._inputs = places, n, nu, (lower, upper)
        self._spread = ca.DM(ocp.state.size, len(places))
        for column, row in enumerate(places):
            self._spread[row, column] = 1
        unit = scales.rows
        states = np.arange(unit.size) >= nu
        rho = np.concatenate([np.full(nu, _NONE), scales.capacity])
        self.hard = _everywhere(np.concatenate([np.zeros(nu), scales.hard]), n)
        self.unit, self.reach, self.rho = (_everywhere(v, n) for v in (unit, unit**2 / scales.cost, rho))
        self.of_states = _everywhere(states.astype(float), n)
        self.sign = ca.DM(np.hstack([np.ones((unit.size, n)), -np.ones((unit.size, n))]))
        inputs = [ca.repmat(v, 1, n) for v in (lower, upper)]
        bounds = [ca.repmat(ca.DM(np.clip(v[places], -_NONE, _NONE)), 1, n) for v in (ocp.state_lower, ocp.state_upper)]
        at = ca.horzcat(*(ca.vertcat(u, s) for u, s in zip(inputs, bounds, strict=True)))
        self.present = ca.fabs(at) <= FINITE
        self._at = ca.if_else(self.present, at, 0)

    def entries(self, inputs: ca.MX, states: ca.MX) -> ca.MX:
        """Return the entries that can be limited, (rows, 2 N), from inputs (nu, N) and states (ns, N + 1)."""
        once = ca.vertcat(inputs, states[self.places, 1:]) if self.places else inputs
        return ca.horzcat(once, once)

    def inputs(self) -> tuple[ca.MX, ca.MX]:
        """Return lower and upper limits of the inputs, (nu,) each."""
        return self._inputs

    def on_states(self, rows: ca.MX) -> ca.MX:
        """Return the rows of limited states (rows, N) at their places among all states, (ns, N)."""
        return ca.mtimes(self._spread, rows[self._nu :, :])

    def distance(self, p: Expansion) -> ca.MX:
        """Return d; 1 where there is no limit."""
        return ca.if_else(self.present, self.sign * (self.entries(p.inputs, p.states) - self._at), 1)

    def outside(self, p: Expansion) -> ca.MX:
        """Return the largest violation of a hard limit, as a share of its unit."""
        return ca.fmax(ca.mmax(-self.distance(p) * self.hard / self.unit), 0)

    def both(self, values: ca.MX) -> ca.MX:
        """Return the sum of the lower and the upper side, (rows, N), where there is a limit."""
        present_values = ca.if_else(self.present, values, 0)
        return present_values[:, : self._n] + present_values[:, self._n :]

    def pushes(self, z: ca.MX, counted: ca.MX | float) -> ca.MX:
        """Return the multipliers of states as they enter the gradient, (rows, N), where `counted`."""
        return self.both(-self.sign * self.of_states * counted * ca.fmin(ca.fmax(z, 0), self.rho))

    def pure(self, p: Expansion, z: ca.MX, slope: ca.MX, gap: ca.MX) -> tuple[ca.MX, ...]:
        """Return (weights, gradients, multipliers) of the active limits.

        Limits with gamma z > d are equalities with the weight kappa = 1e8 / gamma, and the others are left out: gradient
        -sign (z - kappa d), afterwards z <- z - kappa (sign dw + d). Source: M. Hintermueller, K. Ito, K. Kunisch, SIAM J. Optim.
        13(3), 2002, for the sign rule.
        """
        d = self.distance(p)
        slopes = self.entries(slope, ca.MX.zeros(p.states.shape))
        held = ca.logic_and(ca.logic_and(self.of_states == 0, gap < _CLOSED), ca.logic_and(z == 0, d == 0))
        # The cost holds an input on its limit where the gradient is a multiplier of it.
        z = ca.if_else(held, ca.fmax(self.sign * slopes, 0), z)
        capped, active = self._chosen(d, z)
        weight = ca.if_else(active, STIFF / self.reach, 0)
        lean = -self.sign * (ca.if_else(capped, self.rho, 0) + ca.if_else(active, z, 0) - weight * d)
        return self.both(weight), self.both(lean), z

    def pure_multipliers(self, p: Expansion, z: ca.MX, du: ca.MX, dx: ca.MX) -> ca.MX:
        """Return the multipliers after a pure step."""
        d = self.distance(p)
        capped, active = self._chosen(d, z)
        next_z = z - STIFF / self.reach * (self.sign * self.entries(du, dx) + d)
        return ca.if_else(capped, self.rho, ca.if_else(active, ca.fmin(next_z, self.rho), 0))

    def _chosen(self, d: ca.MX, z: ca.MX) -> tuple[ca.MX, ca.MX]:
        capped = ca.logic_and(z >= ENOUGH * self.rho, d < 0)
        active = ca.logic_and(ca.logic_and(self.reach * z > d, ca.logic_not(capped)), self.present)
        return ca.logic_and(capped, self.present), active

    def inside(self, p: Expansion, z: ca.MX, mu: ca.MX, warm: ca.MX) -> Interior:
        """Return the point of the central path next to (d, z), or one made from the distances alone."""
        d = self.distance(p)
        m = d - self.reach * z
        root = ca.sqrt(m * m + 4 * self.reach * mu)
        t = ca.if_else(m > 0, 0.5 * (m + root), 2 * self.reach * mu / (root - m))
        t = ca.if_else(warm, t, ca.fmax(d, 0.1 * self.unit))
        z = mu / t
        e = ca.fmax(mu / (self.rho - ca.fmin(z, 0.5 * self.rho)), ca.if_else(z > 0.5 * self.rho, -d, 0))
        held = ca.fmax(ca.fmin(z, self.rho - mu / e), 0.5 * ca.fmin(z, self.rho))
        none = ca.logic_not(self.present)
        e = ca.if_else(self.of_states, e, 0)
        t, z = ca.if_else(none, 1, t), ca.if_else(none, 0, ca.if_else(self.of_states, held, z))
        return Interior(t, ca.if_else(none, 0, e), z)

    def priced(self, p: Expansion) -> ca.MX:
        """Return the cost of a plan with the price of its violations."""
        counted = ca.logic_and(self.present, self.of_states)
        return p.value + ca.sum1(ca.vec(ca.if_else(counted, self.rho * ca.fmax(-self.distance(p), 0), 0)))

    def path(self, p: Expansion, mu: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Return slacks and elastics that belong to the distances: t - e = d and mu / t + mu / e = rho."""
        d = self.distance(p)
        reached = self.rho * ca.fabs(d) + ca.sqrt((self.rho * d) ** 2 + 4 * mu * mu)
        least = mu / self.rho + 2 * mu * mu / (self.rho * reached)
        most = mu / self.rho + 0.5 * reached / self.rho
        t, e = (ca.if_else(d > 0, *pair) for pair in ((most, least), (least, most)))
        t = ca.if_else(self.of_states, t, ca.fmax(d, 0.1 * HAIR * self.unit))
        return ca.if_else(self.present, t, 1), ca.if_else(ca.logic_and(self.present, self.of_states), e, 0)

    def interior(self, p: Expansion, y: Interior, mu: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Return (weights, gradients) of the barrier: w - limit - t + e = 0, t z = mu, e (rho - z) = mu.

        The weight is kappa = 1 / (t / z + e / (rho - z)), the gradient -sign (z - kappa b) with b = d - mu / z + mu / (rho - z).
        """
        kappa, pull = self._linear(p, y, mu)
        return self.both(kappa), self.both(-self.sign * (y.z - kappa * pull))

    def _linear(self, p: Expansion, y: Interior, mu: ca.MX) -> tuple[ca.MX, ca.MX]:
        z = ca.if_else(self.present, y.z, 1)
        give, back = (ca.if_else(self.of_states, v / (self.rho - z), 0) for v in (y.e, mu))
        return 1 / (y.t / z + give), self.distance(p) - mu / z + back

    def moves(self, p: Expansion, y: Interior, mu: ca.MX, du: ca.MX, dx: ca.MX) -> Interior:
        """Return the moves of slacks, elastics and multipliers."""
        kappa, pull = self._linear(p, y, mu)
        z = ca.if_else(self.present, y.z, 1)
        dz = -kappa * (self.sign * self.entries(du, dx) + pull)
        dt = (mu - z * y.t - y.t * dz) / z
        de = ca.if_else(self.of_states, (mu - (self.rho - z) * y.e + y.e * dz) / (self.rho - z), 0)
        return Interior(*(ca.if_else(self.present, v, 0) for v in (dt, de, dz)))

    def shares(self, y: Interior, by: Interior, tau: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Return the largest shares of the moves that keep slacks and multipliers positive."""
        primal = ca.fmin(_share(y.t, by.t, tau), _share(y.e, by.e, tau))
        above = ca.if_else(self.of_states, _shares(self.rho - y.z, -by.z, tau), 1)
        return primal, ca.fmin(_share(y.z, by.z, tau), ca.mmin(above))


def _share(value: ca.MX, move: ca.MX, tau: ca.MX) -> ca.MX:
    return ca.mmin(_shares(value, move, tau))


def _shares(value: ca.MX, move: ca.MX, tau: ca.MX) -> ca.MX:
    falls = move < 0
    return ca.if_else(falls, ca.fmin(-tau * value / ca.if_else(falls, move, -1), 1), 1)


def _everywhere(column: np.ndarray, stages: int) -> ca.DM:
    return ca.repmat(ca.DM(column), 1, 2 * stages)


class Certified(NamedTuple):
    """How far a plan is from the first-order conditions."""

    slope: ca.MX  # g (nu, N)
    left: ca.MX  # stationarity
    violation: ca.MX
    broken: ca.MX  # violation of limits that are not given up, as a share of their unit
    error: ca.MX  # E


def certified(ocp: OptimalControl, limits: Limited, scales: Scales, p: Expansion, z: ca.MX) -> Certified:
    """Return how far an expanded plan with multipliers z (rows, 2 N) is from the first-order conditions.

        E = max( |U - clip(U - gamma g)| / unit,  |gap| / unit,  |min(d, gamma z)| / unit,  gamma max(-z, 0) / unit )

    with g the reduced gradient with the multipliers of limited states. A limit that is given up (z = rho) need not be kept: its
    plan is a stationary point of the cost plus rho times the violations, so the limits cannot all be kept nearby.
    """
    n = ocp.stages
    slope = certify(ocp, limits, p, z)
    units = [
        ca.repmat(ca.DM(v), 1, n) for v in (scales.inputs, scales.inputs**2 / scales.cost, ocp.step * ocp.curvature)
    ]
    low, high = limits.inputs()
    step = ca.fabs(p.inputs - clip(p.inputs - units[1] * slope, low, high)) / units[0]
    left = ca.norm_inf(ca.vec(p.inputs - clip(p.inputs - slope / units[2], low, high)))
    d = limits.distance(p)
    counted = ca.logic_and(limits.present, limits.of_states)
    given_up = z >= ENOUGH * limits.rho
    complementarity = ca.fabs(ca.fmin(d, limits.reach * ca.fmin(ca.fmax(z, 0), limits.rho)))
    error = ca.if_else(given_up, ca.fmax(d, 0), complementarity)
    error = ca.if_else(counted, ca.fmax(error, limits.reach * ca.fmax(-z, 0)) / limits.unit, 0)
    beyond = ca.if_else(counted, ca.fmax(-d, 0), 0)
    broken = ca.if_else(given_up, 0, beyond / limits.unit)
    worst = ca.fmax(ca.fmax(ca.mmax(step), largest_gap(p, scales)), ca.mmax(error))
    finite = is_finite(ca.vec(slope))
    numbers = [ca.if_else(finite, v, 10 * FINITE) for v in (left, worst)]
    return Certified(slope, numbers[0], ca.mmax(beyond * limits.hard), ca.mmax(broken), numbers[1])


def certify(ocp: OptimalControl, limits: Limited, p: Expansion, z: ca.MX, counted: ca.MX | float = 1) -> ca.MX:
    """Return the reduced gradient g (nu, N) with the multipliers of states that are `counted`."""
    return _adjoint(ocp, limits, p, limits.pushes(z, counted))


def _adjoint(ocp: OptimalControl, limits: Limited, p: Expansion, push: ca.MX) -> ca.MX:
    """Return g (nu, N) by one backward sweep; `push` (rows, N) are gradients with respect to the limited entries."""
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    shapes = ((ns, 1), (ns, ns), (ns, nu), (ns, 1), (nu, 1), (ns, 1))
    costate, a, b, by_state, by_input, more = y = [ca.SX.sym(f"y{k}", *shape) for k, shape in enumerate(shapes)]
    after = costate + more
    stage = ca.Function("fpirhc_certified_stage", y, [by_state + a.T @ after, by_input + b.T @ after])
    pushed = limits.on_states(push)
    turned = [in_reverse(v, n) for v in (p.a, p.b, p.by_state, p.by_input, pushed)]
    return in_reverse(stage.mapaccum("fpirhc_certified_stages", n)(p.tail, *turned)[1], n)


def cannot_be_kept(ocp: OptimalControl, limits: Limited, p: Expansion, z: ca.MX, sure: float) -> ca.MX:
    """Return whether multipliers prove that no inputs within their limits keep the hard limits of states, near this plan.

    Along the model linearised at p the violations are linear in the inputs, and so is

        sum z (violation) = sum -z d + sum lambda' gap + sum g' (u - U),   lambda = A' (lambda + push),   g = B' (lambda + push)

    Where it is above zero even at its least in the box of the inputs, not all violations can be zero (Farkas' lemma). For a linear
    model this is a proof; for others it holds where the linearisation does. Without a limit of an input nothing is proven.

    Args:
        sure: share of its summands by which the sum must be above zero.
    """
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    counted = ca.logic_and(ca.logic_and(limits.present, limits.of_states), limits.hard)
    y = ca.if_else(counted, ca.fmin(ca.fmax(z, 0), limits.rho), 0)
    violated = -y * limits.distance(p)
    shapes = ((ns, 1), (ns, ns), (ns, nu), (ns, 1), (ns, 1))
    costate, a, b, more, gap = given = [ca.SX.sym(f"c{k}", *shape) for k, shape in enumerate(shapes)]
    after = costate + more
    apart, parts = after * gap, b * ca.repmat(after, 1, nu)
    made = [
        a.T @ after,
        ca.sum1(parts).T,
        ca.sum1(ca.fabs(parts)).T,
        ca.vertcat(ca.sum1(apart), ca.sum1(ca.fabs(apart))),
    ]
    stage = ca.Function("fpirhc_farkas_stage", given, made)
    gaps, pushed = p.next_states - p.states[:, 1:], limits.on_states(limits.both(-limits.sign * y))
    turned = [in_reverse(v, n) for v in (p.a, p.b, pushed, gaps)]
    _, slope, steep, jumps = stage.mapaccum("fpirhc_farkas_stages", n)(ca.MX.zeros(ns), *turned)
    slope, steep = in_reverse(slope, n), in_reverse(steep, n)
    low, high = (ca.repmat(v, 1, n) for v in limits.inputs())
    least = slope * (ca.if_else(slope > 0, low, high) - p.inputs)
    total = ca.sum1(ca.vec(violated)) + ca.sum1(ca.vec(least)) + ca.sum2(jumps[0, :])
    size = ca.sum1(ca.vec(ca.fabs(violated))) + ca.sum1(ca.vec(steep * (high - low))) + ca.sum2(jumps[1, :])
    return ca.logic_and(size <= FINITE, total > sure * size)


def largest_gap(p: Expansion, scales: Scales) -> ca.MX:
    """Return the largest |F(X, U) - X+| in units of the states."""
    gaps = ca.fabs(p.next_states - p.states[:, 1:])
    return ca.mmax(gaps / ca.repmat(ca.DM(scales.states), 1, gaps.shape[1]))


def barrier_error(
    limits: Limited, scales: Scales, p: Expansion, y: Interior, costates: ca.MX
) -> tuple[ca.MX, ca.MX, ca.MX]:
    """Return the scaled residual of the barrier problem without complementarity, and the least and largest of its products."""
    n = p.inputs.shape[1]
    states, z = ca.logic_and(limits.present, limits.of_states), y.z
    push = limits.both(-limits.sign * z)
    apart = ca.if_else(limits.present, ca.fabs(limits.distance(p) - y.t + y.e) / limits.unit, 0)
    pairs = [(limits.present, y.t * z), (states, y.e * (limits.rho - z))]
    least = ca.fmin(*(ca.mmin(ca.if_else(c, v, 10 * FINITE)) for c, v in pairs))
    most = ca.fmax(*(ca.mmax(ca.if_else(c, v, 0)) for c, v in pairs))
    nu, ns = p.inputs.shape[0], p.next_states.shape[0]
    rest_u = p.by_input + push[:nu, :] + _stage_product(p.b, costates, nu, ns, n)
    before = ca.horzcat(p.by_state[:, 1:] + _stage_product(p.a, costates, ns, ns, n)[:, 1:], p.tail)
    rest_x = before - costates + limits.on_states(push)
    units = [ca.repmat(ca.DM(v), 1, n) / scales.cost for v in (scales.inputs, scales.states)]
    worst = [ca.mmax(ca.fabs(r) * u) for r, u in zip((rest_u, rest_x), units, strict=True)]
    total = ca.fmax(ca.fmax(*worst), ca.fmax(largest_gap(p, scales), ca.mmax(apart)))
    return total, least, most


def _stage_product(stacked: ca.MX, costates: ca.MX, columns: int, rows: int, n: int) -> ca.MX:
    """A_i' lambda_{i+1} for every stage, (columns, N)."""
    a, costate = ca.SX.sym("a", rows, columns), ca.SX.sym("l", rows)
    return ca.Function("fpirhc_stage_product", [a, costate], [a.T @ costate]).map(n)(stacked, costates)
