"""Maps x+ = f(x, u, p): plants that step, and have no differential equation. Theory: docs/theory.md."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.plant.motion import sampling
from fpirhc.symbolic.layout import Expression

if TYPE_CHECKING:
    from fpirhc.plant.plant import Plant

_WHOLE = 1e-6  # share of a step by which a cycle may differ from a whole number of steps


def over(plant: Plant, cycle: float) -> Plant:
    """Return the plant as a controller with this cycle sees it: a map's steps with the command held, or the plant itself."""
    if plant.step is None:
        return plant
    ratio = cycle / plant.step
    count = round(ratio)
    if count < 1 or abs(ratio - count) > _WHOLE:
        unit, below = plant.time_unit, math.floor(ratio)
        lengths = [f"{k * plant.step:g} {unit}" for k in (below, below + 1) if k > 0]
        raise InvalidValue(
            f"period {cycle:g} {unit} is no whole number of the plant's steps of {plant.step:g} {unit}; use {' or '.join(lengths)}"
        )
    return plant if count == plant.steps else replace(plant, steps=count)


def by_single_steps(plant: Plant) -> Plant:
    """Return a map as one sees it that looks after each of its steps; any other plant as it is."""
    return plant if plant.step is None else over(plant, plant.step)


def steps_in(plant: Plant, time: float) -> int:
    """Return how many steps of its own a map makes in a time; one for a plant that moves in between."""
    return 1 if plant.step is None else round(time / plant.step)


def unlike(plant: Plant, model: Plant) -> str:
    """Return how a plant moves otherwise than a model; empty where both step, or neither."""
    if (plant.step is None) == (model.step is None):
        return ""
    return "differential equations, and the model has steps" if plant.step is None else "steps, and the model has none"


def against_lags(plant: Plant, lags: Iterable[float]) -> Iterator[str]:
    """Why its inputs cannot act through lags: what lags in a map is a state, and moves by its steps alone."""
    if plant.step is not None and any(lags):
        yield "a discrete-time plant has no lag; write an actuator as a state of it"


def check_maps(
    model: Plant, real: Plant, lengths: Sequence[float], disturbed: Mapping[str, int], mistakes: Mistakes
) -> None:
    """Add to `mistakes` where a response needs model and reality to step alike, and what is not covered on a map."""
    instant, later = model.at_once, [name for name, order in model.chains.items() if order > 1]
    others = {*(model.controlled or model.chains)} - {*instant}  # for which a derivative is looked for
    if model.step is not None and instant and others:
        mistakes.add(
            f"outputs: {', '.join(instant)} of order 0 beside outputs that steps move: their responses belong to other "
            "cycles, which is not covered; control them by two problems"
        )
    if model.step is not None and any(length % 1 for length in lengths):
        mistakes.add(f"horizon: stages in discrete time are whole steps, got lengths {lengths}")
    ahead = [name for name, order in disturbed.items() if order > 1]
    if model.step is not None and ahead:
        mistakes.add(
            f"disturbances: the output '{ahead[0]}' in discrete time has relative order {disturbed[ahead[0]]}, and its differences "
            "look ahead to unknown disturbances; disturb a state or an input, or an output of order 1"
        )
    if not unlike(real, model):
        return
    if model.step is None and others:
        mistakes.add(
            "reality: it is in discrete time and has no derivatives, which the responses of the model are; write "
            "the model in discrete time with the same step"
        )
    elif model.step is not None and later:
        mistakes.add(
            f"reality: '{later[0]}' has the order {model.chains[later[0]]} in the model's steps, and the reality has "
            "differential equations, in which every input shows within one cycle; write a model in which it does too"
        )


def step_of(plant: Plant, matrix: np.ndarray, time: float) -> np.ndarray:
    """Return the matrix by which x' = A x moves in that time, or delta x = A x in the whole cycles of a map."""
    from scipy.linalg import expm  # only here: the import takes longer than that of the whole package

    if plant.step is None:
        return np.asarray(expm(matrix * time))
    return np.linalg.matrix_power(np.eye(len(matrix)) + sampling(plant) * matrix, round(time / sampling(plant)))


def growth_rates(plant: Plant, modes: np.ndarray) -> np.ndarray:
    """Return with which rates modes grow whose eigenvalues of the rates are s: Re s, or log|1 + T s| / T of a map."""
    if plant.step is None:
        return np.real(modes)
    with np.errstate(divide="ignore"):  # a mode that ends has the rate -inf
        return np.asarray(np.log(np.abs(1 + sampling(plant) * modes)) / sampling(plant))


def time_derivatives(plant: Plant, value: Expression, t: Expression, order: int) -> list[Expression]:
    """Return (y, y', ..., y^(order)) of an expression of the time, of a map its divided forward differences."""
    cycle, column = sampling(plant), [value]
    nodes = [value, *(ca.substitute(value, t, t + k * cycle) for k in range(1, order + 1) if plant.step is not None)]
    for k in range(1, order + 1):
        nodes = [later - earlier for earlier, later in pairwise(nodes)]
        column.append(ca.jacobian(column[-1], t) if plant.step is None else nodes[0] / cycle**k)
    return column


def check_modes(law: object, plant: Plant, gains: Sequence[float]) -> None:
    """Raise if a law with these gains has a mode that does not decay in the cycles of a map; elsewhere nothing is checked."""
    if plant.step is None or not gains:
        return
    cycle = sampling(plant)
    poles = 1 + cycle * np.roots([1.0, *reversed(gains)])
    if np.abs(poles).max() >= 1:
        worst = complex(poles[int(np.abs(poles).argmax())])
        shown = f"{worst.real:.3g}" if abs(worst.imag) < 1e-6 * abs(worst) else f"{worst:.3g}"
        raise InvalidValue(
            f"{law!r}: in cycles of {cycle:g} {plant.time_unit} a mode of the error has the pole z = {shown} "
            f"and does not decay; use a rate below {2 / cycle:g} 1/{plant.time_unit} ({1 / cycle:g} is deadbeat)"
        )
