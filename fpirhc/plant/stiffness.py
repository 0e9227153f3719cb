"""Whether an integrator with fixed steps can follow a plant at a point: no mode of it that decays may grow in a cycle."""

from __future__ import annotations

import math
from functools import lru_cache

import casadi as ca
import numpy as np

from fpirhc.plant.integrators import Integrator
from fpirhc.plant.plant import Plant

_MOST = 1000  # sub-steps, beyond which another method is better
_INSIDE = 2.0  # |pole| times sub-step at which Runge-Kutta 4 is stable for all decaying modes, with some room


def stiffness(
    plant: Plant, integrator: Integrator, period: float, state: np.ndarray, command: np.ndarray, parameters: np.ndarray
) -> str:
    """Return a sentence that names the pole that the integrator makes grow, and what would do; empty where all is well.

    Args:
        plant: the plant.
        integrator: of its motion.
        period: control cycle, in the plant's unit of time.
        state: shape (nx,).
        command: shape (nu,).
        parameters: shape (np,).
    """
    modes = poles(plant, state, command, parameters)
    if not np.isfinite(modes).all():
        return ""
    growth = _spurious(integrator, period, modes)
    wrong = growth > 1 + 1e-9
    if not wrong.any():
        return ""
    fastest = modes[wrong][int(np.argmax(np.abs(modes[wrong])))]
    substeps = math.ceil(float(np.abs(modes).max()) * period / _INSIDE)
    few = substeps <= _MOST
    remedy = f"RungeKutta4(substeps={substeps})" if few else "Cvodes()"
    needed = "" if few else f"; RungeKutta4 would need {substeps} sub-steps"
    rate = f"1/{plant.time_unit}"
    return (
        f"a mode decays with the pole {_text(fastest)} {rate}, which times the period of {period:g} {plant.time_unit} is "
        f"{abs(fastest) * period:.3g}, and {integrator!r} makes it grow by {float(growth[wrong].max()):.3g} per cycle{needed}; use "
        f"integrator={remedy}"
    )


def spurious_growth(
    plant: Plant, integrator: Integrator, period: float, states: np.ndarray, commands: np.ndarray
) -> np.ndarray:
    """Return the largest factor by which steps along a trajectory make a mode of the model grow that decays, shape (N,); 1: none.

    Args:
        plant: the model.
        integrator: of its motion.
        period: of a step, in the plant's unit of time.
        states: shape (nx, N).
        commands: shape (nu, N).
    """
    if plant.step is not None:
        return np.ones(commands.shape[1])
    points = zip(states.T, commands.T, strict=True)
    modes = [poles(plant, state, command, plant.approximate) for state, command in points]
    return np.array([_spurious(integrator, period, m).max(initial=1.0) if np.isfinite(m).all() else 1.0 for m in modes])


def _spurious(integrator: Integrator, period: float, modes: np.ndarray) -> np.ndarray:
    """Factor by which a step makes each decaying mode grow; 1 for the others."""
    growth = integrator.growth(modes * period)
    if growth is None:
        return np.ones(len(modes))
    return np.where(modes.real <= 1e-9 * np.abs(modes), np.maximum(growth, 1.0), 1.0)


def poles(plant: Plant, state: np.ndarray, command: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Return the eigenvalues of dx'/dx at a point, per unit of time, shape (nx,); not finite where the slope is not."""
    slope = np.asarray(_slope_of(plant)(state, command, parameters).full())
    return np.linalg.eigvals(slope) if np.isfinite(slope).all() else np.full(len(slope), np.nan + 0j)


@lru_cache(maxsize=8)
def _slope_of(plant: Plant) -> ca.Function:
    x, u, p = plant.symbols()
    return ca.Function("fpirhc_slope", [x, u, p], [ca.densify(ca.jacobian(plant.equations.rate(x, u, p), x))])


def _text(pole: complex) -> str:
    return f"{pole.real:.4g}" if abs(pole.imag) <= 1e-9 * abs(pole) else f"{pole.real:.4g} +- {abs(pole.imag):.4g}i"
