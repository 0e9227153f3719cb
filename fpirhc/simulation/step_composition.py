"""What a stepper's step is made of: the controller with its estimators behind a gate, and the names of what it is given."""

from __future__ import annotations

from collections.abc import Mapping

from fpirhc.controllers.base import Controller
from fpirhc.controllers.face import measured_signals
from fpirhc.controllers.gap import across_gaps, gap_of
from fpirhc.controllers.gate import Gate
from fpirhc.controllers.live_settings import LiveSettings
from fpirhc.controllers.seeing import compose_seeing, given_states, raw_signal
from fpirhc.errors import NotSupported
from fpirhc.sensing.base import names_of_responses
from fpirhc.simulation.machine import Watch, machine_step
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.layout import Layout
from fpirhc.task.limits import Interval
from fpirhc.task.problem import Problem


def composed_step(
    live: LiveSettings,
    ready: Controller,
    plausible: Mapping[str, Interval],
    max_age: float | None,
    watch: Watch,
    bridged: int,
) -> tuple[Composite, Layout]:
    """Return the step behind its gate, and the layout of its memory.

    Gate and watch have the numbers of the build, and no live ones.
    """
    gates: list[Gate] = []

    def compose(problem: Problem, controller: Controller) -> Composite:
        gap = gap_of(live.problem, bridged)
        inner = across_gaps(compose_seeing(problem, controller))
        gates.append(Gate(live.problem, inner, plausible=plausible, max_age=max_age, gap=gap))
        return machine_step(live.problem, ready, gates[-1], watch)

    composite = live.composed(compose) if live.paths else compose(live.problem, ready)
    return composite, gates[-1].named(composite.memory)


def measures(problem: Problem, controller: Controller) -> tuple[str, ...]:
    """Return the names of what a step is given: the state and the responses, or what the sensors show."""
    raw, plant, own = raw_signal(problem), problem.plant, controller.response(problem)
    if raw is not None:
        return (*(e for signal in given_states(problem) for e in signal.elements), *raw.elements)
    responses = plant.response_signal("realised") if own is None else own.signal
    motions = (e for signal in measured_signals(plant) for e in signal.elements)
    return (*motions, *names_of_responses(plant.face, responses))


def refuse_unbounded(controller: Controller) -> None:
    """Refuse a controller whose optimiser may take any time.

    Raises:
        NotSupported: its planner's optimiser says that its time has no bound.
    """
    planner = controller.planner
    why = planner.optimiser.unbounded if planner is not None else ""
    if why:
        raise NotSupported(f"{why}; Stepper(..., bounded=False) accepts it away from a machine")
