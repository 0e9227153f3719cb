"""Whether a periodic schedule of slots is stable: the spectral radius of one period.

    rho = max |eig( e^(A_m T_m) R_m ... e^(A_1 T_1) R_1 )|

with the slots' matrices A_j at the set-point, their durations T_j, and R_j for the start of a slot: the integral of the law is set
anew, and an offset takes up the difference between the realised response and the law. Below rho = 1 the error shrinks by rho per
period near the set-point; no slot need be stable alone.

References:
    G. Floquet, Annales scientifiques de l'ENS 12, 1883, for linear systems with periodic coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from fpirhc.controllers.slots.schedules import Schedule
from fpirhc.controllers.slots.slot import Channel, Slot, channel
from fpirhc.controllers.slots.slot_modes import linear_modes
from fpirhc.task.problem import Problem


@dataclass(frozen=True, eq=False)
class Floquet:
    """The stability of one period of a schedule.

    Args:
        radius: spectral radius of one period, dimensionless; None where it does not exist.
        period: duration of one period, s.
        eigenvalues: of the closed loop in each slot, 1/s, by coordinate.
        reason: why there is no radius; empty where there is one.
    """

    radius: float | None
    period: float
    eigenvalues: dict[str, np.ndarray]
    reason: str


def floquet_radius(problem: Problem, slots: Sequence[Slot], schedule: Schedule, *, blend: float = 0.0) -> Floquet:
    """Return the spectral radius of the schedule's period, with ideal deformations and the plant's exact parameters.

    Limits, dead time and the hold of the command over a cycle are left out.

    Args:
        problem: with the plant.
        slots: one per coordinate.
        schedule: of the slots.
        blend: time constant of the offset at a switch, s; 0 leaves the offset out.

    Raises:
        InvalidName: a coordinate or an input of a slot is unknown.
        InvalidProblem: the order of a slot is not the model's.
        NotInvertible: an input has no effect on the coordinate of its slot.
        NotSupported: a deformation that a slot does not support.
    """
    channels = [channel(problem, slot, k) for k, slot in enumerate(slots)]
    return radius_of(problem, channels, schedule, blend)


def radius_of(problem: Problem, channels: Sequence[Channel], schedule: Schedule, blend: float) -> Floquet:
    """Return the same as `floquet_radius`, for slots that are already on the plant."""
    modes, reason = linear_modes(problem, channels, problem.plant.exact, blend)
    names = [c.slot.coordinate for c in channels]
    eigenvalues = {name: mode.eigenvalues for name, mode in zip(names, modes, strict=False)}
    sequence = schedule.sequence(problem)
    period = sum(duration for _, duration in sequence)
    if not reason and len(problem.plant.inputs) > 1:
        reason = "the plant has several inputs, and those that a slot does not use keep their last command"
    if reason or not sequence:
        return Floquet(None, period, eigenvalues, reason or "the schedule is not periodic")
    before, whole = modes[names.index(sequence[-1][0])], np.eye(modes[0].generator.shape[0])
    for name, duration in sequence:
        mode = modes[names.index(name)]
        begin = mode.start(before) if len(sequence) > 1 else mode.goes_on()
        whole = scipy.linalg.expm(mode.generator * duration) @ begin @ whole
        before = mode
    entering = np.flatnonzero(np.abs(whole).sum(axis=0) > 0)
    radius = float(np.abs(np.linalg.eigvals(whole[np.ix_(entering, entering)])).max())
    return Floquet(radius, period, eigenvalues, "")
