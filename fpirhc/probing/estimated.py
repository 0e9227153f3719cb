"""The plant as estimated: the model behind gains, dead times, lags and the recorded drift, as the reality of the problem."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from fpirhc.controllers.reference_states import reference_states
from fpirhc.errors import NotSupported
from fpirhc.plant.chain import require_rates
from fpirhc.plant.parameter import Parameter, outside
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import response_names
from fpirhc.sensing.sensing import Sensor
from fpirhc.simulation.model_as_plant import behind_actuators
from fpirhc.symbolic.layout import Expression, Named
from fpirhc.task.dead_time import DeadTime
from fpirhc.task.disturbance import Noise
from fpirhc.task.exogenous import Samples, Unknown
from fpirhc.task.problem import Problem
from fpirhc.task.reality import Reality

_BEGUN = 0.2  # share of a run from which errors count
_CYCLES = 300  # of a run, where the problem has as many and the record is shorter


def estimated_problem(
    problem: Problem,
    gains: np.ndarray,
    cycles: Sequence[float],
    lags: Sequence[float],
    drift: np.ndarray | None = None,
    noise: Sequence[float] = (),
) -> Problem:
    """Return the problem with the estimated plant as its reality.

    Args:
        gains: Lambda, shape (n, n).
        drift: w by cycle, shape (cycles, n), which ends with its last value; None: there is none.
        noise: rms of the measured response, by controlled coordinate; empty: there is none.
    """
    plant, signals = _plant(problem.plant, gains, drifts=drift is not None)
    own, period = problem.of_model, problem.period
    shortest = min((tau for tau in lags if tau > 0), default=math.inf)
    finer = own.integrator.finer(math.ceil(period / shortest)) if shortest < period else None
    duration, begin, courses = own.duration, own.measure_from, {}
    if drift is not None:
        duration, times = period * max(len(drift), min(own.cycles, _CYCLES)), period * np.arange(len(drift))
        begin = min(begin, _BEGUN * duration)
        courses = {s: Unknown(Samples(times, w)) for s, w in zip(signals, drift.T, strict=True)}
    start: Mapping[str, float] = own.start
    if own.plant.equations.known_on_reference:  # what is judged is what comes after the transient
        start = dict(zip(own.plant.state.elements, map(float, reference_states(own, 2)[:, 0]), strict=True))
    sensing = own.sensing
    if noise and sensing.estimator.shows_response and sensing.observer is None:  # the response itself is measured
        sizes = zip(response_names(own.plant), noise, strict=True)
        noisy = {name: Sensor(noise=Noise(size)) for name, size in sizes if size}
        sensing = replace(sensing, sensors={**sensing.sensors, **noisy})
    actuated = behind_actuators(plant, lags)
    added = [name for name in actuated.coordinates if name not in plant.coordinates]
    at_rest = [float(u) for u, lag in zip(own.inputs_before, lags, strict=True) if lag > 0]
    return replace(
        own,
        plant=problem.plant,
        start=start,
        reality=Reality(actuated, integrator=finer, start=dict(zip(added, at_rest, strict=True))),
        dead_time=DeadTime(inputs={name: c * period for name, c in zip(own.plant.inputs, cycles, strict=True)}),
        signals={**own.signals, **courses},
        disturbances={},
        sensing=sensing,
        duration=duration,
        measure_from=begin,
    )


def gain_name(row: int, column: int) -> str:
    """Return the name of the parameter lambda_ij of an estimated plant."""
    return f"lambda_{row + 1}{column + 1}"


def _plant(model: Plant, gains: np.ndarray, *, drifts: bool) -> tuple[Plant, tuple[str, ...]]:
    """The plant without its lags, and the names of its drifts."""
    without = "the estimated plant of a {} has no equations yet"
    require_rates(model, without.format("map"))
    direct = set(model.controlled_names) == set(model.coordinates)  # else what else the inputs move has to follow
    if model.equations.inverse_opaque and not direct:
        raise NotSupported(without.format("plant of outputs of a model that is not affine in its inputs,"))
    count = len(model.controlled_names)
    signals = tuple(f"drift_{name}" for name in model.controlled_names) if drifts else ()
    known = {n: one if one.outside else replace(one, exact=one.approximate) for n, one in model.parameters.items()}
    added = {gain_name(i, j): Parameter(float(g), float(g), "1") for (i, j), g in np.ndenumerate(gains)}
    courses = {name: outside(0.0, "1") for name in signals}

    def response(*arguments: Named) -> Mapping[str, Expression]:
        *derivatives, u, p = arguments
        x = ca.vertcat(*(derivatives[e.count("'")][e.rstrip("'")] for e in model.state.elements))
        inputs, parameters = (ca.vertcat(*(one[n] for n in names)) for one, names in ((u, model.inputs), (p, known)))
        answers = model.equations.controlled_response(x, inputs, parameters)
        matrix = ca.blockcat([[p[gain_name(i, j)] for j in range(count)] for i in range(count)])
        wanted = matrix @ answers + (ca.vertcat(*(p[name] for name in signals)) if signals else 0)
        if direct:
            return {name: wanted[i] for i, name in enumerate(model.controlled_names)}
        inputs = model.equations.inverse(x, wanted, parameters)
        own = Named(tuple(known), parameters, "parameter")
        return dict(model.response(*derivatives, Named(tuple(model.inputs), inputs, "input"), own))

    vars(response)["__signature__"] = inspect.signature(model.response)
    plant = replace(model, parameters={**known, **added, **courses}, response=response, inverse=None)
    return plant, signals
