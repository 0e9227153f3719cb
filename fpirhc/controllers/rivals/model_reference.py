"""Model reference adaptive control: the reference model, a deformed force, gains by Lyapunov's rule. Theory: docs/theory.md."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.linalg import companion, solve_continuous_lyapunov

from fpirhc.controllers.base import Controller, closing_blocks, reference_block, tracked_blocks
from fpirhc.controllers.built import Built
from fpirhc.controllers.contract import OfDerivatives
from fpirhc.deformation.base import Deformation
from fpirhc.errors import Mistakes, NotSupported
from fpirhc.fields.kinds import NotNegative, Positive
from fpirhc.members import Example
from fpirhc.plant.maps import step_of
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, expression, power
from fpirhc.symbolic.layout import Expression, Layout, Signal, like, scalar
from fpirhc.task.dead_time import every
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Tracking, decay_gains, error_chains


def _chain(gains: tuple[float, ...]) -> np.ndarray:  # A of x' = A x for x = (e, e', ...)
    return np.flip(companion([1.0, *reversed(gains)]))


def model_block(plant: Plant, rate: float, period: float) -> Block:
    """Return Block (state, reference and its response, warm_up) -> 'model', the model's state, and 'nominal', its response.

    Coordinates that are not controlled follow the reference.
    """
    chains = [[name + "'" * s for s in range(order)] for name, order in plant.response_orders.items()]
    gains = [decay_gains(rate, len(chain)) for chain in chains]
    ends_of_steps = np.cumsum([0, *(len(g) ** 2 for g in gains)]).tolist()

    fixed = np.concatenate([step_of(plant, _chain(g), period).ravel(order="F") for g in gains])
    memory = Layout((Signal("model_deviation", tuple(e for chain in chains for e in chain)),))
    ends = np.cumsum([0, *(len(chain) for chain in chains)]).tolist()

    def step(s: Signals) -> dict[str, Expression]:
        first = ca.vertcat(
            *(e for chain in error_chains(plant, s.reference - getattr(s, plant.output.name)) for e in chain)
        )
        deviation = ca.vertsplit(ca.if_else(s.warm_up > 0.5, s.model_deviation, first), ends)
        spread = dict(zip(memory.signals[0].elements, ca.vertsplit(ca.vertcat(*deviation)), strict=True))
        lag = ca.vertcat(*(spread.get(e, 0) for e in plant.output.elements))
        pull = [ca.dot(ca.vertcat(*g), d) for g, d in zip(gains, deviation, strict=True)]
        entries = ca.vertsplit(expression(ca.DM(fixed)), ends_of_steps)
        steps = [ca.reshape(m, len(g), len(g)) for m, g in zip(entries, gains, strict=True)]
        deviation_next = [ca.mtimes(m, d) for m, d in zip(steps, deviation, strict=True)]
        return {
            "model": s.reference - lag,
            "nominal": s._reference_response + ca.vertcat(*pull),
            "model_deviation_next": ca.vertcat(*deviation_next),
        }

    reads = (
        plant.output,
        like(plant.output, "reference"),
        plant.response_signal("_reference_response"),
        scalar("warm_up"),
    )
    writes = (like(plant.output, "model"), plant.response_signal("nominal"))
    return Block("reference_model", Layout(reads), Layout(writes), step, memory)


@dataclass(frozen=True, eq=False)
class ForceMRAC(Controller):
    """Tracking of the reference model, made true by deforming the command.

    Args:
        tracking: the law that gives the desired response.
        deformation: the fixed-point map on commands; a scale is in units of the inputs.
    """

    tracking: Tracking
    deformation: Deformation

    deforms = "command"

    def check(self, problem: Problem) -> None:
        """Raise where the response does not recalculate the last command, with which a model-referenced map compares it."""
        form, late = self.deformation.form, any((problem.dead_time.measurement, *problem.dead_time.inputs.values()))
        believes = form.late or any(every(form.lag))
        if form.modelled and (late or believes or not problem.sensing.ideal):
            raise NotSupported(
                "ForceMRAC cannot use a model-referenced deformation here: it compares the last command with the one recalculated "
                "from the response, through no estimator, dead time or lag; use the map itself or Increment"
            )

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        return tracked_blocks(built, self.tracking, self._force_block(built.plant, built.warm_up))

    def _force_block(self, plant: Plant, warm_up_cycles: float) -> Block:
        """Block (state, desired, realised, last command) -> Q^Des, Q^Rec, Q^Def, and the model's response to it."""
        memory = self.deformation.memory(plant.input.elements)
        inverse, response = plant.equations.inverse, plant.equations.controlled_response

        def step(s: Signals) -> dict[str, Expression]:
            remembered = {m: getattr(s, m) for m in memory.names}
            running = s.warm_up > warm_up_cycles - 0.5
            desired = inverse(s.state, s.desired, s.parameters)
            recalculated = ca.if_else(running, inverse(s.state, s.realised, s.parameters), desired)
            deformed, next_memory = self.deformation.step(s._command_before, recalculated, desired, remembered)
            next_values = {f"{m}_next": ca.if_else(running, next_memory[m], remembered[m]) for m in memory.names}
            command = ca.if_else(running, deformed, desired)
            return {
                "force_desired": desired,
                "force_recalculated": recalculated,
                "command_unclipped": command,
                "_deformed_unclipped": response(s.state, command, s.parameters),
                **next_values,
            }

        responses = [plant.response_signal(n) for n in ("desired", "realised")]
        reads = (plant.state, plant.parameter, *responses, like(plant.input, "_command_before"), scalar("warm_up"))
        forces = [like(plant.input, n) for n in ("force_desired", "force_recalculated", "command_unclipped")]
        writes = Layout((*forces, plant.response_signal("_deformed_unclipped")))
        return Block("force", Layout(reads), writes, step, memory, opaque=plant.equations.inverse_opaque)


@dataclass(frozen=True)
class LyapunovMRAC(OfDerivatives):
    """Gains on state, reference and bias, adapted so that the plant becomes the reference model.

    Args:
        rate: of the reference model, 1/s.
        adaptation: gamma, in units of the input times s^(2n-1) per squared unit of the coordinate.
        leakage: rate with which the gains return to those of the model, 1/s.
    """

    rate: Positive
    adaptation: Positive
    leakage: NotNegative = 0.0

    learns = of_time = True

    def weights(self, order: int) -> np.ndarray:
        """Return P of the scaled error z for one coordinate, shape (order, order)."""
        return np.asarray(solve_continuous_lyapunov(_chain(decay_gains(1.0, order)).T, -np.eye(order)))

    def check(self, problem: Problem) -> None:
        """Raise if the proof of the rule does not cover the plant."""
        super().check(problem)
        plant, mistakes = problem.plant, Mistakes("LyapunovMRAC")
        followed = plant.chains
        if len(plant.controlled_names) != len(followed):
            free = [c for c in followed if c not in plant.controlled_names]
            mistakes.add(f"the plant is not fully actuated: '{free[0]}' has no input of its own; use ComputedTorque")
        elif _sign(problem) == 0:
            mistakes.add(
                "the inputs' effect on the response is not definite at the start, so the rule may enlarge the error; "
                "order the inputs as the coordinates, each with a positive effect on its own"
            )
        mistakes.raise_if_any()

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        plant = built.plant
        closing, delays = closing_blocks(built)
        blocks = [
            reference_block(built),
            model_block(plant, self.rate, built.period),
            self._law_block(plant),
            *closing,
            self._adapt_block(plant, built.period, _sign(built.problem)),
        ]
        gains, first = _gains(plant, "_gains_before"), _gains(plant, "_gains_first_before")
        return blocks, [*delays, Delay(gains, "gains"), Delay(first, "_gains_first")]

    def _law_block(self, plant: Plant) -> Block:
        """Block (state, model, reference, gains) -> command, regressor, p z, and the gains in use."""
        seen = plant.output
        rows = [self.weights(order)[-1] for order in plant.response_orders.values()]
        start, response, rate = _start_gains(plant), plant.equations.controlled_response, self.rate

        def pull(row: np.ndarray, chain: list[Expression]) -> Expression:
            return sum(w * power(rate, len(chain) - 1 - j) * e for j, (w, e) in enumerate(zip(row, chain, strict=True)))

        def step(s: Signals) -> dict[str, Expression]:
            motion = getattr(s, seen.name)
            errors = error_chains(plant, s.reference - motion)
            feedback = [ca.dot(ca.vertcat(*decay_gains(rate, len(c))), ca.vertcat(*c)) for c in errors]
            desired = s._reference_response + ca.vertcat(*feedback)
            begun = start(s.state, desired, s.parameters)
            first = ca.if_else(s.warm_up > 0.5, s._gains_first_before, begun)
            gains = ca.if_else(s.warm_up > 0.5, s._gains_before, begun)
            regressor = ca.vertcat(s.state, desired, 1)
            command = ca.mtimes(ca.reshape(gains, desired.numel(), regressor.numel()), regressor)
            chains = error_chains(plant, s.model - motion)
            return {
                "desired": desired,
                "command_unclipped": command,
                "_deformed_unclipped": response(s.state, command, s.parameters),
                "_pull": ca.vertcat(*(pull(row, chain) for row, chain in zip(rows, chains, strict=True))),
                "_regressor": regressor,
                "_gains_used": gains,
                "_gains_first": first,
            }

        before = [_gains(plant, n) for n in ("_gains_before", "_gains_first_before")]
        motions = [like(seen, n) for n in ("model", "reference")]
        reads = (
            *plant.motion,
            *motions,
            plant.response_signal("_reference_response"),
            plant.parameter,
            scalar("warm_up"),
        )
        writes = (
            plant.response_signal("desired"),
            like(plant.input, "command_unclipped"),
            plant.response_signal("_deformed_unclipped"),
            *_adapted(plant),
        )
        return Block("law", Layout((*reads, *before)), Layout(writes), step, opaque=plant.equations.inverse_opaque)

    def _adapt_block(self, plant: Plant, period: float, sign: int) -> Block:
        """Block that steps the gains, except those of an input that the rule moves further into its limit."""

        def step(s: Signals) -> dict[str, Expression]:
            pull = sign * s._pull
            # No side of a comparison where a command is not a number, so that its gains stay too.
            counts = pull * (s.command_unclipped - s.command) <= 0
            rule = self.adaptation * ca.vec(ca.mtimes(pull, s._regressor.T))
            change = rule - self.leakage * (s._gains_used - s._gains_first)
            return {"gains": s._gains_used + period * ca.if_else(ca.repmat(counts, s._regressor.numel()), change, 0)}

        reads = Layout((like(plant.input, "command_unclipped"), plant.input, *_adapted(plant)))
        return Block("adapt", reads, Layout((_gains(plant, "gains"),)), step)


def _regressed(plant: Plant) -> tuple[str, ...]:
    return (*plant.state.elements, *(f"v_{c}" for c in plant.controlled_names), "bias")


def _gains(plant: Plant, name: str) -> Signal:
    """Theta column by column: torque_angle is the gain of the angle in the torque."""
    return Signal(name, tuple(f"{u}_{x}" for x in _regressed(plant) for u in plant.input.elements))


def _adapted(plant: Plant) -> tuple[Signal, ...]:
    """Signals of the law that the adaptation reads."""
    own = (Signal("_pull", plant.controlled_names), Signal("_regressor", _regressed(plant)))
    return (*own, _gains(plant, "_gains_used"), _gains(plant, "_gains_first"))


def _start_gains(plant: Plant) -> ca.Function:
    """Function (state, desired response, parameters) -> Theta_0: the model's inverse, linearised there."""
    x, r = ca.MX.sym("x", plant.state.size), ca.MX.sym("r", len(plant.controlled_names))
    p = ca.MX.sym("p", len(plant.parameters))
    command = plant.equations.inverse(x, r, p)
    by_state, by_response = ca.densify(ca.jacobian(command, x)), ca.densify(ca.jacobian(command, r))
    bias = command - ca.mtimes(by_state, x) - ca.mtimes(by_response, r)
    return ca.Function("fpirhc_start_gains", [x, r, p], [ca.vec(ca.horzcat(by_state, by_response, bias))])


def _sign(problem: Problem) -> int:
    """Sign of the inputs' effect on the response by the model at the start; 0 where it is not definite."""
    plant = problem.plant
    matrix = np.asarray(
        plant.equations.input_gain(problem.start_state, [0] * len(plant.inputs), plant.approximate).full()
    )
    values = np.linalg.eigvalsh(matrix + matrix.T)
    return 1 if values.min() > 0 else -1 if values.max() < 0 else 0


EXAMPLES = (
    Example(problem="mrac_pendulum", controller="force MRAC", changes={"duration": 3.0, "measure_from": 0.0}),
    Example(problem="mrac_pendulum", controller="Lyapunov MRAC", changes={"duration": 3.0, "measure_from": 0.0}),
)
