"""The closed loop in one slot, linearised at the set-point.

With an ideal deformation the plant realises the desired response exactly, y^(r) = y^(r),Des, so a slot's motion near an
equilibrium (x*, u*) is z' = A z with z = (x - x*, e_int, offset): the state, the integral of the law, and the offset that remains
after a switch. The input is a linear function of z. All coordinates but y follow the zero dynamics of y.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.controllers.reference_states import reference_states
from fpirhc.controllers.slots.slot import Channel
from fpirhc.task.problem import Problem

_STILL = 1e-6  # size of a derivative, relative to its terms, that counts as zero


@dataclass(frozen=True, eq=False)
class Mode:
    """One slot near the set-point, with n states of the plant.

    Args:
        generator: A, shape (n + 2, n + 2).
        command: row k with u - u* = k z, shape (n + 2,).
        own: row of y^(r) in x - x*, shape (n,).
        gain: b, derivative of y^(r) with respect to the input.
        law: row of y^(r),Des in z without the offset, shape (n + 2,).
        first_integral: row of the integral at the start of the slot in x - x*, shape (n,).
        blends: whether a switch leaves an offset.
        integrates: whether the law has an integral.
    """

    generator: np.ndarray
    command: np.ndarray
    own: np.ndarray
    gain: float
    law: np.ndarray
    first_integral: np.ndarray
    blends: bool
    integrates: bool

    @property
    def eigenvalues(self) -> np.ndarray:
        """Eigenvalues of the motion within the slot, 1/s, without the decay of the offset."""
        size = self.generator.shape[0] - (1 if self.integrates else 2)
        return np.linalg.eigvals(self.generator[:size, :size])

    @property
    def rate(self) -> float:
        """Largest real part of the eigenvalues, 1/s: the speed with which the slot's zero dynamics diverge."""
        return float(self.eigenvalues.real.max())

    def start(self, before: Mode) -> np.ndarray:
        """Return the matrix from z at the end of the slot `before` to z at the start of this one; the command is continuous."""
        n = self.own.size
        matrix = np.zeros((n + 2, n + 2))
        matrix[:n, :n] = np.eye(n)
        matrix[n, :n] = self.first_integral
        if self.blends:
            realised = np.concatenate([self.own, [0, 0]]) + self.gain * before.command
            matrix[n + 1] = realised - self.law @ matrix
        return matrix

    def goes_on(self) -> np.ndarray:
        """Return the matrix from z to z where no switch happens: the integral stays, and there is no offset."""
        return np.diag([*np.ones(self.own.size), float(self.integrates), 0.0])


def linear_modes(
    problem: Problem, channels: Sequence[Channel], parameters: np.ndarray, blend: float
) -> tuple[list[Mode], str]:
    """Return the modes at the reference's last point; where there are none an empty list and the reason.

    Args:
        problem: with the plant.
        channels: the slots on the plant.
        parameters: of the plant, shape (np,).
        blend: time constant of the offset at a switch, s; 0 leaves the offset out.
    """
    other = [c.slot.coordinate for c in channels if c.slot.tracking.feedback(c.chain.order) is None]
    if other:
        return [], f"the tracking law of slot '{other[0]}' is no feedback with constant gains, such as Exponential"
    set_point = _set_point(problem, parameters)
    if isinstance(set_point, str):
        return [], set_point
    return [_mode(problem, one, parameters, blend, *set_point) for one in channels], ""


def _set_point(problem: Problem, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray] | str:
    plant = problem.plant
    reference_end = problem.reference.function(plant)(problem.duration)
    motion, response = (np.asarray(v.full()).ravel() for v in reference_end)
    moving = [abs(v) for e, v in zip(plant.output.elements, motion, strict=True) if "'" in e]
    if max([*moving, *np.abs(response)]) > _STILL:
        return f"the reference still moves at its end, t = {problem.duration:g} {problem.time_unit}"
    state = reference_states(problem, 2)[:, -1]
    x, u, p = plant.symbols()
    rate = plant.equations.rate(x, u, p)
    function = ca.Function("fpirhc_rate", [x, u, p], [rate, ca.densify(ca.jacobian(rate, u))])
    free, gain = (np.asarray(v.full()) for v in function(state, np.zeros(u.numel()), parameters))
    command = np.linalg.lstsq(gain, -free, rcond=None)[0].ravel()
    residual = np.abs(np.asarray(function(state, command, parameters)[0].full())).max()
    if not residual <= _STILL * (1 + np.abs(free).max()):
        return f"the reference's last point is no equilibrium: no input brings |x'| below {residual:.3g}"
    return state, command


def _mode(
    problem: Problem, one: Channel, parameters: np.ndarray, blend: float, state: np.ndarray, command: np.ndarray
) -> Mode:
    plant, law = problem.plant, one.slot.tracking.feedback(one.chain.order)
    assert law is not None
    x, u, p = plant.symbols()
    rate, calm = plant.equations.rate(x, u, p), ca.SX.zeros(len(plant.names))
    acting_input = u[plant.input.elements.index(one.chain.input)]
    realised = one.chain.response(x, u, p, calm)
    derivatives = [
        (rate, x),
        (rate, acting_input),
        (one.chain.states(x, p), x),
        (realised, x),
        (realised, acting_input),
    ]
    function = ca.Function("fpirhc_linear", [x, u, p], [ca.densify(ca.jacobian(f, v)) for f, v in derivatives])
    a, b, chain, own, gain = (np.asarray(v.full()) for v in function(state, command, parameters))
    n, gains = a.shape[0], np.array(law.gains)
    integral, proportional = (gains[0], gains[1:]) if law.integral else (0.0, gains)
    feedback = proportional @ chain
    desired = np.concatenate([-feedback, [integral, 0.0]])
    offset = np.eye(n + 2)[n + 1] if blend > 0 else np.zeros(n + 2)
    through = (desired + offset - np.concatenate([own.ravel(), [0, 0]])) / gain.item()
    generator = np.zeros((n + 2, n + 2))
    generator[:n, :n] = a
    generator[:n] += b @ through[None, :]
    if law.integral:
        generator[n, :n] = -chain[0]
    if blend > 0:
        generator[n + 1, n + 1] = -1 / blend
    first = feedback / integral if law.integral and law.bumpless else np.zeros(n)
    return Mode(generator, through, own.ravel(), gain.item(), desired, first, blend > 0, law.integral)
