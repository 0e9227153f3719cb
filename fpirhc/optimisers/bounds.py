"""Limits of a plan: their distances, and what they add to a sweep as equalities (pure) or by a barrier (interior).

Entry r of stage i is input r, or a limited state one stage later. Matrices of limits have the shape (rows, 2 N): lower limits of
all stages, then upper ones. With sign 1 for lower, -1 for upper ones, d = sign (w - limit) is a distance, and a multiplier z >= 0
adds -sign z to the gradient. A multiplier of a state is at most rho: beyond it the limit gives way (exact L1 penalty).

pure        the limits with gamma z > d are equalities with the weight kappa = 1e8 / gamma, and the others are left out:
            gradient -sign (z - kappa d), and afterwards z <- z - kappa (sign dw + d).
interior    w - limit - t + e = 0, t z = mu, e (rho - z) = mu: weight kappa = 1 / (t / z + e / (rho - z)) and gradient
            -sign (z - kappa b) with b = d - mu / z + mu / (rho - z).

References: S. J. Wright, Primal-Dual Interior-Point Methods, SIAM 1997; M. Hintermueller, K. Ito, K. Kunisch, SIAM J. Optim. 13(3),
2002, for the sign rule.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.sweep import Expansion
from fpirhc.optimisers.scales import Scales
from fpirhc.symbolic.expression import FINITE

ENOUGH = 0.99  # share of the largest multiplier from which a limit counts as given up
STIFF = 1e8  # weight of an equality, in units of 1 / gamma
BOUNDARY = 0.99  # largest share of the distance to the boundary in one step
CLOSED = 1e-6  # scaled gap below which a plan counts as a trajectory
HAIR = 1e-8  # of the unit: how far inside the limits of inputs descents stay
_NONE = 10 * FINITE


class Interior(NamedTuple):
    """Slacks t, elastics e and multipliers z (rows, 2 N), or their moves."""

    t: ca.MX
    e: ca.MX
    z: ca.MX


class Limited:
    """The limits of one call.

    Args:
        ocp: the problem.
        scales: its units.
        lower: lower limits of the inputs, shape (nu,).
        upper: upper limits of the inputs, shape (nu,).
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
        """Return (weights, gradients, multipliers) of the active limits."""
        d = self.distance(p)
        slopes = self.entries(slope, ca.MX.zeros(p.states.shape))
        held = ca.logic_and(ca.logic_and(self.of_states == 0, gap < CLOSED), ca.logic_and(z == 0, d == 0))
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
        """Return (weights, gradients) of the barrier."""
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
