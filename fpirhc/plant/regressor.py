"""The parameter regressor of a fully actuated plant: its inverse dynamics as a product with unknown parameters.

    Q = Y(q, q', q'') theta + Q0(q, q', q''),     M = dQ/dq'',     C = (M' + E - E^T) / 2,  E = d(M q')/dq,

Theory: docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidName, InvalidValue, nearest, require
from fpirhc.plant.motion import places
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.expression import Expression
from fpirhc.symbolic.layout import Signal, vector

_TRIES = 12  # random points
_TOLERANCE = 1e-7  # share of a force that counts as nothing
_SPREAD = 0.3  # relative range of random parameters


@dataclass(frozen=True, eq=False)
class Regressor:
    """Q = Y theta + Q0 of a plant for the parameters theta."""

    plant: Plant  # as many inputs as coordinates, all of them controlled, with an inverse response made of symbols
    names: Sequence[str]  # parameters that are theta; all others keep the model's approximate values

    def __post_init__(self) -> None:
        plant = self.plant
        require(
            len(plant.inputs) == len(plant.names) and plant.controlled_names == plant.names,
            f"a regressor needs a fully actuated plant: {len(plant.names)} coordinates but {len(plant.inputs)} input(s), "
            f"controlled: {', '.join(plant.controlled_names)}; use ComputedTorque, whose model needs no regressor",
        )
        require(
            not plant.equations.inverse_opaque,
            "a regressor needs an inverse response made of symbols, and this one needs a root finder; "
            "give Plant(inverse=...) that solves the response for the inputs",
        )
        for name in self.names:
            if name not in self.plant.parameters:
                raise InvalidName(f"Regressor: '{name}' is no parameter.{nearest(name, self.plant.parameters)}")
        if not self.names or len(set(self.names)) < len(self.names):
            raise InvalidValue(f"Regressor(names={tuple(self.names)}): expected different names, at least one")
        _check_linear(self)

    @cached_property
    def signal(self) -> Signal:
        """The signal of theta, named 'estimate'."""
        return vector("estimate", tuple(self.names), tuple(self.plant.parameters[n].unit for n in self.names))

    @cached_property
    def places(self) -> list[int]:
        """Places of theta among the plant's parameters."""
        return [self.plant.parameter.elements.index(name) for name in self.names]

    def believed(self, theta: Expression, p: Expression) -> Expression:
        """Return the plant's parameters with theta in their places."""
        return ca.vertcat(
            *(theta[self.names.index(n)] if n in self.names else p[k] for k, n in enumerate(self.plant.parameters))
        )

    @cached_property
    def function(self) -> ca.Function:
        """Function (state, response, plant's parameters) -> (Y (n x m), Q0 (n)); theta among the parameters is not read."""
        x, r, p, _ = self.symbols()
        first, inverse = ca.DM(self.plant.approximate[self.places]), self.plant.equations.inverse
        slope = ca.Function("fpirhc_slope", [x, r, p], [ca.jacobian(inverse(x, r, p), p)[:, self.places]])
        at = self.believed(ca.SX(first), p)
        y = slope(x, r, at)
        rest = inverse(x, r, at) - ca.mtimes(y, first)
        return ca.Function("fpirhc_regressor", [x, r, p], ca.cse([ca.densify(y), ca.densify(rest)]))

    @cached_property
    def force_function(self) -> ca.Function:
        """Function (state, response, theta, plant's parameters) -> Y theta + Q0."""
        x, r, p, theta = self.symbols()
        y, rest = self.function(x, r, p)
        return ca.Function("fpirhc_force", [x, r, theta, p], [ca.mtimes(y, theta) + rest])

    @cached_property
    def mass_function(self) -> ca.Function:
        """Function (state, theta, plant's parameters) -> M (n x n)."""
        x, r, p, theta = self.symbols()
        mass = ca.jacobian(self.force_function(x, r, theta, p), r)
        mass = ca.substitute(mass, r, ca.SX.zeros(r.numel()))
        return ca.Function("fpirhc_mass", [x, theta, p], [ca.cse(ca.densify(mass))])

    @cached_property
    def coriolis_function(self) -> ca.Function:
        """Function (state, theta, plant's parameters) -> C (n x n) with M' - 2 C skew-symmetric."""
        x, _, p, theta = self.symbols()
        mass = self.mass_function(x, theta, p)
        q, v = x[places(self.plant, 0)], x[places(self.plant, 1)]
        change = ca.jtimes(ca.reshape(mass, -1, 1), q, v).reshape(mass.shape)
        # M does not depend on q', so v is a constant in this derivative.
        slope = ca.jacobian(ca.mtimes(mass, v), q)
        return ca.Function("fpirhc_coriolis", [x, theta, p], [ca.cse(ca.densify((change + slope - slope.T) / 2))])

    @cached_property
    def split_function(self) -> ca.Function:
        """Function (state, v, v', plant's parameters) -> (Y_s (n x m), Q0_s (n)), v a second velocity."""
        x, v, p, theta = self.symbols()
        slope = ca.SX.sym("slope", v.numel())
        # M v' + C v + Q(q, q', 0) - C q' is affine in theta as Q is.
        force = self.force_function(x, slope, theta, p)
        force += ca.mtimes(self.coriolis_function(x, theta, p), v - x[places(self.plant, 1)])
        y = ca.jacobian(force, theta)
        rest = ca.substitute(force, theta, ca.SX.zeros(theta.numel()))
        return ca.Function("fpirhc_split", [x, v, slope, p], ca.cse([ca.densify(y), ca.densify(rest)]))

    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """Return new symbols of the state, the response, the plant's parameters and theta."""
        x, _, p = self.plant.symbols()
        return x, ca.SX.sym("r", len(self.plant.names)), p, ca.SX.sym("theta", len(self.names))


def _check_linear(regressor: Regressor) -> None:
    """Look at random points for terms of the second order in the covered parameters, and for those that do not enter."""
    plant, (x, r, p, _), places = regressor.plant, regressor.symbols(), regressor.places
    force = plant.equations.inverse(x, r, p)
    slope = ca.jacobian(force, p)[:, places]
    function = ca.Function(
        "fpirhc_bend", [x, r, p], [force, slope, ca.jacobian(ca.vec(slope), p)[:, places]], {"cse": True}
    )
    random, count, tried = np.random.default_rng(1), len(places), 0
    bent, entering = np.zeros((count, count)), np.zeros(count, dtype=bool)
    for _ in range(_TRIES):
        point = _point(plant, random)
        theta = point[2][places]
        wanted, terms, second = (m.full() for m in function(*point))
        terms, second = terms * theta, second.reshape(count, -1, count) * theta[:, None, None] * theta
        if np.isfinite(terms).all() and np.isfinite(second).all():
            tried += 1
            # Each force by the size of its own terms: forces have units of their own.
            sizes = np.maximum(np.abs(terms).sum(axis=1, keepdims=True) + np.abs(wanted), 1e-300)
            bent = np.maximum(bent, np.abs(second / sizes).max(axis=1))
            entering |= (np.abs(terms) > _TOLERANCE * sizes).any(axis=0)
    if not tried:
        raise InvalidValue("Regressor: the inverse dynamics is not finite at any random state; give Plant(inverse=...)")
    if bent.max() > _TOLERANCE:
        alone = ", ".join(
            f"'{name}'" for name, own in zip(regressor.names, np.diag(bent), strict=True) if own > _TOLERANCE
        )
        reason = f"{alone} enter(s) nonlinearly" if alone else "they enter in products"
        raise InvalidValue(
            f"the inverse dynamics is not linear in {', '.join(regressor.names)}: {reason}. Learn others, which leaves these at "
            "the model's values, or write the plant with what enters as a whole as one parameter, such as the inertia m l^2"
        )
    if not entering.all():
        absent = regressor.names[int(np.argmin(entering))]
        raise InvalidValue(f"Regressor: '{absent}' does not enter the inverse dynamics, so nothing is learned about it")


def _point(plant: Plant, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A random (state, response, parameters)."""
    state = random.standard_normal(plant.state.size)
    response, sizes = (
        10 * random.standard_normal(len(plant.names)),
        np.maximum(abs(plant.approximate), abs(plant.exact)),
    )
    sizes[sizes == 0] = 1.0
    return state, response, plant.approximate + _SPREAD * sizes * random.uniform(-1, 1, size=sizes.size)
