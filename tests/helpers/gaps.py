"""What a cycle without a sample does to a stepper: its status, and its memory."""

from __future__ import annotations

import numpy as np

import fpirhc as fp
from fpirhc import Status
from fpirhc.simulation.clock import MEMORY as CLOCK

COUNTS = {"missing_cycles", "skipped_before", CLOCK.name}  # in every stepper
MANY = {"jumps", "_integral_before"}  # in many: the check of responses, and integrals of errors, which go on


def gone_on(stepper: fp.Stepper, before: np.ndarray, after: np.ndarray) -> set[str]:
    """Names of the signals of a memory that a cycle without a sample changed, beside its counts and integrals."""
    changed = {s.name for s in stepper.memory.signals if np.any((after != before)[stepper.memory.slice(s.name)])}
    assert changed >= COUNTS, changed
    return changed - COUNTS - MANY


def status(stepper: fp.Stepper) -> Status:
    """That of the last step."""
    return Status(int(stepper.trace()["status"][0]))
