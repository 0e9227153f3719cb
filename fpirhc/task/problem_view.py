"""A problem on one line, and as a table for a notebook: times, start, limits, plan, and what disturbs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from fpirhc.plant.plant_view import plant_facts
from fpirhc.summary import number, table

if TYPE_CHECKING:
    from fpirhc.task.problem import Problem


def problem_facts(problem: Problem) -> tuple[str, ...]:
    """Return what sums up a problem: its name, its cycles, its quantities."""
    named = (problem.name,) if problem.name else ()
    return *named, f"{problem.cycles} cycles of {problem.period:g} {problem.time_unit}", *plant_facts(problem.plant)


def problem_table(problem: Problem) -> str:
    """Return HTML: one fact per row; what the problem does not have is left out."""
    title = f"Problem {problem.name}".strip()
    rows = [*_times(problem), *_limits(problem), *_others(problem)]
    return table(title, ("", "value"), rows, [f"Plant: {'; '.join(plant_facts(problem.plant))}."])


def _times(problem: Problem) -> list[tuple[str, str]]:
    unit, horizon = problem.time_unit, problem.horizon
    rows = [
        ("run", f"{problem.cycles} cycles of {problem.period:g} {unit}, {problem.duration:g} {unit} in all"),
        ("measured from", f"{problem.measure_from:g} {unit}"),
        ("start", _values(dict(zip(problem.plant.state.elements, problem.start_state, strict=True)))),
        ("judged", ", ".join(problem.judged_names)),
    ]
    if horizon is not None:
        rows.append(("horizon", f"{horizon.stages} stages of {horizon.step:g} {unit}"))
    return rows


def _limits(problem: Problem) -> list[tuple[str, str]]:
    limits, plant = problem.limits, problem.plant
    states = dict(zip(plant.state.elements, plant.state.entry_units, strict=True))
    rates = {name: plant.derivative_unit(unit, 1) for name, unit in plant.inputs.items()}
    rows = [(f"limits of {name}", _interval(ends, plant.inputs[name])) for name, ends in limits.inputs.items()]
    rows += [(f"limits of {name}", _interval(ends, states[name])) for name, ends in limits.states.items()]
    rows += [(f"limits of the rate of {name}", _interval(ends, rates[name])) for name, ends in limits.rates.items()]
    rows += [(f"limits of {name}", _interval((p.lower, p.upper), p.unit)) for name, p in limits.paths.items()]
    return rows


def _others(problem: Problem) -> list[tuple[str, str]]:
    unit, late = problem.time_unit, problem.dead_time
    rows = [(f"dead time of {name}", f"{value:g} {unit}") for name, value in late.inputs.items()]
    if late.measurement:
        rows.append(("dead time of the measurement", f"{late.measurement:g} {unit}"))
    rows += [(f"disturbance of {name}", type(one).__name__) for name, one in problem.disturbances.items()]
    if problem.symbolic_reality is not None:
        rows.append(("reality", "; ".join(plant_facts(problem.real_plant))))
    if problem.foreign is not None:
        rows.append(("reality", f"{type(problem.foreign.body).__name__}, outside"))
    if not problem.sensing.ideal:
        rows.append(("sensing", "with sensors or an estimator"))
    believed = problem.sensing.believed(problem.plant)
    if believed:
        rows.append(("measured", ", ".join(problem.sensing.measures(problem.plant))))
        rows.append(("believed", f"{', '.join(believed)}, by {type(problem.sensing.belief).__name__}"))
    return rows


def _interval(ends: tuple[float, float], unit: str) -> str:
    return f"{number(ends[0])} to {number(ends[1])} {unit}".strip()


def _values(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name} = {number(value)}" for name, value in values.items())
