"""Controllers with another model than the problem's: the exact one, and one that is learned on line.

    command = controller(state; p + parameter_change),      parameter_change = estimator(state, last command, response; p)

Theory: docs/theory.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import casadi as ca

from fpirhc.controllers.base import Controller
from fpirhc.controllers.believed import Pairs, plant_model
from fpirhc.controllers.built import Built, compose_controller, dependencies_of_command, embedded
from fpirhc.controllers.contract import ControllerWrapper
from fpirhc.errors import require
from fpirhc.learning.disturbance_kalman import DisturbanceKalman
from fpirhc.learning.estimators import ParameterEstimator, Seen
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import Signals, Value, is_finite
from fpirhc.symbolic.layout import Layout, Signal, like, scalar
from fpirhc.task.dead_time import DeadTime
from fpirhc.task.exogenous import signals_of
from fpirhc.task.problem import Problem


@dataclass(frozen=True)
class ExactModel(ControllerWrapper):
    """The wrapped controller with the exact model: the plant's exact parameters, or the reality where the problem has one.

    Args:
        controller: any controller that uses its model.

    Raises:
        NotSupported: an ExternalPlant, or a reality whose coordinates or orders are not the model's.
    """

    exact_model = True

    def inner_problem(self, problem: Problem, name: str = "") -> Problem:  # noqa: ARG002
        model = plant_model(problem, self)
        plant, told = _EXACT.of((model.plant,), (), lambda: _known(model.plant)), signals_of(model.plant, model.signals)
        return _MODELLED.of((problem, plant), (), lambda: replace(problem, plant=plant, reality=None, signals=told))

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        return self.controller.blocks(built.inner(self))


_EXACT: Latest[Plant] = Latest(4)  # so that plans of it are built once


def _known(plant: Plant) -> Plant:
    named = {name: replace(one, approximate=one.exact, spread=None) for name, one in plant.parameters.items()}
    return replace(plant, parameters=named)


_BELIEVED = "_believed"
_MODELS: Latest[Plant] = Latest(8)  # what is built of a model is shared by the problems of one plant
_MODELLED: Latest[Problem] = Latest(8)


@dataclass(frozen=True)
class Estimating(ControllerWrapper):
    """The wrapped controller with the parameters of its model corrected every cycle.

    Behind dead time or an estimator, a response belongs to an older state and command; see `fpirhc.controllers.believed`.

    Args:
        controller: any controller that uses its model.
        estimator: learns the change of the parameters.
        dead_time: that is believed; None: the problem's.
        at_once: whether a new estimate changes the command in every cycle. A receding horizon otherwise holds the inputs of its
            plan, which uses the estimate of the cycle in which it was made.
    """

    once = True

    estimator: ParameterEstimator
    dead_time: DeadTime | None = field(default=None, kw_only=True)
    at_once: bool = field(default=False, kw_only=True)

    def inner_problem(self, problem: Problem, name: str = "") -> Problem:  # noqa: ARG002
        return _MODELLED.of((self.estimator, problem), (), lambda: self._modelled(problem))

    def _modelled(self, problem: Problem) -> Problem:
        plant = problem.plant
        model = _MODELS.of((self.estimator, plant), (), lambda: self.estimator.model(plant))
        return problem if model is problem.plant else replace(problem, plant=model)

    learns = True

    def notes(self, problem: Problem) -> tuple[str, ...]:
        notes, model, names = super().notes(problem), self.inner_problem(problem).plant, self.estimator.learned()
        (x, u, p), equations, places = model.symbols(), model.equations, map(model.parameter.elements.index, names)
        moved = ca.vertcat(equations.rate(x, u, p), equations.controlled_response(x, u, p))
        reached = ca.DM(ca.jacobian_sparsity(moved, p))[:, [*places]].nnz()
        shifts = self.planner is not None and (not self.planner.restarts or self.planner.starts_consistent(model))
        if reached or shifts or self.controller.inner is not None or not all(equations.output_orders.values()):
            return notes
        text = f"no command changes: no rate or response of the model has {', '.join(names)}, and the offset of an output is taken "
        return (*notes, f"{text}from the measurement; name states: {', '.join(problem.plant.coordinates)}")

    def check(self, problem: Problem) -> None:
        """Raise if the estimator does not fit the problem."""
        modelled = self.inner_problem(problem)
        self.estimator.check(modelled)
        if self.dead_time is not None:
            self.dead_time.check(problem.plant, problem.period)
        lost = problem.sensing.believed_response(problem.plant)
        require(
            not (lost and self.estimator.reads_response(modelled.plant)),
            f"{type(self.estimator).__name__} learns from the response, which needs {', '.join(lost)}, and no sensor shows it; "
            "measure it, or use a DisturbanceKalman that measures states alone",
        )
        require(
            self.controller.deforms != "turns",
            f"Estimating needs the response of the controlled coordinates; {type(self.controller).__name__} has others in turn",
        )

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        within = replace(built.inner(self), follows=self.at_once)
        inner, modelled = compose_controller(within), within.problem
        require(
            "parameters" in dependencies_of_command(inner),
            f"Estimating learns parameters of the model, and {type(self.controller).__name__} uses none of them: the command "
            "stays as it is; wrap a controller that uses its model, such as ComputedTorque or RecedingHorizon",
        )
        outputs = self.estimator.reads_outputs(modelled.plant)
        age = built.plant.response_age * self.estimator.reads_response(modelled.plant)
        pairs = replace(built.pairs, dead_time=self.dead_time or built.pairs.dead_time, with_outputs=outputs, age=age)
        believed = Signal(_BELIEVED, modelled.plant.parameter.elements, modelled.plant.parameter.units)
        acted = replace(built.before, name="_acted")
        estimate = _estimate_block(pairs, modelled, self.estimator, believed, acted)
        return [estimate, embedded("controller", inner, {"parameters": believed})], [
            Delay(acted, built.plant.input.name)
        ]


def _estimate_block(
    pairs: Pairs, modelled: Problem, estimator: ParameterEstimator, believed: Signal, acted: Signal
) -> Block:
    """Block (state, realised, parameters, command of the last cycle) -> (corrected parameters, the learned ones among them)."""
    plant, model = pairs.problem.plant, modelled.plant
    names, count = estimator.learned(), len(plant.parameters)
    places = [model.parameter.elements.index(n) for n in names]
    estimate = Signal("estimate", names, tuple(model.parameters[n].unit for n in names))
    memory, correct = estimator.memory(modelled), estimator.step(modelled)
    own = memory + Layout((like(estimate, "estimate_change"), scalar("estimate_begun"), *pairs.memory))

    def step(s: Signals) -> dict[str, Value]:
        parameters = ca.vertcat(s.parameters[:count], ca.DM(model.approximate[count:]))
        before = {m: getattr(s, m) for m in memory.names}
        state, command, waiting = pairs.pair(s, s._acted)
        output, others = pairs.output(s)
        begun = s.estimate_begun > pairs.cycles - 0.5
        evidence = Seen(state, command, s.realised, parameters, begun, output)
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
            "estimate_begun_next": ca.fmin(s.estimate_begun + 1, pairs.cycles),
            **remembered,
            **waiting,
            **others,
        }

    outputs = (pairs.seen,) * pairs.with_outputs
    reads = Layout((pairs.state, *outputs, plant.response_signal("realised"), plant.parameter, acted))
    return Block("estimate", reads, Layout((believed, estimate)), step, own, opaque=True)


def examples(inner: Controller) -> tuple[Controller, ...]:
    """Values for the laws, around any controller."""
    noise = dict.fromkeys(("a", "b", "a'", "b'"), 1e-3)
    return ExactModel(inner), Estimating(inner, DisturbanceKalman({"a": 1.0, "b": 1.0}, noise))
