"""The adaptive controller of Slotine and Li: passivity instead of inversion, and no measured acceleration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import casadi as ca

from fpirhc.controllers.base import Controller, closing_blocks, reference_block
from fpirhc.controllers.built import Built
from fpirhc.controllers.rivals.learned_parameters import Learning, learning_delays
from fpirhc.deformation.base import Deformation, Identity
from fpirhc.errors import InvalidValue
from fpirhc.fields.kinds import Positive
from fpirhc.learning.rules import Pair, Rule
from fpirhc.members import Example
from fpirhc.plant.motion import derivative_unit, places
from fpirhc.plant.regressor import Regressor
from fpirhc.symbolic.block import Block, Delay, fed
from fpirhc.symbolic.expression import Signals, expression
from fpirhc.symbolic.layout import Expression, Layout, Signal, like, vector
from fpirhc.task.problem import Problem


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
            raise InvalidValue(
                f"SlotineLi: damping must name every coordinate and no other; '{odd[0]}' is on one side only"
            )

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
        controller="Slotine-Li",
        changes={"duration": 2.0, "measure_from": 0.0, "start": {"q1": 0.3, "q2": 0.3}},
    ),
)
