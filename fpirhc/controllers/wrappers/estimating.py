"""A controller whose model is learned on line: an estimator corrects the parameters of the wrapped controller's model.

    command = controller(state; p + parameter_change),      parameter_change = estimator(state, last command, response; p).

Offset-free receding-horizon control is RecedingHorizon with DisturbanceKalman. Adaptive receding-horizon control in the
sense of certainty equivalence is RecedingHorizon with RecursiveLeastSquares or MovingHorizon. Both are alternatives to a
deformation, or companions of one. The change is used where the controller evaluates its model: in the inverse every cycle, in a
receding horizon whenever it plans.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca

from fpirhc.controllers.base import Controller, command_before, compose_controller, embedded, like
from fpirhc.deformation.base import Deformation
from fpirhc.errors import NotSupported
from fpirhc.learning.estimators.base import Estimator, Seen
from fpirhc.learning.estimators.disturbance_kalman import DisturbanceKalman
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, Value, is_finite
from fpirhc.symbolic.layout import Layout, Signal, scalar
from fpirhc.task.problem import Problem

_BELIEVED = "_believed"


@dataclass(frozen=True)
class Estimating(Controller):
    """The wrapped controller with the parameters of its model corrected every cycle.

    Args:
        controller: any controller that uses its model.
        estimator: learns the change of the parameters.
    """

    controller: Controller
    estimator: Estimator

    @property
    def inner(self) -> Controller:
        """The wrapped controller."""
        return self.controller

    @property
    def deformation(self) -> Deformation:
        """The deformation of the wrapped controller."""
        return self.controller.deformation

    def inner_problem(self, problem: Problem) -> Problem:
        """Return the problem with the estimator's model of the plant."""
        model = self.estimator.model(problem.plant)
        return problem if model is problem.plant else replace(problem, plant=model)

    @property
    def feeds(self) -> Mapping[str, str]:
        """Corrected parameters in place of the parameters."""
        return {"parameters": _BELIEVED, **self.controller.feeds}

    @property
    def learns(self) -> bool:
        """True: the parameters of the model change during a run."""
        return True

    def linear_around(self, inner: Controller) -> Controller:
        """Return the inner controller: near the reference the parameters are those of the start."""
        return inner

    def check(self, problem: Problem) -> None:
        """Raise if the estimator or the wrapped controller does not fit the problem.

        Raises:
            FpirhcError: a check of the estimator or of the wrapped controller fails.
            NotSupported: dead time, with which the response does not belong to the last command; a controller that reads a response
                of its own.
        """
        modelled = self.inner_problem(problem)
        self.estimator.check(modelled)
        self.controller.check(modelled)
        if problem.dead_time.measurement or any(problem.dead_time.inputs.values()):
            raise NotSupported(
                "Estimating pairs a response with the command of one cycle before: no dead time is supported"
            )
        if self.controller.response(modelled) is not None:
            raise NotSupported(
                f"Estimating needs the response of the controlled coordinates; {type(self.controller).__name__} reads another"
            )

    def blocks(self, problem: Problem) -> tuple[list[Block], list[Delay]]:
        """Return the block estimate, and the wrapped controller as one block."""
        modelled = self.inner_problem(problem)
        inner = compose_controller(modelled, self.controller)
        believed = Signal(_BELIEVED, modelled.plant.parameter.elements, modelled.plant.parameter.units)
        acted = replace(command_before(problem), name="_acted")
        blocks = [
            _estimate_block(problem, modelled, self.estimator, believed, acted),
            embedded("controller", inner, {"parameters": believed}),
        ]
        return blocks, [Delay(acted, problem.plant.input.name)]


def _estimate_block(
    problem: Problem, modelled: Problem, estimator: Estimator, believed: Signal, acted: Signal
) -> Block:
    """Block (state, realised, parameters, command of the last cycle) -> (corrected parameters, the learned ones among them)."""
    plant, model = problem.plant, modelled.plant
    names = estimator.learned()
    places = [model.parameter.elements.index(n) for n in names]
    count = len(plant.parameters)
    estimate = Signal("estimate", names, tuple(model.parameters[n].unit for n in names))
    memory = estimator.memory(modelled)
    correct, followed = estimator.step(modelled), estimator.following(modelled)
    own = memory + Layout((like(estimate, "estimate_change"), scalar("estimate_begun")))

    def step(s: Signals) -> dict[str, Value]:
        parameters = ca.vertcat(s.parameters[:count], ca.DM(model.approximate[count:]))
        before = {m: getattr(s, m) for m in memory.names}
        numbers = None if followed is None else getattr(s, followed.signal.name)
        evidence = Seen(s.state, s._acted, s.realised, parameters, s.estimate_begun, numbers)
        parameter_change, next_memory = correct(evidence, before)
        # A change that is not finite is not learned: one bad measurement must not spoil the model for ever.
        finite = is_finite(ca.vertcat(parameter_change, *next_memory.values()))
        change = ca.if_else(finite, parameter_change, s.estimate_change)
        values = parameters + 0
        values[places] += change
        remembered = {f"{m}_next": ca.if_else(finite, next_memory[m], before[m]) for m in memory.names}
        return {
            believed.name: values,
            "estimate": values[places],
            "estimate_change_next": change,
            "estimate_begun_next": 1,
            **remembered,
        }

    reads = Layout((plant.state, plant.response_signal("realised"), plant.parameter, acted))
    block = Block("estimate", reads, Layout((believed, estimate)), step, own, opaque=True)
    return block if followed is None else replace(block, reads=reads + followed.reads, derived=followed.derived)


def examples(inner: Controller) -> tuple[Controller, ...]:
    """Values for the laws, around any controller."""
    noise = dict.fromkeys(("a", "b", "a'", "b'"), 1e-3)
    return (Estimating(inner, DisturbanceKalman({"a": 1.0, "b": 1.0}, noise)),)
