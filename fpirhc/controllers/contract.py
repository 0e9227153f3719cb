"""The contract of controllers: blocks for a problem, and facts for reviews, studies and reports.

A controller that holds another one in a field is around it: that one is its `inner`. It has the facts of the inner controller, on
the problem that the inner controller is built for, unless it overrides them. So the facts pass through any number of wrappers.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from copy import copy
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, cast, final

from fpirhc.controllers.reference_states import request_along_reference, request_of_commands, request_of_plans
from fpirhc.deformation.base import Deformation, Identity, RequestChange, automatic, scaled_for, with_inner
from fpirhc.errors import require
from fpirhc.fields.checked import Checked, Inner, replaced
from fpirhc.horizon.cost import Cost
from fpirhc.plant.chain import require_derivatives
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.task.checks import cycles_per_plan, cycles_per_stage
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Tracking

if TYPE_CHECKING:
    from fpirhc.controllers.built import Built
    from fpirhc.optimisers import Optimiser

Deforms = Literal["response", "command", "target", "turns"]


@dataclass(frozen=True)
class Planner:
    """How a controller plans over the problem's horizon."""

    optimiser: Optimiser  # that finds the plan
    cost: Cost | None  # of the plan; None: the problem's
    # the law that keeps the plant on the planned motion between plans; None: the plan's first response is the desired one
    tracking: Tracking | None
    # whether a plan on outputs starts at the state at which the model has the measured ones; None: where the response is
    # corrected
    consistent: bool | None = False
    adapts: bool = False  # whether a deformation corrects the response
    independent: bool = False  # whether a plan depends on the plans before it alone, whatever the plant does

    @property
    def restarts(self) -> bool:
        """Whether every plan starts from the measured state."""
        return self.tracking is None

    def corrects(self, plant: Plant) -> bool:
        """Return whether the inverse makes the plant's response that of the plan: a deformation does, or a disturbance of it."""
        return self.adapts or any("'" in name for name in plant.believed)

    def feeds_back(self, plant: Plant) -> bool:
        """Return whether a law or a correction of the response takes back what outputs of order 0 are away from a plan."""
        return self.tracking is not None or self.corrects(plant)

    def starts_consistent(self, plant: Plant) -> bool:
        """Return whether plans start where the model has the measured outputs (`fpirhc.horizon.nominal`)."""
        return bool(plant.beside) and (self.corrects(plant) if self.consistent is None else self.consistent)

    def planned(self, problem: Problem) -> Problem:
        """Return the problem with the plans' cost and share of a stage, and limits that hold for the measured state."""
        costed = problem if self.cost is None else replace(problem, cost=self.cost)
        if costed.horizon is None:
            return costed
        horizon, measured = costed.horizon, self._measured(problem)
        if measured:
            horizon = replace(horizon, measured=measured)
        cycles, stage = (count(horizon, problem.period) for count in (cycles_per_plan, cycles_per_stage))
        if cycles < stage:
            horizon = replace(horizon, share=cycles / stage)
        return costed if horizon is costed.horizon else replace(costed, horizon=horizon)

    def _measured(self, problem: Problem) -> tuple[str, ...]:
        """The limited states that no output shows, where a plan starts at another state than the measured one."""
        plant = problem.plant
        if not (self.restarts and self.starts_consistent(plant)):
            return ()
        return tuple(e for e in plant.equations.hidden if e in problem.limits.states)


class Controller(Checked, ABC):
    """Contract: a frozen value that becomes blocks for a given problem.

    Concrete controllers are frozen dataclasses. `fpirhc.conformance.check_controller` tests that a controller keeps this contract.
    """

    _WRITTEN: ClassVar[str] = "controllers[{}] of a loaded problem file"
    """How a value of a name or a file is written, with the name as {}: for who gives the name alone."""

    if TYPE_CHECKING:

        @property
        def deformation(self) -> Deformation:
            """The deformation in use: a field or a property of every controller; Identity() when there is none."""

        @property
        def inner(self) -> Controller | None:
            """The controller that this one is around, in whatever field it holds it; None for one that stands alone."""

    else:  # no properties, so that dataclasses may have fields of these names
        deformation: Deformation
        inner = Inner()

    def _lacks(self) -> Iterator[str]:
        if not isinstance(getattr(self, "deformation", None), Deformation):
            yield (
                f"{type(self).__name__} has no `deformation`, which its contract Controller asks for: the map in use. Add the "
                "field deformation: Deformation = field(default_factory=Identity); a wrapper has a property that returns "
                "self.inner.deformation, and a law without a map derives from fpirhc.contracts.Undeformed"
            )

    @abstractmethod
    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        """Return the blocks of one control cycle, from (time, state, realised, parameters) to 'command', and what they remember."""

    def inner_problem(self, problem: Problem, name: str = "") -> Problem:  # noqa: ARG002
        """Return the problem that the inner controller is built for; `name`: of the one in a dictionary of several."""
        return problem

    @property
    def exact_model(self) -> bool:
        """Whether it is given the exact parameters of the plant and its signals: a bound to compare with."""
        return False if self.inner is None else self.inner.exact_model

    @property
    def learns(self) -> bool:
        """Whether its model or its gains change during a run."""
        return False if self.inner is None else self.inner.learns

    @property
    def deforms(self) -> Deforms:
        """What its deformation acts on: the desired response, a command, the target of an inner controller, or slots in turn.

        Where it is the target, the response is the output itself; in turn, it is that of another quantity in every slot.
        """
        return "response" if self.inner is None else self.inner.deforms

    @final
    @property
    def planner(self) -> Planner | None:
        """How it plans, by its fields `optimiser`, `cost`, `tracking`, `consistent` and `room`; None without an optimiser."""
        if (optimiser := getattr(self, "optimiser", None)) is None:  # plans along a target are none along the reference
            return None if self.inner is None or self.deforms == "target" else self.inner.planner
        cost, law, consistent, room = (getattr(self, n, None) for n in ("cost", "tracking", "consistent", "room"))
        return Planner(optimiser, cost, law, law is not None or consistent, self.deformation.adapts, room is not None)

    @final
    def with_deformation(self, deformation: Deformation) -> Controller:
        """Return the controller with another deformation; a target that none adapts is the reference, for the inner one alone.

        Raises:
            NotSupported: neither it nor an inner controller has a field `deformation`.
        """
        if (changed := replaced(self, "deformation", deformation)) is None:
            return _with_inside(self, lambda one, _: one.with_deformation(deformation), "deformation")
        if self.inner is None or self.deforms != "target" or deformation.adapts:
            return changed
        return without_deformation(self.inner)

    def notes(self, problem: Problem) -> tuple[str, ...]:
        """Return sentences about the controller on this problem, for a reader of results."""
        return () if self.inner is None else self.inner.notes(self.inner_problem(problem))

    def check(self, problem: Problem) -> None:
        """Raise if the controller cannot serve the problem; what it wraps is checked by itself before."""


class Undeformed(Controller, ABC):
    """Contract: a controller that iterates no request."""

    @property
    def deformation(self) -> Deformation:
        """Identity(): no request is iterated."""
        return Identity()


class OfDerivatives(Undeformed, ABC):
    """Contract: a law on derivatives of the controlled quantities below their response."""

    of_time: ClassVar[bool] = False  # whether differences of a map's steps do not serve

    def check(self, problem: Problem) -> None:
        instead = "use ComputedTorque, with a deformation where the model is wrong"
        require_derivatives(problem.plant, type(self).__name__, of_time=self.of_time, instead=instead)


@dataclass(frozen=True)
class ControllerWrapper(Controller, ABC):
    """Contract: a controller around another one, with its deformation."""

    once: ClassVar[bool] = False  # whether it cannot stand around another one of its kind: its signals have fixed names

    controller: Controller

    @property
    def deformation(self) -> Deformation:
        """The deformation of the wrapped controller."""
        return self.controller.deformation


def late_deformation(deformation: Deformation, problem: Problem) -> Deformation:
    """Return the deformation with the dead times, to the nearest whole cycle, and lags of the problem where it leaves them open.

    Inputs that are not one per coordinate have the longest.
    """
    if deformation.inner is not None:
        inner = late_deformation(deformation.inner, problem)
        deformation = deformation if inner is deformation.inner else with_inner(deformation, inner)
    if not is_dataclass(deformation):
        return deformation
    asked = ((f.name, also) for f in fields(deformation) if (also := f.metadata.get("of_problem")))
    left_open = [name for name, also in asked if getattr(deformation, name) is getattr(deformation, also) is None]
    if not left_open:
        return deformation
    lags, inputs, late = problem.moves.lag, tuple(problem.plant.inputs), problem.dead_time
    known = {
        "cycles": late.input_cycles(inputs, problem.period),
        "measurement": (late.measurement_cycles(problem.period),),
        "lag": tuple(lags.get(name, 0.0) for name in inputs),
    }
    square = len(inputs) == len(problem.plant.controlled_names)
    values = {n: known[n] if square and len({*known[n]}) > 1 else max(known[n]) for n in left_open}
    return replace(deformation, **values)


def resolved(problem: Problem, controller: Controller) -> Controller:
    """Return the controller with every automatic setting replaced by its value for this problem, the inner ones first."""
    if controller.inner is not None:
        name = type(controller).__name__
        once = getattr(controller, "once", False) and type(controller) in map(type, _chain(controller.inner))
        require(
            not once,
            f"{name} stands around another {name}; one is enough: leave one out, and give the other the settings of both",
        )
    ready = _with_inside(controller, lambda one, name: resolved(controller.inner_problem(problem, name), one))
    deformation = late_deformation(own := ready.deformation, problem)
    if automatic(deformation) and ready.deforms != "target":  # the reference says nothing of the size of its shifts
        deformation = scaled_for(deformation, _request(problem, ready))
    return ready if deformation is own else ready.with_deformation(deformation)


def _request(problem: Problem, controller: Controller) -> RequestChange:
    """How much what the deformation acts on changes."""
    if controller.deforms == "command":
        return request_of_commands(problem)
    plans = controller.planner is not None
    return request_of_plans(problem) if plans else request_along_reference(problem, tracking_law(controller))


def tracking_law(controller: Controller) -> Tracking | None:
    """Return the law with which a controller tracks the reference: the field `tracking` of the innermost one; None without."""
    inner = innermost(controller)
    return None if inner.planner is not None else getattr(inner, "tracking", None)


def with_field(controller: Controller, name: str, value: object) -> Controller:
    """Return the controller with another content of a field, its own or that of inner ones."""
    if (changed := replaced(controller, name, value)) is not None:
        return changed
    return _with_inside(controller, lambda one, _: with_field(one, name, value), name)


def _with_inside(
    controller: Controller, change: Callable[[Controller, str], Controller], needs: str = ""
) -> Controller:
    """Return the controller around changed ones, with their keys in a dictionary; NotSupported where a field `needs` one inside."""
    if controller.inner is not None:
        inner = change(controller.inner, "")
        return controller if inner is controller.inner else with_inner(controller, inner)
    for name in getattr(controller, "__dataclass_fields__", ()):
        held = getattr(controller, name)
        if isinstance(held, Mapping) and isinstance(next(iter(held.values()), None), Controller):
            changed = {key: change(one, key) for key, one in held.items()}
            same = all(one is held[key] for key, one in changed.items())
            return controller if same else replace(cast("Any", controller), **{name: changed})
    require(not needs, f"{type(controller).__name__} has no {needs} that can be replaced")
    return controller


def _chain(controller: Controller | None) -> Iterator[Controller]:
    while controller is not None:
        yield controller
        controller = controller.inner


def innermost(controller: Controller) -> Controller:
    """The controller inside all others."""
    *_, own = _chain(controller)
    return own


def named_in_task(controller: Controller, name: str) -> Controller:
    """Return the same controller with the name under which a loaded task has it; it is no setting."""
    other = copy(controller)
    object.__setattr__(other, "_task_name", name)
    return other


def name_in_task(controller: Controller) -> str:
    """Return the name under which a loaded task has the controller, else that of its class."""
    return vars(controller).get("_task_name") or type(controller).__name__


def without_deformation(controller: Controller) -> Controller:
    """Return the controller of the same settings that does not adapt, beside which a comparison judges this one."""
    return controller.with_deformation(Identity()) if controller.deformation.adapts else controller
