"""A certificate of hard limits: they hold for every plant of a box of parameters, not only for those that were run.

The theorem with its proof, and what it does not cover: docs/certificate.md.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import refuse, resolved, tracking_law, with_margins
from fpirhc.fields.checked import checked_call
from fpirhc.fields.kinds import Count
from fpirhc.plant.plant import exact_ranges
from fpirhc.review.guaranteed_tube import Centre, Chains, Expressions, Sweep, Tube, expressions
from fpirhc.review.prediction import check_prediction
from fpirhc.simulation.model_as_plant import exactly
from fpirhc.simulation.simulate import Simulator, simulator
from fpirhc.summary import line
from fpirhc.symbolic.enclosures import Box
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Tracking

_AGREES = 1e-9  # of the largest response: by how much a run may fail the recursion of the proof
_MORE = 1.1  # of what a limit is passed by, which is added to its margin


@dataclass(frozen=True, eq=False)
class LimitsCertificate:
    """Whether the limits of inputs and the hard limits of states hold for every plant of the box; `fp.certify_limits` makes it."""

    controller: Controller  # for which this is said, with the margins of its plans
    failures: tuple[str, ...]  # every inequality that fails, in words; empty where the certificate holds
    box: Mapping[str, tuple[float, float]]  # by parameter, the least and the largest exact value
    contraction: float  # rho, the largest spectral radius of |I - a J|, of its bound entry by entry
    # L by controlled coordinate, the largest rate at which the responses of plant and model part
    drift: Mapping[str, float]
    error: Mapping[str, float]  # e_bar by controlled coordinate, the largest response error of any plant
    # by state, the largest distance at a cycle of any plant from the run in the middle of its piece of the box
    tube: Mapping[str, float]
    lower: np.ndarray  # least states of any plant within every cycle, shape (cycles, nx)
    upper: np.ndarray  # largest ones
    commands: Mapping[str, tuple[float, float]]  # by input, the least and the largest command of any plant

    @property
    def holds(self) -> bool:
        """Whether every inequality holds."""
        return not self.failures

    def __repr__(self) -> str:
        if not self.error:
            return line(self, f"fails: {'; '.join(self.failures)}")
        verdict = "holds" if self.holds else f"fails: {'; '.join(self.failures)}"
        errors = ", ".join(f"{name} {value:.3g}" for name, value in self.error.items())
        return line(self, verdict, f"contraction {self.contraction:.3g}", f"response error at most {errors}")


@checked_call
def certify_limits(
    problem: Problem, controller: Controller, *, mismatch: float, pieces: Count = 1, passes: Count = 6
) -> LimitsCertificate:
    """Return whether the limits hold for every plant whose parameters are within `mismatch` percent of the exact ones.

        certificate = fp.certify_limits(problem, controller, mismatch=5)
        if certificate.holds:
            fp.simulate(problem, certificate.controller, seed=0)

    The controller tracks its reference or its plans (`ComputedTorque`, `RecedingHorizon` with `FromPlan(..., room=...)`) with a law
    without integral and the deformation `ModelReferenced(Affine(...))`. Plans get margins where limits of states may be passed.

    Args:
        problem: measured state and response, no disturbances. The time of the certificate is its duration.
        controller: see above; its automatic settings are chosen here.
        mismatch: percent around the exact parameters, or of their spreads.
        pieces: into how many pieces the range of every parameter is cut. Each piece has a run and bounds of its own, which are
            tighter the smaller it is.
        passes: most times that margins are widened.

    Raises:
        NotSupported: a problem or controller that the theorem does not cover.
        InvalidValue: a mismatch out of range.
    """
    ready = resolved(problem, controller)
    law = _covered_law(problem, ready)
    box = exact_ranges(problem.plant, mismatch)
    boxes = _pieces(box, pieces)
    believed = ready.plant_model(problem).parameters(problem.plant)
    functions, chains = expressions(problem.plant, believed), Chains(problem.plant, problem.period, law)
    given, more = _margins(problem, ready), dict.fromkeys(_hard(problem), 0.0)
    for k in range(passes):
        ready.check(problem)
        tubes = _tubes(problem, ready, boxes, functions, chains, believed)
        certificate = _certificate(problem, ready, box, tubes)
        over = _over(problem, certificate.lower, certificate.upper)
        if not over or ready.planner is None or problem.horizon is None or k + 1 == passes:
            break
        more = {name: own + _MORE * over.get(name, 0.0) for name, own in more.items()}
        margins = {**given, **{name: tuple(m + own for m in given[name]) for name, own in more.items()}}
        if _leaves_nothing(problem, margins):
            break
        ready = with_margins(ready, margins)
    return certificate


def _margins(problem: Problem, ready: Controller) -> dict[str, tuple[float, ...]]:
    """The margins that plans already keep, and zero for every other hard limit of a state; empty without plans."""
    if ready.planner is None or problem.horizon is None:
        return {}
    own = problem.horizon.margins if ready.planner.margins is None else ready.planner.margins
    none = dict.fromkeys(_hard(problem), (0.0,) * problem.horizon.stages)
    return none | {name: tuple(values) for name, values in own.items()}


def _covered_law(problem: Problem, ready: Controller) -> Tracking:
    """Return the law of a controller that the theorem covers."""
    check_prediction(problem, ready, "certificate")
    refuse(f"no certificate for {type(ready).__name__}: {reason}" for reason in _against(problem, ready))
    law = tracking_law(ready) if ready.planner is None else ready.planner.tracking
    assert law is not None
    return law


def _against(problem: Problem, ready: Controller) -> Iterator[str]:
    """What the theorem does not cover."""
    plant, planner = problem.plant, ready.planner
    if plant.outputs or plant.step is not None or not plant.equations.affine:
        yield "the plant is a map, has outputs, or its response is not affine in the inputs"
    if problem.disturbances:
        yield "there are disturbances"
    if not problem.sensing.ideal:
        yield "state or response are estimated or noisy"
    if ready.plant_model(problem).exact:
        yield "its model has the exact parameters of every plant, so there is no box to be certified"
    if not _iterates(problem, ready):
        yield "the deformation must be ModelReferenced(Affine(...)) without dead time, lag or filter"
    if planner is not None and planner.restarts:
        yield "its plans start from the measured state; use RecedingHorizon(..., replanning=FromPlan(law, room=...))"
    if planner is not None and not planner.independent:
        yield "its plans depend on the plant; say what they leave for feedback, FromPlan(law, room={...})"
    if planner is None and tracking_law(ready) is None:
        yield "it has no tracking law"


def _iterates(problem: Problem, ready: Controller) -> bool:
    """Whether the deformation is the recursion of the theorem, by its facts; the run shows whether it is."""
    deformation, names = ready.deformation, problem.plant.controlled_names
    mirror = deformation.mirror
    if mirror is None or np.any(mirror.cycles) or mirror.measurement or mirror.lags:
        return False
    linear = deformation.largest_step() == np.inf and deformation.secant_gain() == deformation.effective_gain()
    return linear and deformation.iteration.weights is None and deformation.memory(names).size == len(names)


def _hard(problem: Problem) -> list[str]:
    limits = problem.limits
    return [e for e in limits.states if e not in limits.soft and e not in limits.prices]


def _pieces(box: Mapping[str, tuple[float, float]], pieces: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """The ends of every piece of the box; a parameter that is known is not cut."""
    lower, upper = (np.array([ends[side] for ends in box.values()]) for side in (0, 1))
    counts = np.where(upper > lower, pieces, 1)
    cuts = [low + (high - low) * np.arange(n + 1) / n for low, high, n in zip(lower, upper, counts, strict=True)]
    places = itertools.product(*(range(int(n)) for n in counts))
    return [
        (
            np.array([c[k] for c, k in zip(cuts, row, strict=True)]),
            np.array([c[k + 1] for c, k in zip(cuts, row, strict=True)]),
        )
        for row in places
    ]


def _tubes(
    problem: Problem,
    ready: Controller,
    boxes: Sequence[tuple[np.ndarray, np.ndarray]],
    functions: Expressions,
    chains: Chains,
    believed: np.ndarray,
) -> list[Tube] | str:
    """The tube of every piece, or the inequality that fails in one."""
    loop, tubes = simulator(problem, ready), []
    for lower, upper in boxes:
        centre = _centre(problem, loop, lower, upper)
        if isinstance(centre, str):
            return centre
        sweep = Sweep(functions, chains, centre, believed, float(ready.deformation.effective_gain()))
        if sweep.residual > _AGREES:
            return f"{_of(lower, upper)} does not follow the recursion of the theorem: its deformation is another one"
        tube = sweep.tube()
        if isinstance(tube, str):
            return f"{tube}; a smaller mismatch, more pieces, a shorter period or another gain may mend it"
        tubes.append(tube)
    return tubes


def _centre(problem: Problem, loop: Simulator, lower: np.ndarray, upper: np.ndarray) -> Centre | str:
    plant = exactly(problem.plant, 0.5 * (lower + upper))
    longer = problem.duration + problem.period  # so that the end of the last cycle is there
    run = loop.run(seed=0, variant=replace(problem, plant=plant, duration=longer))
    if run.stop is not None:
        return f"{_of(lower, upper)} ends early: {run.stop}"
    if run["clipped"].any():
        when = problem.period * int(np.argmax(run["clipped"].ravel() > 0))
        wanted = "wider limits of inputs, more room of FromPlan or a slower law may mend it"
        return f"{_of(lower, upper)} clips a command at t = {when:g} {problem.time_unit}; {wanted}"
    return Centre(run["state"].T, run["command"].T, run["desired"].T, lower, upper)


def _of(lower: np.ndarray, upper: np.ndarray) -> str:
    return f"the run with the exact parameters {np.array2string(0.5 * (lower + upper), precision=4)}"


def _certificate(
    problem: Problem, ready: Controller, box: Mapping[str, tuple[float, float]], tubes: list[Tube] | str
) -> LimitsCertificate:
    plant = problem.plant
    if isinstance(tubes, str):
        nothing = np.zeros((0, plant.state.size))
        return LimitsCertificate(ready, (tubes,), box, np.nan, {}, {}, {}, nothing, nothing, {})
    lower, upper = _hull([t.bounds.states for t in tubes])
    least, most = _hull([t.commands for t in tubes])
    ends = zip(map(float, least.min(axis=1)), map(float, most.max(axis=1)), strict=True)
    commands = dict(zip(plant.inputs, ends, strict=True))
    failures = (*_beyond_inputs(problem, commands), *_beyond_states(problem, lower.T, upper.T))
    drift = _largest(plant.controlled_names, [t.drift for t in tubes])
    error = _largest(plant.controlled_names, [t.errors.max(axis=1) for t in tubes])
    tube = _largest(plant.state.elements, [t.bounds.deviation.max(axis=1) for t in tubes])
    factor = max(t.factor for t in tubes)
    return LimitsCertificate(ready, failures, box, factor, drift, error, tube, lower.T, upper.T, commands)


def _hull(boxes: Sequence[Box]) -> tuple[np.ndarray, np.ndarray]:
    return np.minimum.reduce([b.lower for b in boxes]), np.maximum.reduce([b.upper for b in boxes])


def _largest(names: Sequence[str], rows: Sequence[np.ndarray]) -> dict[str, float]:
    return dict(zip(names, map(float, np.max(rows, axis=0)), strict=True))


def _beyond_inputs(problem: Problem, commands: Mapping[str, tuple[float, float]]) -> list[str]:
    plant, failures = problem.plant, []
    ends = zip(commands.items(), plant.input.entry_units, *problem.limits.input_bounds(plant), strict=True)
    for (name, (low, high)), unit, least, most in ends:
        over = max(high - most, least - low)
        if over > 0:
            failures.append(
                f"input '{name}' may need {low:.4g} to {high:.4g} {unit}, beyond its limits ({least:g}, {most:g}) by {over:.3g}; "
                "so much more room of FromPlan, wider limits or a smaller mismatch may mend it"
            )
    return failures


def _over(problem: Problem, lower: np.ndarray, upper: np.ndarray) -> dict[str, float]:
    """By how much each hard limit of a state may be passed, where it may."""
    least, most = problem.limits.state_bounds(problem.plant)
    if not len(lower):
        return {}
    beyond = np.maximum(upper.max(axis=0) - most, least - lower.min(axis=0))
    hard = _hard(problem)
    return {n: float(b) for n, b in zip(problem.plant.state.elements, beyond, strict=True) if n in hard and b > 0}


def _beyond_states(problem: Problem, lower: np.ndarray, upper: np.ndarray) -> list[str]:
    elements, failures = problem.plant.state.elements, []
    for name, over in _over(problem, lower, upper).items():
        k = elements.index(name)
        unit, limits = problem.plant.state.entry_units[k], problem.limits.states[name]
        when = int(np.argmax(np.maximum(upper[:, k] - limits[1], limits[0] - lower[:, k]))) * problem.period
        failures.append(
            f"state '{name}' may pass its limits {limits} by {over:.3g} {unit} at t = {when:g} {problem.time_unit}; a smaller "
            "mismatch, more pieces, a shorter period, a faster law or wider limits may mend it"
        )
    return failures


def _leaves_nothing(problem: Problem, margins: Mapping[str, Sequence[float]]) -> bool:
    lower, upper = problem.limits.state_bounds(problem.plant)
    places = {e: k for k, e in enumerate(problem.plant.state.elements)}
    return any(2 * max(m) >= upper[places[e]] - lower[places[e]] for e, m in margins.items())
