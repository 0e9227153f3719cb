"""Constants inside Functions."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np


def holds_nan(function: ca.Function) -> bool:
    """Whether a Function, or one that it calls, holds the constant NaN."""
    return any(_has_nan(f) for f in (function, *function.find_functions()))


def _has_nan(function: ca.Function) -> bool:
    if not function.is_a("SXFunction") and not function.is_a("MXFunction"):
        return False
    places = [k for k in range(function.n_instructions()) if function.instruction_id(k) == ca.OP_CONST]
    if function.is_a("SXFunction"):
        return any(math.isnan(function.instruction_constant(k)) for k in places)
    matrices = (function.instruction_MX(k).to_DM() for k in places)
    return any(bool(np.isnan(np.asarray(m.full())).any()) for m in matrices)
