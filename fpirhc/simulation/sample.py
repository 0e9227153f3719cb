"""Samples of a step: those of a run, and arguments that are no arrays of float64 (lists, other types of numbers, mistakes)."""

from __future__ import annotations

import numpy as np

from fpirhc.errors import InvalidShape, InvalidValue
from fpirhc.fields.kinds import described, real_number
from fpirhc.simulation.run import Run


def raw_measurements(run: Run) -> np.ndarray:
    """Return what the controller of a run was given in every cycle, shape (cycles, number of measurements).

    It is what the sensors show, as it arrives; state and response where both are measured. `Stepper.step_measured` takes its rows.
    Of a plant with outputs the state stands before raw measurements of these, unless it is believed.
    """
    for name in ("arrived", "measured"):
        if name in run.layout:
            # A state that is logged before the measurements is not made from them.
            state_measured = "output" in run.layout and run.layout.names.index("state") < run.layout.names.index(name)
            return np.ascontiguousarray(np.hstack([run["state"], run[name]]) if state_measured else run[name])
    return np.hstack([run[name] for name in ("state", "output", "realised") if name in run.layout])


def numbers(name: str, value: object, size: int) -> np.ndarray:
    """Return `value` as float64, shape (size,)."""
    if isinstance(value, np.ma.MaskedArray):
        raise InvalidValue(
            f"argument '{name}' is a masked array; a missing number is NaN: {name}.filled(np.nan) skips the cycle"
        )
    if isinstance(value, list | tuple) and any(isinstance(v, bool | np.bool_) for v in value):
        raise InvalidValue(f"argument '{name}' must be made of real numbers, got {described(value)} with a truth value")
    try:
        array = np.asarray(value)
    except Exception:  # noqa: BLE001 -- rows of different lengths; an object of a stranger's that raises where numpy asks it
        raise InvalidValue(f"argument '{name}' is not made of numbers, got {described(value)}") from None
    if array.dtype.kind == "O":
        raise InvalidValue(f"argument '{name}' is not made of numbers, got {described(value)}; expected {size} numbers")
    if array.dtype.kind not in "fiu":
        raise InvalidValue(
            f"argument '{name}' must be made of real numbers, got {described(value)} of type '{array.dtype}'"
        )
    if array.size != size or sum(n != 1 for n in array.shape) > 1 or array.ndim == 0:
        raise InvalidShape(f"argument '{name}' has {size} entries (shape ({size},)), got shape {array.shape}")
    return np.ascontiguousarray(array.ravel(), dtype=np.float64)


def one_number(name: str, value: object) -> float:
    """Return `value` as a float."""
    number = real_number(value)
    if number is None:
        raise InvalidValue(f"argument '{name}' must be a number of seconds, got {described(value)}")
    return number
