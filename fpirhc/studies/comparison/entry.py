"""What a comparison knows of one controller: its run, what was measured and predicted, facts for the verdict, what it is given.

All controllers are given the same measurements in every cycle. Which of them a controller uses is read from its composed step:
where the command or the memory depends on one, structurally.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fpirhc.contraction.spectrum import ContractionReport, Spectrum
from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import innermost
from fpirhc.errors import FpirhcError, listed
from fpirhc.plant.chain import measured_signals
from fpirhc.review.grid import review_grid
from fpirhc.review.question import Verdict
from fpirhc.review.questions.integration import discretisation_follows
from fpirhc.review.response_prediction import Prediction
from fpirhc.sensing.base import names_of_responses, response_names
from fpirhc.simulation.lyapunov_view import LyapunovView
from fpirhc.simulation.metrics import Metrics
from fpirhc.simulation.run import Run
from fpirhc.status import Status
from fpirhc.studies.comparison.optimality import Optimality
from fpirhc.studies.comparison.timing import CycleTime, Price
from fpirhc.summary import in_percent
from fpirhc.symbolic.block import Composite
from fpirhc.task.problem import Problem, cycles_per_plan

_SAMPLE = ("state", "output", "realised", "measured", "arrived")


@dataclass(frozen=True)
class Information:
    """What a controller uses, and when."""

    uses: tuple[str, ...]  # names of the measured quantities on which its command depends
    rate: str  # in words: in every cycle, or with every plan
    waits: bool = False  # whether what it learns waits for the next plan


def information(problem: Problem, controller: Controller, loop: Composite, cycles: int) -> Information:
    """Return what a controller uses, and when. `cycles`: from plan to plan; 1 for a controller that does not plan."""
    waits = cycles > 1 and controller.learns and not _acts_at_once(controller)
    return Information(_used(problem, loop), _rate(controller, cycles), waits)


def lines_of(problem: Problem, known: Mapping[str, Information]) -> tuple[str, ...]:
    """Return the lines of a comparison: what all are given, what each uses, and when each acts."""
    if not known:
        return ()
    uses = {name: ", ".join(one.uses) or "nothing measured" for name, one in known.items()}
    acts = _grouped("act", {name: one.rate for name, one in known.items()})
    rounded = [problem.rounded_duration] if problem.rounded_duration else []
    return _given(problem), *_grouped("use", uses), *acts, *rounded


def _given(problem: Problem) -> str:
    plant, sensing = problem.plant, problem.sensing
    names = sensing.measures(plant) if sensing.estimates else (*plant.output.elements, *response_names(plant))
    if sensing.observer is None:  # the state beside outputs too
        beside = [element for signal in measured_signals(plant)[:-1] for element in signal.elements]
        names = (*beside, *(n for n in names if n not in beside))
    names = tuple(dict.fromkeys(names))  # an output of order 0 is its own response
    text = f"all controllers are given {', '.join(names)} in every cycle of {problem.period:.3g} {problem.time_unit}"
    late = problem.dead_time.measurement
    text += f", {late:g} {problem.time_unit} late" if late else ""
    if sensing.estimates:
        text += f"; {type(sensing.estimator).__name__} estimates the response from them"
    believed = sensing.believed(plant)
    return text + (f"; {', '.join(believed)} are believed ({type(sensing.observer).__name__})" if believed else "")


def _grouped(verb: str, texts: Mapping[str, str]) -> list[str]:
    """One line for all controllers of the same text; one line for all where there is one text."""
    groups: dict[str, list[str]] = {}
    for name, text in texts.items():
        groups.setdefault(text, []).append(name)
    if len(groups) == 1:
        [what] = groups
        return [f"every controller {verb}s {what}"]
    return [f"{listed(names)}: {verb if len(names) > 1 else verb + 's'} {what}" for what, names in groups.items()]


def _used(problem: Problem, loop: Composite) -> tuple[str, ...]:
    """Names of the measured quantities on which the controller inside the loop depends, in the order in which they are given."""
    inside = next((b.inside for b in loop.blocks if b.inside is not None), None)
    if inside is None:
        return ()
    used: list[str] = []
    for place, signal in enumerate(inside.reads.signals, start=1):
        if signal.name not in _SAMPLE:
            continue
        names = names_of_responses(problem.plant, signal) if signal.name == "realised" else signal.elements
        columns = {k for result in (0, 2) for k in inside.function.jac_sparsity(result, place).get_triplet()[1]}
        used += [names[k] for k in sorted(columns) if names[k] not in used]
    return tuple(used)


def _acts_at_once(controller: Controller) -> bool:
    """Whether a change of its model changes the command in every cycle; a plan may hold its inputs."""
    return controller.planner is None or controller.planner.follows_model


def _rate(controller: Controller, cycles: int) -> str:
    """The words for when a controller acts."""
    if cycles == 1:
        return "in every cycle"
    between = ["its deformation acts"] if controller.deformation.adapts else []
    between += ["its newest estimate acts"] if controller.learns and _acts_at_once(controller) else []
    text = f"with a new plan every {cycles} cycles"
    text += f", between plans {' and '.join(between)} in every cycle" if between else ""
    if controller.learns and not _acts_at_once(controller):
        text += ", in which a new estimate takes effect"
    return text


@dataclass(frozen=True, eq=False)
class Contraction:
    """Contraction of one adaptive controller.

    Args:
        predicted: largest factor predicted from the symbols along the measured cycles.
        growing: share of these cycles in which it is 1 or more.
        measured: factor measured from the run.
        report: admissible and recommended gains.
        spectrum: eigenvalues of the response Jacobian along the run.
    """

    predicted: float
    growing: float
    measured: float
    report: ContractionReport
    spectrum: Spectrum


@dataclass(frozen=True, eq=False)
class Entry:
    """One controller of a comparison."""

    name: str  # name of the controller
    run: Run
    metrics: Metrics  # metrics of the run
    cycle: CycleTime | None  # time of a control cycle; None for a run that is too short
    adaptive: bool  # whether the controller adapts
    pair: str | None  # name of the same controller without adaptation, if there is one
    contraction: Contraction | None  # contraction of the iteration, if the controller adapts
    optimality: Optimality | None = None  # excess cost of its plans, if it plans
    notes: tuple[str, ...] = ()  # sentences for the report
    lyapunov: LyapunovView | None = None  # Lyapunov function along the run, if one is known
    prediction: Prediction | None = None  # prediction of the response, for the adaptive controller of the headline
    weighed: frozenset[str] | None = None  # judged coordinates that its cost weighs; None: all
    exact: bool = False  # whether its model is exact where the others' is not, so that it should be a bound
    learns: bool = False  # whether its model or its gains change during a run
    # name of the same controller with a model that does not change, for one that learns, if there is one
    fixed: str | None = None
    plan_every: int = 1  # cycles from plan to plan; 1 for a controller that does not plan
    price: Price | None = None  # its time per cycle beside that of its pair
    no_bound: tuple[str, ...] = ()  # why it is no bound, for an exact model that an adapted controller beats
    information: Information | None = None  # what it measures and when it acts; None: not asked
    automatic: tuple[str, ...] = ()  # settings of its deformation that were chosen automatically
    # what a review says of a gain that is too large or too small; empty where it is neither, or was not asked
    reviewed_gain: str = ""
    not_reached: str = ""  # what a review says of wrong parameters that adaptation does not correct; empty likewise


_MUCH = 1e-2  # relative cost above the optimum


def plan_every(problem: Problem, controller: Controller) -> int:
    """Return the number of cycles from plan to plan; 1 where neither the controller nor what it wraps plans."""
    if innermost(controller).planner is None or problem.horizon is None:
        return 1
    return cycles_per_plan(problem.horizon, problem.period)


def has_exact_model(problem: Problem, controller: Controller) -> bool:
    """Whether it is the bound of a controller with a wrong model: exact parameters, nothing adapted, nothing learned."""
    model, real = controller.plant_model(problem), problem.real_plant
    plant = model.plant
    wrong = problem.reality is not None or not np.array_equal(plant.approximate, plant.exact)
    fixed = not controller.deformation.adapts and not controller.learns
    return bool(wrong and fixed and plant is real and np.array_equal(model.parameters(plant), real.exact))


def no_bound_because(
    problem: Problem, controller: Controller, metrics: Metrics, optimality: Optimality | None
) -> tuple[str, ...]:
    """Return why a controller with the exact model need not have the smallest error."""
    reasons = []
    if problem.disturbances:
        reasons.append(f"its model is without the disturbance of {', '.join(problem.disturbances)}")
    if any(problem.dead_time.inputs.values()) or problem.dead_time.measurement:
        reasons.append("dead time stands between its model and the plant")
    reasons += _plans_of(problem, controller, metrics, optimality)
    if not reasons:
        own = "its cost weighs more than the error, so the best plan has not the smallest error"
        reasons = ["its law makes this error with a right model too" if controller.planner is None else own]
    return tuple(reasons)


def _plans_of(problem: Problem, controller: Controller, metrics: Metrics, optimality: Optimality | None) -> list[str]:
    """Reasons that lie in the plans."""
    if controller.planner is None or problem.horizon is None:
        return []
    reasons, every = [], plan_every(problem, controller)
    if every > 1:
        reasons.append(f"it plans every {every} cycles, while a deformation acts in each of them")
    missed = 1 - metrics.statuses.get(Status.OK.name, 0) / max(sum(metrics.statuses.values()), 1)
    if missed > 0 and not (optimality is not None and optimality.reached):
        reasons.append(f"its optimiser did not converge in {in_percent(missed)} of the cycles")
    if optimality is not None and optimality.median > _MUCH:
        reasons.append(f"the cost of its plans is {100 * optimality.median:.2g} % above the converged optimum")
    return reasons + _discretisation(problem, controller)


def _discretisation(problem: Problem, controller: Controller) -> list[str]:
    try:
        answer = discretisation_follows(review_grid(controller.inner_problem(problem), 0.0, 0))
    except FpirhcError:
        return []
    if answer is None or answer.verdict == Verdict.YES:
        return []
    return [f"the discretisation of its horizon does not follow the plant ({answer.evidence})"]
