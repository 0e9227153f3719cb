"""Whether the parts of a problem fit together, and what follows from maps among them.

A response of a map is a difference of outputs, which no sensor shows, so it is taken from the outputs of the last cycles
(`StepDifference`); that of an output of order 0 is the output itself, and measured. What is believed, nobody measures; a reality
need not have it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidProblem, InvalidValue, Mistakes
from fpirhc.fields.user_code import named_results, place_of, scalar_expression
from fpirhc.horizon.cost import Cost, Horizon, view_of_symbols
from fpirhc.horizon.transcription import check_names
from fpirhc.plant.chain import differentiated_signals
from fpirhc.plant.maps import check_maps, over
from fpirhc.plant.motion import words
from fpirhc.plant.plant import Plant
from fpirhc.sensing.sensing import Sensing
from fpirhc.symbolic.evaluate import Latest
from fpirhc.task.exogenous import Samples, check_signals
from fpirhc.task.limits import Limits
from fpirhc.task.reality import Reality
from fpirhc.task.reference import pairs

if TYPE_CHECKING:
    from fpirhc.task.problem import Problem

_MOST_CYCLES = 1e9  # of a run; a longer one is a mistake in period or duration
_INSTANTS = 101  # at which signals from outside are tried before a run
_SHOWN = 200  # instants at which a reference is compared with the ranges of sensors


def settled(problem: Problem) -> dict[str, object]:
    """Return the fields of a problem that follow from its period and its maps, by name."""
    mistakes, plant, reality = Mistakes("problem"), problem.plant, problem.reality
    with mistakes.caught():
        plant = over(plant, problem.period)
        if isinstance(reality, Reality) and (moves := over(reality.plant, problem.period)) is not reality.plant:
            reality = replace(reality, plant=moves)
    mistakes.raise_if_any()
    found: dict[str, object] = {"plant": plant, "reality": reality, "dead_time": problem.dead_time.over(problem.period)}
    if problem.sensing.estimator.measures_all and plant.response_age:
        from fpirhc.sensing.differences import StepDifference  # of maps alone

        return found | {"sensing": replace(problem.sensing, estimator=StepDifference())}
    return found


def check_problem(problem: Problem) -> None:
    """Raise with all mistakes of a problem; what needs other parts to fit is checked after them."""
    plant, mistakes = problem.plant, Mistakes("problem")
    _check_times(problem, mistakes)
    _check_start(problem, mistakes)
    mistakes.unknown("judged: quantity", problem.judged or (), plant.followed)
    times = np.linspace(0.0, problem.duration, _INSTANTS)
    check_signals(dict.fromkeys((plant, problem.real_plant)), problem.signals, times, mistakes)
    set_points = {n: one for n, one in problem.reference.set_points.items() if n in plant.chains}
    steps = {name: [value for _, value in pairs(name, one)] for name, one in set_points.items()}
    needed = needed_names(plant, problem.sensing, problem.judged)
    checks = (
        lambda: _check_disturbances(problem),
        lambda: problem.limits.check(plant),
        lambda: check_names(problem.horizon, problem.limits) if problem.horizon else None,
        lambda: _check_reference(problem),
        lambda: check_values(plant, problem.limits, steps),
        lambda: problem.dead_time.check(plant, problem.period),
        lambda: problem.sensing.check(plant),
        lambda: problem.reality.check(plant, *needed) if problem.reality else None,
    )
    for check in checks:
        with mistakes.caught():
            check()
    mistakes.raise_if_any()
    lengths = problem.horizon.lengths if problem.horizon else ()
    check_maps(plant, problem.real_plant, lengths, problem.disturbed_outputs, mistakes)
    mistakes.raise_if_any()
    parts = plant, problem.cost, problem.limits  # which problems share
    mistakes.join(_STAGES.of(parts, (), lambda: _of_stage(*parts)))
    _check_inverse(problem, mistakes)
    courses = {name: problem.signals[name].values for name in differentiated_signals(plant) if name in problem.signals}
    smooth = [name for name, one in courses.items() if callable(one) and not isinstance(one, Samples)]
    if smooth:
        mistakes.add(
            f"signals: the derivatives of outputs depend on {', '.join(smooth)}, whose own derivatives are not stated; state "
            "it in steps, Samples(times, values), which hold between their times, or choose an output without it"
        )
    mistakes.raise_if_any()
    if problem.reality is not None:
        problem.reality.check_motion(problem.real_start, problem.inputs_before, problem.real_integrator, problem.period)


def _check_times(problem: Problem, mistakes: Mistakes) -> None:
    unit = problem.time_unit
    if problem.duration > _MOST_CYCLES * problem.period:
        mistakes.add(
            f"a run of {problem.duration:g} s has more than {_MOST_CYCLES:.0e} cycles of {problem.period:g} s; shorten it"
        )
    if problem.duration < problem.period:
        mistakes.add(f"duration {problem.duration} {unit} is shorter than one period of {problem.period} {unit}")
    if not 0 <= problem.measure_from < problem.duration:
        mistakes.add(f"measure_from must lie in [0, {problem.duration}), got {problem.measure_from}")
    if (horizon := problem.horizon) is not None:
        with mistakes.caught():
            cycles_per_plan(horizon, problem.period, unit)


def cycles_per_stage(horizon: Horizon, period: float, unit: str = "s") -> int:
    """Return how many control cycles one stage of the horizon lasts."""
    ratio = horizon.step / period
    if ratio < 1 - 1e-9 or abs(ratio - round(ratio)) > 1e-6 * ratio:
        whole, slip = max(1, round(ratio)), f"; is {period:g} ms meant?" * (ratio <= 0.1 and unit == "s")
        raise InvalidValue(
            f"period {period:g} {unit} does not divide the horizon step {horizon.step:g} {unit}; "
            f"use a step of {whole * period:.12g} {unit} or a period of {horizon.step / whole:.12g} {unit}{slip}"
        )
    return round(ratio)


def cycles_per_plan(horizon: Horizon, period: float, unit: str = "s") -> int:
    """Return how many control cycles pass from plan to plan."""
    stage = cycles_per_stage(horizon, period, unit)
    if isinstance(horizon.replan, str):
        return stage if horizon.replan == "stage" else 1
    cycles = horizon.replan
    if cycles > stage:
        raise InvalidValue(
            f"a plan every {cycles} cycles is older than its first stage, which lasts {stage} cycles ({horizon.step:g} {unit}); "
            f"use Horizon(replan={stage}) or fewer, or longer stages"
        )
    return cycles


def _check_start(problem: Problem, mistakes: Mistakes) -> None:
    plant = problem.plant
    mistakes.unknown("start: state", problem.start, plant.state.elements)
    for c in plant.names:
        if c not in problem.start:
            mistakes.add(f"start: {words(plant)[0]} '{c}' has no first value; add '{c}': ...")
    for name, value in problem.start.items():
        low, high = plant.ranges.get(name, (-math.inf, math.inf))
        if not low <= value <= high:
            mistakes.add(f"start: '{name}' is {value:g}, outside its physical range of {low:g} to {high:g}")
    mistakes.unknown("input_before: input", problem.input_before, problem.plant.inputs)
    for name, value in problem.input_before.items():
        lower, upper = problem.limits.inputs.get(name, (-math.inf, math.inf))
        if not math.isfinite(value) or not lower <= value <= upper:
            mistakes.add(f"input_before: '{name}' must be a finite number within its limits, got {value!r}")


def _check_reference(problem: Problem) -> None:
    """Raise where the reference is wrong, or not finite at the first or the last instant."""
    function, plant = problem.reference.function(problem.plant), problem.plant
    names = [*plant.output.elements, *(f"{c}{chr(39) * order}" for c, order in plant.chains.items())]
    for t in (0.0, problem.duration):
        values = np.concatenate([np.asarray(part.full()).ravel() for part in function(t)])
        wrong = [f"{name} is {value:g}" for name, value in zip(names, values, strict=True) if not np.isfinite(value)]
        if wrong:
            where = f"reference: at t = {t:g} {problem.time_unit}"
            raise InvalidProblem(f"{where} {', '.join(wrong)}; give a motion that has these values")
    shown = {
        n: s.range for n, s in problem.sensing.sensors.items() if s.range is not None and n in plant.output.elements
    }
    if not shown:
        return
    along = np.asarray(function.map(_SHOWN)(np.linspace(0.0, problem.duration, _SHOWN)[None, :])[0].full())
    for name, (low, high) in shown.items():
        row = along[plant.output.elements.index(name)]
        if row.min() < low or row.max() > high:
            raise InvalidProblem(
                f"sensing: the reference of '{name}' goes from {row.min():.3g} to {row.max():.3g}, but its sensor shows {low:g} to "
                f"{high:g}, and takes the rest for faults; widen Sensor(range=...), or keep the reference within it"
            )


def _check_inverse(problem: Problem, mistakes: Mistakes) -> None:
    """Add a mistake where the response is not finite at the start, or cannot be solved for the inputs there."""
    plant = problem.plant
    sets = {"approximate": plant.approximate}
    sets |= {} if problem.reality else {"exact": plant.exact}  # with a reality these values move nothing
    if mistakes or (plant.controlled is None and len(plant.inputs) != len(plant.chains)):
        return
    state = ", ".join(f"{e} = {v:g}" for e, v in zip(plant.state.elements, problem.start_state, strict=True))
    for which, values in sets.items():
        at, of_plant = (problem.start_state, problem.inputs_before, values), plant.equations
        gain, free = (np.asarray(one(*at).full()) for one in (of_plant.input_gain, of_plant.controlled_response))
        if not np.all(np.isfinite(free)):
            name = plant.controlled_names[int(np.argmin(np.isfinite(free).ravel()))]
            mistakes.add(
                f"the response of '{name}' ({which} parameters) is not finite at the start ({state}); "
                f"start elsewhere, or mend a root or a division in {place_of(plant.response)}"
            )
        elif plant.equations.affine and np.linalg.matrix_rank(gain) < gain.shape[0]:
            weakest = int(np.argmin(np.linalg.norm(gain, axis=0)))
            x, u, p = plant.symbols()
            reached = np.asarray(ca.DM(ca.jacobian_sparsity(plant.equations.rate(x, u, p), u), 1).full())[:, weakest]
            moved = ", ".join(
                f"the rate of {e}" for e, moves in zip(plant.state.elements, reached, strict=True) if moves
            )
            mistakes.add(
                f"the response ({which} parameters) is not invertible at the start ({state}): input "
                f"'{plant.input.elements[weakest]}' has no independent effect there; start elsewhere, give Plant(inverse=...), or "
                f"control what follows from {moved or 'another input'}. In a switch (if_else, floor, sign) it has no slope: write "
                "its mean"
            )


def _check_disturbances(problem: Problem) -> None:
    """Raise if a disturbance is of nothing or has no values, or one of an output not the derivatives that are needed."""
    mistakes, instants = Mistakes("disturbances"), np.array([0.0, problem.period])
    others = (*problem.real_plant.coordinates, *problem.plant.outputs) if problem.moves.simulated else ()
    mistakes.unknown("input, coordinate or output", problem.disturbances, (*problem.plant.inputs, *others))
    for name, one in problem.disturbances.items():
        with mistakes.caught(f"'{name}': "):
            one.values(instants, np.random.default_rng(0))
            if name in problem.disturbed_outputs:
                one.derivative(instants, 1)
    mistakes.raise_if_any()


def needed_names(
    plant: Plant, sensing: Sensing, judged: Sequence[str] | None
) -> tuple[frozenset[str], tuple[str, ...]]:
    """Return the names of the model's coordinates and outputs that what moves must have, and of what is measured."""
    beside = plant.motion[:-1] if sensing.observer is None else ()
    states = [element for signal in beside for element in signal.elements]
    measured = tuple(dict.fromkeys((*states, *sensing.measures(plant))))
    if sensing.observer is None:
        return frozenset((*plant.coordinates, *plant.followed)), measured
    outputs = (element for signal in plant.beside for element in signal.elements)
    shown = (name.rstrip("'") for name in (*measured, *outputs))
    return frozenset((*shown, *(judged or ()), *plant.controlled_names)), measured


_STAGES: Latest[Mistakes] = Latest(8)


def _of_stage(plant: Plant, cost: Cost | None, limits: Limits) -> Mistakes:
    mistakes, view = Mistakes("stage"), view_of_symbols(plant)
    parts = (view.state, view.output, view.reference, view.input, view.input_before, view.feedforward, view.parameters)
    symbols = (*(part.vector for part in parts), view.time)
    if cost is not None:
        with mistakes.caught():
            cost.check(plant)
            terms = named_results("cost", cost.stage(view))
            if not terms:
                mistakes.add("cost: it has no term; return {'name': expression} with one at least")
            for name, term in terms.items():
                scalar_expression(f"cost: term '{name}'", term, symbols=symbols, finite=False)
    for name, path in limits.paths.items():
        with mistakes.caught():
            path.named_value(name, view, symbols)
    return mistakes


def check_values(plant: Plant, limits: Limits, values: Mapping[str, Iterable[float]]) -> None:
    """Raise if a set-point is not finite, or can never be reached."""
    mistakes = []
    for name, numbers in values.items():
        hard = {} if name in limits.prices else limits.states
        ranges = {
            what: ends[name] for what, ends in (("physical range", plant.ranges), ("limits", hard)) if name in ends
        }
        for value in dict.fromkeys(numbers):
            if not math.isfinite(value):
                mistakes.append(f"'{name}' is {value}, expected a finite number")
                continue
            for what, (low, high) in ranges.items():
                if not low <= value <= high:
                    mistakes.append(f"'{name}' is {value:g}, outside its {what} of {low:g} to {high:g}")
    if mistakes:
        raise InvalidValue(f"set-points: {'; '.join(mistakes)}")
