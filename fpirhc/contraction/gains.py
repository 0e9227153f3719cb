"""Which gains converge, and how fast: |1 - a lambda| < 1 for every eigenvalue lambda of the response Jacobian."""

from __future__ import annotations

import numpy as np

from fpirhc.contraction.spectrum import Array, Spectrum
from fpirhc.deformation.base import Deformation
from fpirhc.errors import NotContractive

_SEARCH_STEPS = 100


def predicted_factor(eigenvalues: Array, effective_gain: float) -> float:
    """Return max|1 - a lambda|, the factor by which an error of the request shrinks per cycle (grows, above 1)."""
    return float(np.abs(1 - effective_gain * np.asarray(eigenvalues)).max())


def linear_limit(eigenvalues: Array) -> tuple[float, float]:
    """Return the open interval of effective gains with |1 - a lambda| < 1 for every eigenvalue.

    One end is 0, the other is min 2 Re(lambda) / |lambda|^2, with a minus sign where all real parts are negative.

    Raises:
        NotContractive: eigenvalues with real parts of both signs, or zero.
    """
    spectrum = Spectrum(eigenvalues)
    require_one_sign(spectrum)
    flat = spectrum.eigenvalues.ravel()
    outer = float((2 * np.abs(flat.real) / np.abs(flat) ** 2).min())
    return (0.0, outer) if spectrum.smallest_real > 0 else (-outer, 0.0)


def sector_limit(deformation: Deformation, eigenvalues: Array) -> tuple[float, float]:
    """Return the interval of effective gains whose steepest secant is also within the linear limit.

    Within it the iteration on a linear plant converges from errors of any size, because every step is the step of some linear map
    that contracts. Outside it large errors may end in a bounded two-cycle.

    Raises:
        NotContractive: eigenvalues with real parts of both signs, or zero.
    """
    lower, upper = linear_limit(eigenvalues)
    if deformation.effective_gain() == 0:
        return lower, upper
    right = deformation.with_effective_gain(0.5 * (lower + upper))  # the secant depends on the gain's sign
    steeper = right.secant_gain() / right.effective_gain()
    return lower / steeper, upper / steeper


def optimal_gain(eigenvalues: Array) -> float:
    """Return the effective gain with the smallest max|1 - a lambda|; 2 / (min + max) for a real spectrum.

    Raises:
        NotContractive: eigenvalues with real parts of both signs, or zero.
    """
    spectrum = Spectrum(eigenvalues)
    lower, upper = linear_limit(eigenvalues)
    if not np.any(spectrum.eigenvalues.imag):
        return 2 / (spectrum.smallest_real + spectrum.largest_real)
    for _ in range(_SEARCH_STEPS):  # max|1 - a lambda| is convex in a
        third = (upper - lower) / 3
        if predicted_factor(spectrum.eigenvalues, lower + third) < predicted_factor(
            spectrum.eigenvalues, upper - third
        ):
            upper -= third
        else:
            lower += third
    return 0.5 * (lower + upper)


def require_one_sign(spectrum: Spectrum) -> None:
    """Check that some gain converges.

    Raises:
        NotContractive: eigenvalues with real parts of both signs, or zero.
    """
    if not spectrum.one_sign:
        raise NotContractive(
            "the response Jacobian has eigenvalues with real parts of both signs or zero (from "
            f"{spectrum.smallest_real:.4g} to {spectrum.largest_real:.4g}), so no gain makes the iteration converge: "
            "it enlarges the error in some direction. Check that each input acts on its own coordinate and that the "
            "approximate parameters give the effect of every input its true sign"
        )
