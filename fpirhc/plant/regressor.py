"""The parameter regressor of a fully actuated plant: its inverse dynamics as a product with unknown parameters.

    Q = Y(q, q', q'') theta + Q0(q, q', q''),     M = dQ/dq'',     C = (M' + E - E^T) / 2,  E = d(M q')/dq,

Theory: docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidName, InvalidValue, NotSupported, nearest
from fpirhc.fields.checked import Checked
from fpirhc.plant.motion import places
from fpirhc.plant.plant import Parameter, Plant
from fpirhc.symbolic.layout import Expression, Named, Signal, vector

_TRIES = 12  # random points
_TOLERANCE = 1e-7  # relative error at which an identity holds
_SPREAD = 0.3  # relative range of random parameters


@dataclass(frozen=True, eq=False)
class Combination(Checked):
    """An expression of parameters that enters linearly as a whole: Combination(lambda p: p.m * p.l**2, "kg m^2").

    Args:
        expression: function of the plant's parameters by name.
        unit: of the expression.
    """

    expression: Callable[[Named], Expression]
    unit: str


@dataclass(frozen=True, eq=False)
class Regressor:
    """Q = Y theta + Q0 of a plant for the parameters theta.

    Args:
        plant: as many inputs as coordinates, all of them controlled, with an inverse response made of symbols.
        names: names of theta, each a parameter of the plant or a key of `combinations`. All other parameters keep the model's
            approximate values.
        combinations: expressions of parameters that enter linearly as a whole.

    Raises:
        NotSupported: the plant is not fully actuated, or its inverse response needs a root finder.
        InvalidName: a name that is neither a parameter nor a combination.
        InvalidValue: the inverse dynamics is not linear in theta; the message names the parameters and a remedy.
    """

    plant: Plant
    names: Sequence[str]
    combinations: Mapping[str, Combination] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_plant(self.plant)
        valid = [*self.plant.parameters, *self.combinations]
        for name in self.names:
            if name not in valid:
                raise InvalidName(
                    f"Regressor: '{name}' is neither a parameter nor a combination.{nearest(name, valid)}"
                )
        if not self.names or len(set(self.names)) < len(self.names):
            raise InvalidValue(f"Regressor(names={tuple(self.names)}): expected different names, at least one")
        _check_linear(self)

    @cached_property
    def signal(self) -> Signal:
        """The signal of theta, named 'estimate'."""
        return vector("estimate", tuple(self.names), tuple(p.unit for p in self._own.values()))

    @cached_property
    def theta_function(self) -> ca.Function:
        """Function (plant's parameters) -> theta (m)."""
        p = ca.SX.sym("p", len(self.plant.parameters))
        named = Named(tuple(self.plant.parameters), p, "parameter")
        entries = [self.combinations[n].expression(named) if n in self.combinations else named[n] for n in self.names]
        return ca.Function("fpirhc_theta", [p], [ca.densify(ca.vertcat(*(ca.SX(e) for e in entries)))])

    @cached_property
    def covered(self) -> tuple[int, ...]:
        """Places of the plant's parameters on which theta depends."""
        _, _, p = self.plant.symbols()
        pattern = ca.DM(ca.jacobian_sparsity(self.theta_function(p), p), 1).full()
        return tuple(int(k) for k in np.flatnonzero(pattern.any(axis=0)))

    @cached_property
    def function(self) -> ca.Function:
        """Function (state, response, plant's parameters) -> (Y (n x m), Q0 (n)); covered parameters are not read."""
        x, r, p = self.symbols()
        inverse, points = self.plant.equations.inverse, self._points
        slope = ca.Function("fpirhc_slope", [x, r, p], [ca.jacobian(inverse(x, r, p), p)])
        slopes = [slope(x, r, self._placed(p, point))[:, list(self.covered)] for point in points]
        y = ca.mtimes(ca.horzcat(*slopes), ca.DM(np.linalg.pinv(self._slopes(points))))
        first = self._placed(p, points[0])
        rest = inverse(x, r, first) - ca.mtimes(y, self.theta_function(first))
        return ca.Function("fpirhc_regressor", [x, r, p], ca.cse([ca.densify(y), ca.densify(rest)]))

    @cached_property
    def force_function(self) -> ca.Function:
        """Function (state, response, theta, plant's parameters) -> Y theta + Q0."""
        x, r, p = self.symbols()
        theta = ca.SX.sym("theta", len(self.names))
        y, rest = self.function(x, r, p)
        return ca.Function("fpirhc_force", [x, r, theta, p], [ca.mtimes(y, theta) + rest])

    @cached_property
    def mass_function(self) -> ca.Function:
        """Function (state, theta, plant's parameters) -> M (n x n)."""
        x, r, p = self.symbols()
        theta = ca.SX.sym("theta", len(self.names))
        mass = ca.jacobian(self.force_function(x, r, theta, p), r)
        mass = ca.substitute(mass, r, ca.SX.zeros(r.numel()))
        return ca.Function("fpirhc_mass", [x, theta, p], [ca.cse(ca.densify(mass))])

    @cached_property
    def coriolis_function(self) -> ca.Function:
        """Function (state, theta, plant's parameters) -> C (n x n) with M' - 2 C skew-symmetric."""
        x, _, p = self.symbols()
        theta = ca.SX.sym("theta", len(self.names))
        mass = self.mass_function(x, theta, p)
        q, v = x[places(self.plant, 0)], x[places(self.plant, 1)]
        change = ca.jtimes(ca.reshape(mass, -1, 1), q, v).reshape(mass.shape)
        # M does not depend on q', so v is a constant in this derivative.
        slope = ca.jacobian(ca.mtimes(mass, v), q)
        return ca.Function("fpirhc_coriolis", [x, theta, p], [ca.cse(ca.densify((change + slope - slope.T) / 2))])

    @cached_property
    def split_function(self) -> ca.Function:
        """Function (state, v, v', plant's parameters) -> (Y_s (n x m), Q0_s (n)), v a second velocity."""
        x, v, p = self.symbols()
        slope, theta = ca.SX.sym("slope", v.numel()), ca.SX.sym("theta", len(self.names))
        # M v' + C v + Q(q, q', 0) - C q' is affine in theta as Q is.
        force = self.force_function(x, slope, theta, p)
        force += ca.mtimes(self.coriolis_function(x, theta, p), v - x[places(self.plant, 1)])
        y = ca.jacobian(force, theta)
        rest = ca.substitute(force, theta, ca.SX.zeros(theta.numel()))
        return ca.Function("fpirhc_split", [x, v, slope, p], ca.cse([ca.densify(y), ca.densify(rest)]))

    @cached_property
    def believed(self) -> Plant:
        """The plant whose parameters are theta and those that theta does not cover."""
        return _with_theta(self)

    @cached_property
    def _own(self) -> dict[str, Parameter]:
        approximate = self.theta_function(self.plant.approximate).full().ravel()
        exact = self.theta_function(self.plant.exact).full().ravel()
        units = [
            self.combinations[n].unit if n in self.combinations else self.plant.parameters[n].unit for n in self.names
        ]
        values = zip(self.names, approximate, exact, units, strict=True)
        return {n: Parameter(float(believed), float(true), unit) for n, believed, true, unit in values}

    @cached_property
    def _points(self) -> list[np.ndarray]:
        """Parameters at which the dtheta/dp, side by side, have full rank: one point where every theta is a parameter."""
        random, points = np.random.default_rng(0), [self.plant.approximate]
        while np.linalg.matrix_rank(self._slopes(points)) < len(self.names):
            if len(points) > len(self.names):
                raise InvalidValue(
                    f"Regressor(names={tuple(self.names)}): the combinations depend on each other (one is a sum of multiples "
                    "of others), so no data can distinguish them; leave one out"
                )
            points.append(_varied(self.plant, random))
        return points

    def _slopes(self, points: list[np.ndarray]) -> np.ndarray:
        _, _, p = self.plant.symbols()
        slope = ca.Function("fpirhc_theta_slope", [p], [ca.jacobian(self.theta_function(p), p)])
        return np.hstack([slope(point).full()[:, list(self.covered)] for point in points])

    def _placed(self, p: Expression, point: np.ndarray) -> Expression:
        return ca.vertcat(*(point[k] if k in self.covered else p[k] for k in range(p.numel())))

    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Return new symbols of the state, the response and the plant's parameters."""
        x, _, p = self.plant.symbols()
        return x, ca.SX.sym("r", len(self.plant.names)), p


def _with_theta(regressor: Regressor) -> Plant:
    """The plant whose parameters are theta and those that theta does not cover."""
    plant, covered, size = regressor.plant, regressor.covered, len(regressor.names)
    every = list(plant.parameters)
    others = {n: parameter for k, (n, parameter) in enumerate(plant.parameters.items()) if k not in covered}

    def split(p: Named) -> tuple[Expression, Expression]:
        known = ca.vertcat(*(p[n] if n in others else plant.approximate[every.index(n)] for n in every))
        return p.vector[:size], known

    def response(q: Named, v: Named, u: Named, p: Named) -> dict[str, Expression]:
        theta, known = split(p)
        x, still = ca.vertcat(q.vector, v.vector), ca.SX.zeros(len(plant.names))
        free = regressor.force_function(x, still, theta, known)
        accelerations = ca.solve(regressor.mass_function(x, theta, known), u.vector - free)
        return dict(zip(plant.names, ca.vertsplit(accelerations), strict=True))

    def inverse(q: Named, v: Named, r: Named, p: Named) -> dict[str, Expression]:
        theta, known = split(p)
        forces = regressor.force_function(ca.vertcat(q.vector, v.vector), r.vector, theta, known)
        return dict(zip(plant.inputs, ca.vertsplit(forces), strict=True))

    return Plant(
        plant.coordinates,
        plant.inputs,
        {**regressor._own, **others},
        response,
        inverse=inverse,
        time_unit=plant.time_unit,
    )


def _check_plant(plant: Plant) -> None:
    if len(plant.inputs) != len(plant.names) or plant.controlled_names != plant.names:
        why = (
            f"a fully actuated plant: {len(plant.names)} coordinates but {len(plant.inputs)} input(s), "
            f"controlled: {', '.join(plant.controlled_names)}; use ComputedTorque, whose model needs no regressor"
        )
    elif plant.equations.inverse_opaque:
        why = (
            "an inverse response made of symbols, and this one needs a root finder; "
            "give Plant(inverse=...) that solves the response for the inputs"
        )
    else:
        return
    raise NotSupported(f"a regressor needs {why}")


def _check_linear(regressor: Regressor) -> None:
    """Compare Y theta + Q0 with the inverse dynamics at random points with other values of the covered parameters."""
    plant, random = regressor.plant, np.random.default_rng(1)
    worst, entering, tried = 0.0, np.zeros(len(regressor.names), dtype=bool), 0
    for _ in range(_TRIES):
        x, r, p = _point(plant, random)
        wanted = plant.equations.inverse(x, r, p).full()
        y, rest = (m.full() for m in regressor.function(x, r, p))
        terms = y * regressor.theta_function(p).full().T
        error = terms.sum(axis=1, keepdims=True) + rest - wanted
        if np.isfinite(error).all():
            tried += 1
            # Each force by the size of its own terms: forces have units of their own.
            sizes = np.maximum(np.abs(terms).sum(axis=1, keepdims=True) + np.abs(rest) + np.abs(wanted), 1e-300)
            worst = max(worst, float((np.abs(error) / sizes).max()))
            entering |= (np.abs(terms) > _TOLERANCE * sizes).any(axis=0)
    if not tried:
        raise InvalidValue("Regressor: the inverse dynamics is not finite at any random state; give Plant(inverse=...)")
    if worst > _TOLERANCE:
        raise InvalidValue(_not_linear(regressor, worst))
    if not entering.all():
        absent = [n for n, e in zip(regressor.names, entering, strict=True) if not e]
        raise InvalidValue(
            f"Regressor: '{absent[0]}' does not enter the inverse dynamics, so nothing can be learned about it"
        )


def _not_linear(regressor: Regressor, worst: float) -> str:
    every = list(regressor.plant.parameters)
    alone = ", ".join(f"'{every[k]}'" for k in regressor.covered if _bends(regressor.plant, k))
    reason = (
        f"{alone} enter(s) nonlinearly" if alone else "they enter in products, or the combinations leave something out"
    )
    return (
        f"the inverse dynamics is not linear in {', '.join(regressor.names)} (relative error {worst:.1e}): {reason}. Learn others, "
        "which leaves these at the model's values, or name what enters as a whole, as in "
        "combinations={'inertia': Combination(lambda p: p.m * p.l**2, 'kg m^2')}"
    )


def _bends(plant: Plant, k: int) -> bool:
    """Whether the inverse dynamics has a second difference by a parameter, at random points."""
    random = np.random.default_rng(2)
    for _ in range(_TRIES):
        x, r, p = _point(plant, random)
        change = _SPREAD * p[k] * np.eye(p.size)[k]
        low, middle, high = (plant.equations.inverse(x, r, q).full() for q in (p - change, p, p + change))
        if (np.abs(high - 2 * middle + low) > _TOLERANCE * (np.abs(high) + np.abs(middle) + np.abs(low))).any():
            return True
    return False


def _point(plant: Plant, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A random (state, response, parameters)."""
    state = random.standard_normal(plant.state.size)
    return state, 10 * random.standard_normal(len(plant.names)), _varied(plant, random)


def _varied(plant: Plant, random: np.random.Generator) -> np.ndarray:
    sizes = np.maximum(np.abs(plant.approximate), np.abs(plant.exact))
    sizes[sizes == 0] = 1.0
    return np.asarray(plant.approximate + _SPREAD * sizes * random.uniform(-1, 1, size=sizes.size))
