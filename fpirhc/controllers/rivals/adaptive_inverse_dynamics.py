"""Adaptive inverse dynamics: computed torque whose model learns its parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from fpirhc.controllers.base import Controller, closing_blocks, desired_blocks
from fpirhc.controllers.built import Built
from fpirhc.controllers.rivals.learned_parameters import Learning, equation_function, learning_delays
from fpirhc.controllers.rivals.reference_model import companion
from fpirhc.deformation.base import Deformation, Identity
from fpirhc.errors import require
from fpirhc.learning.rules import Pair, Rule
from fpirhc.members import Example
from fpirhc.symbolic.block import Block, Delay, fed
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, like
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import error_chains, integral_signal
from fpirhc.tracking.linear_law import Exponential


@dataclass(frozen=True, eq=False)
class AdaptiveInverseDynamics(Controller):
    """u = Y(q, q', r) p_hat + Q0 with r the desired response of the tracking law, deformed where there is a deformation.

    With x = (e_int, e, e') of every coordinate the errors obey x' = A x + B M_hat^-1 Y(q, q', q'') (p - p_hat), and with
    A^T P + P A = -Q_L the Lyapunov function x^T P x + (p - p_hat)^T Gamma^-1 (p - p_hat) falls under p_hat' = Gamma G^T w,
    G = M_hat^-1 Y and w = B^T P x. Q_L is diagonal, (rate^4, rate^2, 1), in units of e'. The rule needs the measured response and
    M_hat^-1, so the bounds must keep M_hat positive definite. A deformation keeps the errors small whatever p_hat is. Then the
    Lyapunov rule learns slowly, because it learns from these errors; a Projection learns as fast as without a deformation.

    Behind dead time a Projection pairs the response with the state at which it was realised and the command that acted then; a
    Lyapunov rule, whose function falls with the error of the instant, is refused there. Behind an estimator alone, whose response
    is late by a cycle or two, the newest error is better (`three_link_arm`: half the rms error). A deformation needs its own
    pairing, `Paired`.

    Args:
        tracking: the law that gives the desired response.
        rule: moves the estimate: LyapunovRule or Projection.
        bounds: parameter -> (lower, upper); these are learned, beginning at their approximate values.
        deformation: the fixed-point map between desired response and request.

    `check` raises NotSupported where the plant is not fully actuated mechanics, and InvalidValue where parameters enter
    nonlinearly or the bounds do not keep the mass matrix positive definite.

    References:
        J. J. Craig, P. Hsu, S. S. Sastry, Adaptive control of mechanical manipulators, Int. J. Robotics Research 6(2), 1987.
    """

    tracking: Exponential
    rule: Rule
    bounds: Mapping[str, tuple[float, float]]
    deformation: Deformation = field(default_factory=Identity)

    learns = True

    def check(self, problem: Problem) -> None:
        """Raise if plant, bounds or rule do not fit, as `Learning.check` does, or an error of the past would have to be known."""
        require(
            self.rule.reads_response or not problem.dead_time.queued,
            "AdaptiveInverseDynamics learns by this rule from the error of the instant, which dead time makes late; "
            "use rule=Projection(...)",
        )
        self._learning.check(problem, inverts=True)

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        plant = built.plant
        closing, delays = closing_blocks(built, self.deformation)
        believed = like(plant.parameter, "_believed")
        blocks = [
            *desired_blocks(built, self.tracking),
            self._learn_block(built),
            *(fed(block, "parameters", believed) for block in closing),
            self.tracking.within(built.largest).update(plant, built.period),
        ]
        return blocks, [*delays, *learning_delays(), *self.tracking.delays(plant)]

    @property
    def _learning(self) -> Learning:
        return Learning(self.rule, self.bounds)

    def _learn_block(self, built: Built) -> Block:
        plant, learning = built.plant, self._learning
        equation = equation_function(learning.regressor(built.plant))
        weights = self.lyapunov_row()

        target, integral = like(plant.output, "_target"), integral_signal(plant, "_integral_used")
        paired = bool(built.pairs.dead_time.queued)

        def gradient(s: Signals, then: Expression, estimate: Expression) -> Pair:
            state = then if paired else s.state
            matrix, _ = equation(state, s.realised, s._command_before, estimate, s.parameters)
            chains = error_chains(plant, getattr(s, target.name) - state)
            if self.tracking.integral:
                chains = [[s._integral_used[k], *chain] for k, chain in enumerate(chains)]
            along = [sum(w * e for w, e in zip(weights, chain, strict=True)) for chain in chains]
            return matrix, ca.vertcat(*along)

        return learning.block(built, (target, integral), gradient)

    def lyapunov_row(self) -> np.ndarray:
        """Return B^T P: the weights of (e_int, e, e'), or of (e, e') without the integral, in w."""
        gains = self.tracking.gains(2)
        size = len(gains)
        weights = np.diag([self.tracking.rate ** (2.0 * (size - 1 - k)) for k in range(size)])
        return np.asarray(solve_continuous_lyapunov(companion(gains).T, -weights)[-1])


EXAMPLES = (
    Example(
        problem="planar_arm",
        controller="AID",
        changes={"duration": 2.0, "measure_from": 0.0, "start": {"q1": 0.3, "q2": 0.3}},
    ),
)
