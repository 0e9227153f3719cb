"""A certificate of hard limits: they hold for every plant of a box of parameters, not only for those that were run.

The theorem with its proof, and what it does not cover: docs/certificate.md.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from fpirhc.certificate.tube import Centre, Chains, Expressions, Sweep, Tube
from fpirhc.controllers.base import Controller
from fpirhc.controllers.believed import plant_model
from fpirhc.controllers.contract import resolved, tracking_law
from fpirhc.deformation.affine import Affine
from fpirhc.deformation.base import Form
from fpirhc.deformation.model_referenced import ModelReferenced
from fpirhc.errors import refuse, require
from fpirhc.fields.checked import checked_call
from fpirhc.fields.kinds import Count
from fpirhc.plant.parameter import exact_ranges
from fpirhc.simulation.simulate import Simulator, simulator
from fpirhc.summary import line
from fpirhc.task.problem import Problem

Piece: TypeAlias = tuple[np.ndarray, np.ndarray]  # least and largest parameters

_AGREES = 1e-9  # of the largest response: by how much a run may fail the recursion of the proof
_MORE = 1.1  # of what a limit is passed by, which is added to its margin
_PASSES = 6  # most times that margins are widened


@dataclass(frozen=True, eq=False)
class LimitsCertificate:
    """Whether the limits of inputs and the hard limits of states hold for every plant of the box; `fp.certify_limits` makes it."""

    problem: Problem  # for which this is said: its plans keep the margins that the certificate needs
    controller: Controller  # with its automatic settings chosen
    failures: tuple[str, ...]  # every inequality that fails, in words; empty where the certificate holds
    box: Mapping[str, tuple[float, float]]  # by parameter, the least and the largest exact value
    contraction: float  # rho, the largest spectral radius of |I - a J|, of its bound entry by entry
    drift: Mapping[
        str, float
    ]  # L by controlled coordinate, the largest rate at which responses of plant and model part
    error: Mapping[str, float]  # e_bar by controlled coordinate, the largest response error of any plant
    tube: Mapping[str, float]  # by state, the largest distance of any plant from the run in the middle of its piece
    lower: np.ndarray  # least states of any plant within every cycle, shape (cycles, nx)
    upper: np.ndarray  # largest ones
    commands: Mapping[str, tuple[float, float]]  # by input, the least and the largest command of any plant

    @property
    def holds(self) -> bool:
        """Whether every inequality holds."""
        return not self.failures

    def __repr__(self) -> str:
        verdict = "holds" if self.holds else f"fails: {'; '.join(self.failures)}"
        errors = ", ".join(f"{name} {value:.3g}" for name, value in self.error.items())
        return line(self, verdict, *([f"response error at most {errors}"] if errors else []))


@checked_call
def certify_limits(
    problem: Problem, controller: Controller, *, mismatch: float, pieces: Count = 1
) -> LimitsCertificate:
    """Return whether the limits hold for every plant whose parameters are within `mismatch` percent of the exact ones.

        certificate = fp.certify_limits(problem, controller, mismatch=5)
        if certificate.holds:
            fp.simulate(certificate.problem, certificate.controller, seed=0)

    The controller tracks its reference or its plans (`ComputedTorque`, `RecedingHorizon(..., tracking=law, room=...)`) with a law
    without integral and the deformation `ModelReferenced(Affine(...))`. Plans get margins where limits of states may be passed.
    The theorem and its proof: docs/certificate.md.

    Args:
        problem: measured state and response, no disturbances. The time of the certificate is its duration.
        controller: see above; its automatic settings are chosen here.
        mismatch: percent around the exact parameters, or of their spreads.
        pieces: into how many pieces the range of every parameter is cut. Each piece has a run and bounds of its own, which are
            tighter the smaller it is.

    Raises:
        NotSupported: a problem or controller that the theorem does not cover.
        InvalidValue: a mismatch out of range.
    """
    ready = resolved(problem, controller)
    refuse(f"no certificate for {type(ready).__name__}: {reason}" for reason in _against(problem, ready))
    box, plant = exact_ranges(problem.plant.parameters, mismatch), problem.plant
    believed = plant_model(problem, ready).parameters(plant)
    functions, chains = Expressions(plant, believed), Chains(plant, problem.period, _gains(problem, ready))
    plans, margins = ready.planner is not None, dict.fromkeys(_hard(problem), 0.0)
    own = dict(problem.horizon.margins) if problem.horizon is not None else {}
    for last in (*[False] * (_PASSES - 1), True):
        ready.check(problem)
        tubes = _tubes(problem, ready, _pieces(box, pieces), functions, chains, believed)
        certificate = _certificate(problem, ready, box, tubes)
        over = _over(problem, certificate.lower, certificate.upper)
        if not over or not plans or problem.horizon is None or last:
            break
        margins = {name: least + _MORE * over.get(name, 0.0) for name, least in margins.items()}
        wider = {name: own.get(name, 0.0) + more for name, more in margins.items()}
        if any(2 * m >= np.ptp(problem.limits.states[name]) for name, m in wider.items()):  # nothing is left
            break
        problem = replace(problem, horizon=replace(problem.horizon, margins=wider))
    return certificate


def _gains(problem: Problem, ready: Controller) -> dict[str, tuple[float, ...]]:
    """Constant gains of the law, by controlled coordinate."""
    law = tracking_law(ready) if ready.planner is None else ready.planner.tracking
    orders = dict(zip(problem.plant.names, problem.plant.orders, strict=True))
    every = {n: None if law is None else law.gains(orders[n]) for n in problem.plant.controlled_names}
    gains = {name: one for name, one in every.items() if one is not None and len(one) == orders[name]}
    require(
        len(gains) == len(every),
        f"no certificate with {type(law).__name__}: its gains must be constant and it must not integrate, such as "
        "Exponential(rate=..., integral=False); the deformation removes what is constant",
    )
    return gains


def _against(problem: Problem, ready: Controller) -> Iterator[str]:
    """What the theorem does not cover."""
    plant, planner, deformation = problem.plant, ready.planner, ready.deformation
    if plant.beside or plant.response_age or not plant.equations.affine:
        yield "the plant is in discrete time, has outputs, or its response is not affine in the inputs"
    rated = problem.limits.rates.keys() - problem.limits.prices.keys()
    if problem.disturbances or problem.reality is not None or problem.signals or rated:
        yield "there are disturbances, signals from outside, hard limits of rates, or a reality that is not the plant"
    if not problem.sensing.ideal or problem.dead_time.measurement or any(problem.dead_time.inputs.values()):
        yield "state or response are estimated, noisy or late"
    if ready.exact_model:
        yield "its model has the exact parameters of every plant, so there are no other plants to be certified"
    if ready.learns or ready.inner is not None or ready.deforms != "response":
        yield "its model, state or command is changed beside the deformation"
    plain = type(deformation) is ModelReferenced and type(deformation.map) is Affine and deformation.map.weights is None
    if not plain or deformation.form != Form("model"):
        yield "the deformation must be ModelReferenced(Affine(gain=...)) without dead time, lag, weights or filter"
    if planner is None and tracking_law(ready) is None:
        yield "it has no tracking law"
    if planner is not None and planner.restarts:
        yield "its plans start from the measured state; use RecedingHorizon(..., tracking=law, room=...)"
    if planner is not None and not planner.independent:
        yield "its plans depend on the plant; say what they leave for feedback, RecedingHorizon(..., room={...})"


def _hard(problem: Problem) -> list[str]:
    limits = problem.limits
    return [e for e in limits.states if e not in limits.prices]


def _pieces(box: Mapping[str, tuple[float, float]], pieces: int) -> Iterator[Piece]:
    """The ends of every piece of the box; a parameter that is known is not cut."""
    cuts = [np.linspace(low, high, pieces + 1 if high > low else 2) for low, high in box.values()]
    for row in itertools.product(*(range(len(c) - 1) for c in cuts)):
        ends = [(c[k], c[k + 1]) for c, k in zip(cuts, row, strict=True)]
        yield np.array([low for low, _ in ends]), np.array([high for _, high in ends])


def _tubes(
    problem: Problem,
    ready: Controller,
    boxes: Iterable[Piece],
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
            return f"the run with the parameters {centre.parameters} does not follow the recursion: its deformation is another one"
        tube = sweep.tube()
        if isinstance(tube, str):
            return f"{tube}; a smaller mismatch, more pieces, a shorter period or another gain may mend it"
        tubes.append(tube)
    return tubes


def _centre(problem: Problem, loop: Simulator, lower: np.ndarray, upper: np.ndarray) -> Centre | str:
    longer = replace(problem, duration=problem.duration + problem.period)  # so that the end of the last cycle is there
    middle = 0.5 * (lower + upper)
    run = loop.run(seed=0, variant=longer.with_exact(middle))
    if run.stop is not None:
        return f"the run with the parameters {middle} ends early: {run.stop}"
    if run["clipped"].any():
        when = problem.period * int(np.argmax(run["clipped"].ravel() > 0))
        return (
            f"the run with the parameters {middle} clips a command at t = {when:g} {problem.time_unit}; wider limits of inputs, "
            "more room or a slower law may mend it"
        )
    return Centre(run["state"].T, run["command"].T, run["desired"].T, lower, upper)


def _certificate(
    problem: Problem, ready: Controller, box: Mapping[str, tuple[float, float]], tubes: list[Tube] | str
) -> LimitsCertificate:
    plant = problem.plant
    if isinstance(tubes, str):
        nothing = np.zeros((0, plant.state.size))
        return LimitsCertificate(problem, ready, (tubes,), box, np.nan, {}, {}, {}, nothing, nothing, {})
    lower = np.min([t.bounds.states.lower for t in tubes], axis=0).T
    upper = np.max([t.bounds.states.upper for t in tubes], axis=0).T
    least = np.min([t.commands.lower.min(axis=1) for t in tubes], axis=0)
    most = np.max([t.commands.upper.max(axis=1) for t in tubes], axis=0)
    commands = {name: (float(a), float(b)) for name, a, b in zip(plant.inputs, least, most, strict=True)}
    failures = *_beyond_inputs(problem, commands), *_beyond_states(problem, lower, upper)
    drift, error, tube = (
        dict(zip(names, np.max(rows, axis=0).tolist(), strict=True))
        for names, rows in (
            (plant.controlled_names, [t.drift for t in tubes]),
            (plant.controlled_names, [t.errors.max(axis=1) for t in tubes]),
            (plant.state.elements, [t.bounds.deviation.max(axis=1) for t in tubes]),
        )
    )
    factor = max(t.factor for t in tubes)
    return LimitsCertificate(problem, ready, failures, box, factor, drift, error, tube, lower, upper, commands)


def _beyond_inputs(problem: Problem, commands: Mapping[str, tuple[float, float]]) -> Iterator[str]:
    plant = problem.plant
    ends = zip(commands.items(), plant.input.entry_units, *problem.limits.input_bounds(plant), strict=True)
    for (name, (low, high)), unit, least, most in ends:
        over = max(high - most, least - low)
        if over > 0:
            yield (
                f"input '{name}' may need {low:.4g} to {high:.4g} {unit}, beyond its limits ({least:g}, {most:g}) by {over:.3g}; "
                "so much more room, wider limits or a smaller mismatch may mend it"
            )


def _over(problem: Problem, lower: np.ndarray, upper: np.ndarray) -> dict[str, float]:
    """By how much each hard limit of a state may be passed, where it may."""
    least, most = problem.limits.state_bounds(problem.plant)
    if not len(lower):
        return {}
    beyond = np.maximum(upper.max(axis=0) - most, least - lower.min(axis=0))
    hard = _hard(problem)
    return {n: float(b) for n, b in zip(problem.plant.state.elements, beyond, strict=True) if n in hard and b > 0}


def _beyond_states(problem: Problem, lower: np.ndarray, upper: np.ndarray) -> Iterator[str]:
    elements, units = problem.plant.state.elements, problem.plant.state.entry_units
    for name, over in _over(problem, lower, upper).items():
        k, limits = elements.index(name), problem.limits.states[name]
        when = int(np.argmax(np.maximum(upper[:, k] - limits[1], limits[0] - lower[:, k]))) * problem.period
        yield (
            f"state '{name}' may pass its limits {limits} by {over:.3g} {units[k]} at t = {when:g} {problem.time_unit}; a smaller "
            "mismatch, more pieces, a shorter period, a faster law or wider limits may mend it"
        )
