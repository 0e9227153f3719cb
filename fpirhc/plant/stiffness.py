"""Whether an integrator with fixed steps can follow a plant at a point: no mode of it that decays may grow in a cycle."""

from __future__ import annotations

import math

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
    growth = integrator.growth(modes * period)
    if growth is None:
        return ""
    wrong = (growth > 1 + 1e-9) & (modes.real <= 1e-9 * np.abs(modes))
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


def poles(plant: Plant, state: np.ndarray, command: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Return the eigenvalues of dx'/dx at a point, per unit of time, shape (nx,); not finite where the slope is not."""
    x, u, p = plant.symbols()
    slope_of = ca.Function("fpirhc_slope", [x, u, p], [ca.densify(ca.jacobian(plant.derivative_function(x, u, p), x))])
    slope = np.asarray(slope_of(state, command, parameters).full())
    return np.linalg.eigvals(slope) if np.isfinite(slope).all() else np.full(len(slope), np.nan + 0j)


def _text(pole: complex) -> str:
    return f"{pole.real:.4g}" if abs(pole.imag) <= 1e-9 * abs(pole) else f"{pole.real:.4g} +- {abs(pole.imag):.4g}i"
