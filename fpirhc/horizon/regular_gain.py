"""Whether the inputs keep their effect on the outputs: the gain d y^(r)/du along the model's nominal run.

The relative order of an output is decided from the symbols. Its gain may still vanish at some states, such as that of y = x^2 where
x passes through zero; there the order is another one, and no finite input gives the wanted response. The model's outputs are led
along their reference, from the start, with the input inside its limits, and the gain is looked at in every cycle.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TypeAlias

import casadi as ca
import numpy as np

from fpirhc.horizon.nominal import nominal_motion
from fpirhc.plant.integrators import Integrator
from fpirhc.plant.plant import Plant
from fpirhc.task.reference import Reference

_CYCLES = 20_000  # of a run that are looked at
_DECAYS = 20.0  # times in a run, by which the error of the start decays
_FASTEST = 0.1  # of the cycle, the rate of this decay
_NOTHING = 1e-9  # share of the largest gain that counts as none
_SMALL = 1e-2  # share of the largest gain before a run that is not finite


Bounds: TypeAlias = tuple[tuple[float, ...], tuple[float, ...]]


@lru_cache(maxsize=8)  # studies make many problems of one plant and reference
def nominal_run(
    plant: Plant,
    reference: Reference,
    integrator: Integrator,
    start: tuple[float, ...],
    bounds: Bounds,
    times: tuple[float, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Return states (nx, m) and inputs (nu, m) of the model while its outputs follow their reference, in the first 20 000 cycles.

    Args:
        plant: the model, with outputs and as many inputs as controlled ones.
        reference: of its outputs.
        integrator: of the motion.
        start: first state, shape (nx,).
        bounds: lower and upper bounds of the inputs.
        times: length of a cycle, and number of cycles.
    """
    period, cycles = times[0], min(times[1], _CYCLES)
    x, u, p = plant.symbols()
    advance, w = integrator.step(plant, period), np.zeros(len(plant.names))
    xm, um, pm = (ca.MX.sym(n, v.numel()) for n, v in (("x", x), ("u", u), ("p", p)))
    step = ca.Function("fpirhc_advance", [xm, um, pm], [advance(xm, um, pm, w)])
    rate = min(_DECAYS / (period * times[1]), _FASTEST / period)
    ends = np.array(bounds[0]), np.array(bounds[1])
    return nominal_motion(plant, reference, step, np.array(start), ends, period * np.arange(cycles), rate)


def singular_gain(plant: Plant, states: np.ndarray, inputs: np.ndarray, period: float) -> str:
    """Return a sentence that says where the gain vanishes or changes its sign, and its values; empty where it does not.

    Args:
        plant: the model.
        states: of its nominal run, cycle by cycle, shape (nx, m).
        inputs: of the same run, shape (nu, m).
        period: length of a cycle.
    """
    x, u, p = plant.symbols()
    response, count = plant.controlled_response_function(x, u, p), states.shape[1]
    gain = ca.Function("fpirhc_output_gain", [x, u, p], [ca.densify(ca.det(ca.jacobian(response, u)))])
    believed = np.repeat(plant.approximate[:, None], count, axis=1)
    gains = np.asarray(gain.map(count)(states, inputs, believed).full()).ravel()
    return _judged(plant, gains, states, period)


def _judged(plant: Plant, gains: np.ndarray, states: np.ndarray, period: float) -> str:
    finite = np.isfinite(gains)
    count = len(gains) if finite.all() else int(np.argmin(finite))
    if not count:
        return ""
    sizes, first = np.abs(gains[:count]), np.sign(gains[0])
    wrong = (sizes <= _NOTHING * sizes.max()) | (np.sign(gains[:count]) != first)
    if wrong.any():
        k = int(np.argmax(wrong))
    elif count < len(gains) and sizes[-1] <= _SMALL * sizes.max():
        k = count - 1
    else:
        return ""
    where = ", ".join(f"{e} = {v:.4g}" for e, v in zip(plant.state.elements, states[:, k], strict=True))
    what = "gain" if len(plant.inputs) == 1 else "determinant of the gain"
    inputs, outputs = ", ".join(plant.inputs), ", ".join(plant.controlled_names)
    return (
        f"the {what} from {inputs} to {outputs} vanishes along the model's nominal run: it is {gains[0]:.4g} at the start and "
        f"{gains[k]:.4g} at t = {k * period:.4g} {plant.time_unit} ({where}). The relative order changes there; choose another "
        "output, or a reference that stays away from it"
    )
