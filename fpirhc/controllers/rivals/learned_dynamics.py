"""Inverse dynamics whose model learns its parameters: adaptive inverse dynamics, and the controller of Slotine and Li."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from scipy.linalg import companion, solve_continuous_lyapunov

from fpirhc.controllers.base import Controller, closing_blocks, reference_block, tracked_blocks
from fpirhc.controllers.built import Built
from fpirhc.controllers.rivals.learned_parameters import Learning, equation_function, learning_delays
from fpirhc.deformation.base import Deformation, Identity
from fpirhc.errors import InvalidValue, require
from fpirhc.fields.kinds import Positive
from fpirhc.learning.rules import Pair, Rule
from fpirhc.members import Example
from fpirhc.plant.motion import derivative_unit, places
from fpirhc.plant.regressor import Regressor
from fpirhc.symbolic.block import Block, Delay, fed
from fpirhc.symbolic.expression import Signals, expression
from fpirhc.symbolic.layout import Expression, Layout, Signal, like, vector
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
            self.rule.reads_response or not problem.dead_time.longest,
            "AdaptiveInverseDynamics learns by this rule from the error of the instant, which dead time makes late; "
            "use rule=Projection(...)",
        )
        self._learning.check(problem, inverts=True)

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        believed, learn = like(built.plant.parameter, "_believed"), self._learn_block(built)
        blocks, delays = tracked_blocks(built, self.tracking, learn, deformation=self.deformation)
        after = blocks.index(learn) + 1
        following = [fed(block, "parameters", believed) for block in blocks[after:]]
        return [*blocks[:after], *following], [*delays, *learning_delays()]

    @property
    def _learning(self) -> Learning:
        return Learning(self.rule, self.bounds)

    def _learn_block(self, built: Built) -> Block:
        plant, learning = built.plant, self._learning
        equation = equation_function(learning.regressor(built.plant))
        weights = self.lyapunov_row()

        target, integral = like(plant.output, "_target"), integral_signal(plant, "_integral_used")
        paired = bool(built.pairs.dead_time.longest)

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
        return np.asarray(solve_continuous_lyapunov(np.flip(companion([1.0, *reversed(gains)])).T, -weights)[-1])


@dataclass(frozen=True, eq=False)
class SlotineLi(Controller):
    """u = Y_s(q, q', v, v') p_hat + Q0_s + K_D rho,  v = q'^N + rate e,  rho = e' + rate e.

    Then M rho' + C rho + K_D rho = Y_s (p - p_hat), and because M' - 2 C is skew-symmetric the Lyapunov function
    (rho^T M rho + (p - p_hat)^T Gamma^-1 (p - p_hat)) / 2 falls by rho^T K_D rho under p_hat' = Gamma Y_s^T rho. The law needs
    neither q'' nor M_hat^-1, so p_hat may have any value.

    A deformation acts on v'. The model's response to the law is d = v' + M_hat^-1 (C_hat + K_D) rho, which is the desired response
    of the pair. The law then needs q'' and M_hat^-1, and the bounds must keep M_hat positive definite. Without a deformation v' is
    logged as 'desired'.

    `check` raises NotSupported where the plant is not fully actuated mechanics, and InvalidValue where parameters enter
    nonlinearly, the bounds do not fit, or the damping does not name every coordinate.

    Args:
        rate: Lambda, 1/s.
        damping: diagonal of K_D by coordinate, input per unit of rho.
        rule: moves the estimate: LyapunovRule or Projection.
        bounds: parameter -> (lower, upper); these are learned, beginning at their approximate values. Bounds may be
            infinite with a LyapunovRule and no deformation.
        deformation: the map between desired response and request; Identity() is no deformation.

    References:
        J.-J. E. Slotine, W. Li, On the adaptive control of robot manipulators, Int. J. Robotics Research 6(3), 1987.
    """

    rate: Positive
    damping: Mapping[str, Positive]
    rule: Rule
    bounds: Mapping[str, tuple[float, float]]
    deformation: Deformation = field(default_factory=Identity)

    learns = True

    def check(self, problem: Problem) -> None:
        self._learning.check(problem, inverts=self._deforms)
        odd = sorted(set(self.damping) ^ set(problem.plant.names))
        if odd:
            raise InvalidValue(f"SlotineLi: damping must name every coordinate and no other; '{odd[0]}' is on one side")

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        regressor = self._learning.regressor(built.plant)
        front = [reference_block(built), self._sliding_block(built), self._learn_block(built, regressor)]
        closing, delays = closing_blocks(built, self.deformation)
        if self._deforms:
            believed = like(built.plant.parameter, "_believed")
            closing = [fed(block, "parameters", believed) for block in closing]
            return [*front, self._demand_block(built, regressor), *closing], [*delays, *learning_delays()]
        # The request of a clipped command comes from the approximate model: the estimated one may have no inverse.
        deform, _, *rest = closing
        return [*front, deform, self._force_block(built, regressor), *rest], [*delays, *learning_delays()]

    @property
    def _deforms(self) -> bool:
        return self.deformation.adapts

    @property
    def _learning(self) -> Learning:
        return Learning(self.rule, self.bounds)

    def _sliding_block(self, built: Built) -> Block:
        """Block (state, reference) -> (sliding rho, v, v'); v' is also 'desired' where nothing is deformed."""
        plant = built.plant
        at, moving = places(plant, 0), places(plant, 1)
        seen = plant.output
        reads = (seen, like(seen, "reference"), plant.response_signal("_reference_response"))
        slope = plant.response_signal("_velocity_slope" if self._deforms else "desired")
        writes = (_rates(built, "sliding"), _rates(built, "_velocity"), slope, plant.response_signal("nominal"))

        def step(s: Signals) -> dict[str, Expression]:
            motion = getattr(s, seen.name)
            error = s.reference - motion
            velocity = s.reference[moving] + self.rate * error[at]
            return {
                "sliding": velocity - motion[moving],
                "_velocity": velocity,
                slope.name: s._reference_response + self.rate * error[moving],
                "nominal": s._reference_response,
            }

        return Block("sliding", Layout(reads), Layout(writes), step)

    def _learn_block(self, built: Built, regressor: Regressor) -> Block:
        slope = built.plant.response_signal("_velocity_slope" if self._deforms else "desired")

        def gradient(s: Signals, state: Expression, estimate: Expression) -> Pair:
            del state, estimate  # law and error of this cycle belong together; no response is read
            matrix, _ = regressor.split_function(s.state, s._velocity, getattr(s, slope.name), s.parameters)
            return matrix, s.sliding

        reads = (_rates(built, "sliding"), _rates(built, "_velocity"), slope)
        return self._learning.block(built, reads, gradient)

    def _demand_block(self, built: Built, regressor: Regressor) -> Block:
        """Block -> desired: the model's response to the law."""
        plant, damping = built.plant, self._damping(built)
        slope = plant.response_signal("_velocity_slope")
        reads = (plant.state, plant.parameter, regressor.signal, _rates(built, "sliding"), slope)

        def step(s: Signals) -> dict[str, Expression]:
            mass = regressor.mass_function(s.state, s.estimate, s.parameters)
            pull = ca.mtimes(regressor.coriolis_function(s.state, s.estimate, s.parameters), s.sliding)
            return {"desired": s._velocity_slope + ca.solve(mass, pull + damping * s.sliding)}

        return Block("demand", Layout(reads), Layout((plant.response_signal("desired"),)), step)

    def _force_block(self, built: Built, regressor: Regressor) -> Block:
        """Block -> command_unclipped: the law itself, linear in the estimate."""
        plant, damping = built.plant, self._damping(built)
        slope = plant.response_signal("_deformed_unclipped")
        reads = (
            plant.state,
            plant.parameter,
            regressor.signal,
            _rates(built, "sliding"),
            _rates(built, "_velocity"),
            slope,
        )

        def step(s: Signals) -> dict[str, Expression]:
            matrix, rest = regressor.split_function(s.state, s._velocity, s._deformed_unclipped, s.parameters)
            return {"command_unclipped": ca.mtimes(matrix, s.estimate) + rest + damping * s.sliding}

        return Block("force", Layout(reads), Layout((like(plant.input, "command_unclipped"),)), step)

    def _damping(self, built: Built) -> Expression:
        return expression(ca.vertcat(*(self.damping[name] for name in built.plant.names)))


def _rates(built: Built, name: str) -> Signal:
    plant = built.plant
    return vector(name, plant.names, [derivative_unit(plant.coordinates[c], 1, plant.time_unit) for c in plant.names])


EXAMPLES = (
    Example(
        problem="planar_arm",
        controller="AID",
        changes={"duration": 2.0, "measure_from": 0.0, "start": {"q1": 0.3, "q2": 0.3}},
    ),
    Example(
        problem="planar_arm",
        controller="Slotine-Li",
        changes={"duration": 2.0, "measure_from": 0.0, "start": {"q1": 0.3, "q2": 0.3}},
    ),
)
