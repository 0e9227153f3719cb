"""What a controller sees: from the raw measurements to state, outputs and response.

A controller is refused states that cannot be right: where no measurement corrects an error, and it stays.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache, partial

import casadi as ca
import numpy as np

from fpirhc.controllers.believed import believe_block, plant_model, stated_path
from fpirhc.controllers.contract import Controller
from fpirhc.controllers.reference_states import reference_inputs, reference_states
from fpirhc.errors import NotSupported
from fpirhc.plant.maps import growth_rates
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import members, slowest, unobservable, values_of
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, Value
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.dead_time import Queue
from fpirhc.task.limits import Interval
from fpirhc.task.problem import Problem


def sensor_ranges(problem: Problem) -> dict[str, Interval]:
    """Return the stated ranges of the sensors by column of the sample: "state.q1", "realised.q1", "output.y", "measured.q1"."""
    columns, sensors = (column for signal in problem.sample for column in signal.columns), problem.sensing.sensors
    stated = {c: sensors[name].range for c, name in zip(columns, problem.sampled, strict=True) if name in sensors}
    return {column: ends for column, ends in stated.items() if ends is not None}


def seeing_blocks(problem: Problem) -> tuple[list[Block], list[Delay]]:
    """Return the blocks from the raw measurements to 'state', [output] and 'realised', and what they remember.

    There are none where state and response are both measured. Of a plant with outputs these are estimated, and 'state' where it is
    believed.
    """
    plant, sensing, raw = problem.plant, problem.sensing, problem.sample[-1]
    if not sensing.estimates:
        return [], []
    start, names = problem.first_output, sensing.estimator.measures(plant)
    if sensing.observer is not None:
        commanded = Delay(stated_path(problem).last, plant.input.name)
        return with_steps_ahead(plant, believe_block(problem, raw, start)), [commanded]
    needed, places = Signal("_needed", names), [raw.elements.index(n) for n in names]
    select = Block("select", Layout((raw,)), Layout((needed,)), lambda s: {"_needed": getattr(s, raw.name)[places]})
    chosen, seen = ([], raw) if sensing.measured is None else ([select], needed)
    return [*chosen, *with_steps_ahead(plant, sensing.estimator.block(plant, problem.period, start, seen))], []


def with_steps_ahead(plant: Plant, estimate: Block) -> list[Block]:
    """Return the estimator, and on a map the block that brings its differences of an order above one to this cycle.

    A law of order r needs y_k, delta y_k ... delta^(r-1) y_k. The forward difference delta^j y_k contains y_{k+1} ... y_{k+j},
    which follow from the state without the command of this cycle, and are measured j cycles later. The model has both at the
    measured states,

        delta^j y_k = y^_j(x_k) + (delta^j y_{k-j} - y^_j(x_{k-j})),      j = 1 ... r - 1.

    With an exact model it is exact. A prediction without the last measured difference would keep the model's error for ever.
    """
    powers = [plant.response_age * e.count("'") for e in plant.output.elements]
    if not any(powers):
        return [estimate]
    measured, (x, u, p) = replace(plant.output, name="_differences"), plant.symbols()
    expected = ca.Function(
        "fpirhc_expected", [x, p], [plant.equations.output(x, 0 * u, p, ca.SX.zeros(len(plant.names)))]
    )
    waits = [(f"ahead_{k}", Queue(power)) for k, power in enumerate(powers)]
    pasts = zip(waits, plant.output.elements, strict=True)
    memory = [m for (name, wait), e in pasts for m in wait.memory(name, (e,), (0.0,))]

    def renamed(s: Signals) -> dict[str, Value]:
        return {measured.name if name == plant.output.name else name: v for name, v in estimate.step(s).items()}

    def step(s: Signals) -> dict[str, Expression]:
        now, arrived = ca.vertsplit(expected(s.state, s.parameters)), ca.vertsplit(getattr(s, measured.name))
        outputs: list[Expression] = []
        later = {"ahead_cycles_next": ca.fmin(s.ahead_cycles + 1, max(powers))}
        for (name, wait), power, own, value in zip(waits, powers, now, arrived, strict=True):
            before, queue = wait.arrived(s, name, own)
            brought = own + ca.if_else(s.ahead_cycles > power - 0.5, value - before, 0)
            outputs, later = [*outputs, brought if power else value], later | queue
        return {plant.output.name: ca.vertcat(*outputs), **later}

    writes = Layout(tuple(measured if w.name == plant.output.name else w for w in estimate.writes.signals))
    reads, own = Layout((measured, plant.state, plant.parameter)), Layout((*memory, scalar("ahead_cycles")))
    ahead = Block("steps_ahead", reads, Layout((plant.output,)), step, own)
    return [replace(estimate, step=renamed, writes=writes), ahead]


_INSTANTS = 25
_STAYS = 1e-9  # share of the fastest pole below which an error counts as staying


@lru_cache(maxsize=8)  # several controllers are checked on one problem
def check_observed(problem: Problem) -> None:
    """Raise where an error of what an observer believes is neither observed nor decays: it stays."""
    plant, observer = problem.plant, problem.sensing.observer
    assert observer is not None
    names = observer.uses(problem.sensing.measures(plant))
    states, slopes, shown = _linearised(problem, names)
    size = np.maximum(np.abs(states).max(axis=0), np.abs(problem.start_state))
    size[size == 0] = 1.0
    scaled = [a * size / size[:, None] for a in slopes]
    basis = unobservable(scaled, [c * size for c in shown])
    pole = slowest(scaled, basis, partial(growth_rates, plant))
    fastest = max(float(np.abs(np.linalg.eigvals(a)).max()) for a in slopes)
    if pole >= -_STAYS * fastest:
        hidden = [plant.state.elements[k] for k in members(basis)]
        raise NotSupported(
            f"{type(observer).__name__}: {' and '.join(hidden)} cannot be observed along the reference from {', '.join(names)}, "
            f"and an error of the estimate does not decay (pole {pole:.3g} 1/{problem.time_unit}); measure {hidden[0]}, or "
            "another quantity that depends on it"
        )


def against_believed(problem: Problem, controller: Controller) -> Iterator[str]:
    """Reasons against believed states: the controller adapts to what is believed, or has a model with other parameters."""
    sensing, plant = problem.sensing, problem.plant
    if sensing.observer is None:
        return
    lost = sensing.believed_response(plant)
    if lost and controller.deformation.adapts:
        yield (
            f"the response that {type(controller.deformation).__name__} compares needs {', '.join(lost)}, which no sensor shows: "
            "the model's own response is the request, from which nothing can be learned. Measure it, or choose an estimator of "
            f"what is measured ({', '.join(sensing.measures(plant))})"
        )
    model = plant_model(problem, controller).plant
    if model.parameter.elements != plant.parameter.elements:
        yield (
            f"{type(controller).__name__} has a model with other parameters than the problem's, and the observer has the "
            "problem's; leave the observer out, or give both the same parameters"
        )


def _linearised(problem: Problem, names: tuple[str, ...]) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """States of the reference, shape (instants, nx), and there dx'/dx and the Jacobian of the measured quantities."""
    plant = problem.plant
    x, u, p = plant.symbols()
    values = values_of(plant, x, u, p)
    shown = ca.vertcat(*(values[n] for n in names))
    rate = plant.equations.rate(x, u, p)
    jacobians = ca.Function("fpirhc_observed", [x, u, p], [ca.jacobian(rate, x), ca.jacobian(shown, x)])
    states, slopes, seen = [], [], []
    along = reference_states(problem, _INSTANTS), reference_inputs(problem, _INSTANTS)
    for state, needed in zip(*(rows.T for rows in along), strict=True):
        slope, part = (np.asarray(m.full()) for m in jacobians(state, needed, plant.approximate))
        if np.isfinite(slope).all() and np.isfinite(part).all():
            states.append(state)
            slopes.append(slope)
            seen.append(part)
    if not slopes:
        raise NotSupported("observed states: the model has no finite Jacobian along the reference")
    return np.array(states), slopes, seen
