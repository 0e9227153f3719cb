"""Algebraic states: quantities that equations tie to the state at every instant, such as node voltages or contact forces.

    0 = g(x, z, u, p),        dg/dz regular (index 1)

They are computed inside the response by a fixed number of Newton's steps from a stated guess,

    z <- z - (dg/dz)^-1 g(x, z, u, p),

so that the work per evaluation is fixed and nothing is remembered. Equations that are affine in z take one step, which is exact. A
last step that is not small leaves NaN, which ends a run by name: values that do not solve the equations are never used.

Reference: K. E. Brenan, S. L. Campbell, L. R. Petzold, Numerical Solution of Initial-Value Problems in DAEs, 1996, ch. 2.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import casadi as ca

from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Few
from fpirhc.fields.user_code import called, named_results, scalar_expression
from fpirhc.symbolic.expression import total
from fpirhc.symbolic.functions import nan_where
from fpirhc.symbolic.layout import Expression, Named

SMALL = 1e-6  # last step of Newton's method, relative; the error left is about its square


@dataclass(frozen=True, eq=False)
class Algebraic(Checked):
    """Algebraic states of a plant: `Plant(algebraic=Algebraic(units={"node": "V"}, ...))`.

    The response has their values by name as its last argument, after the parameters.

    Args:
        units: name -> unit of every algebraic state.
        equations: function of (q, q', ..., u, p, z) that returns {algebraic state: an expression that is to be zero}; which name
            an equation has does not matter.
        guess: from where Newton's method begins: numbers by name, or a function of (q, q', ..., u, p) that returns expressions.
        steps: of Newton's method, where the equations are not affine in z.
    """

    units: Mapping[str, str]
    equations: Callable[..., Mapping[str, Expression]]
    guess: Mapping[str, float] | Callable[..., Mapping[str, Expression]]
    steps: Few = 6

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the algebraic states."""
        return tuple(self.units)

    def view(self, z: Expression) -> Named:
        """Return values of the algebraic states by name."""
        return Named(self.names, z, "algebraic state")

    def residual(self, views: tuple[Named, ...], z: Expression) -> Expression:
        """Return g as a column."""
        values = named_results("algebraic", called("algebraic", self.equations, *views, self.view(z)))
        return ca.vertcat(*(ca.SX(scalar_expression(f"algebraic: equation '{n}'", values[n])) for n in self.names))

    def first(self, views: tuple[Named, ...]) -> Expression:
        """Return the guess as a column."""
        values = called("algebraic: guess", self.guess, *views) if callable(self.guess) else self.guess
        return ca.vertcat(*(ca.SX(scalar_expression(f"algebraic: guess of '{n}'", values[n])) for n in self.names))

    def solved(self, views: tuple[Named, ...], known: Expression) -> Expression:
        """Return z that solves the equations, as a column; NaN where Newton's method has not arrived.

        Args:
            views: of state, input and parameters.
            known: their symbols in one column.
        """
        z = ca.SX.sym("z", len(self.names))
        residual = self.residual(views, z)
        slope = ca.jacobian(residual, z)
        step_of = ca.Function("fpirhc_newton_step", [z, known], [ca.densify(ca.solve(slope, residual))])
        at = self.first(views)
        if not ca.depends_on(slope, z):
            return at - step_of(at, known)
        step: Expression = at
        for _ in range(self.steps):
            step = step_of(at, known)
            at = at - step
        left = total(ca.fabs(step[k]) > SMALL * (1 + ca.fabs(at[k])) for k in range(len(self.names)))
        # NaN is on neither side of a comparison, so arriving is asked for and not missing.
        return at + nan_where(ca.logic_not(left < 0.5))
