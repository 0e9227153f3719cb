"""A controller, and sensing with it, as ONE step: from the raw measurements to the command.

    raw measurements -> [estimator -> controller] -> command

A machine gives the step what its sensors show; a skipped cycle leaves the estimator's memory as it was, like every other one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller, like
from fpirhc.controllers.check import checked
from fpirhc.controllers.contract import given_response
from fpirhc.controllers.model_inputs import ACTED, NOW, KnownSignals, measured_reads, with_measured_state
from fpirhc.controllers.observed_state import Believing, check_believed
from fpirhc.controllers.reference_states import given_signals, with_reference
from fpirhc.errors import InvalidProblem
from fpirhc.fields.kinds import described
from fpirhc.plant.chain import measured_signals
from fpirhc.plant.maps import response_age
from fpirhc.plant.motion import time_signal
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import response_names
from fpirhc.symbolic.block import Block, Composite, Delay, compose
from fpirhc.symbolic.driver import plans_are_compiled
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import Signals, Value
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.task.limits import Interval
from fpirhc.task.problem import Problem

_LATEST: Latest[Composite] = Latest(4)
_SHOWN: Latest[np.ndarray] = Latest(8)


def compose_with_sensing(problem: Problem, controller: Controller) -> Composite:
    """Return sensing and controller as one step: (memory, time, raw measurements, parameters) -> (memory, trace, command).

    Where nothing is estimated it is `compose_controller`. A loop and a stepper of the same values have the same one.
    """
    return _LATEST.of((problem, controller), (plans_are_compiled(),), lambda: _composed(problem, controller))


def _composed(problem: Problem, controller: Controller) -> Composite:
    raw = raw_signal(problem)
    if raw is None:
        return compose_controller(problem, controller)
    ready = checked(problem, controller)
    blocks, delays = ready.blocks(problem)
    blocks = with_reference(problem, blocks)
    check_believed(problem, ready)
    believing, reads = _believing(problem), controller_reads(problem, ready).signals
    others = reads[2 + len(measured_signals(problem.plant)) :]
    own = [believing.delay] if believing is not None else []
    every = [*seeing_blocks(problem), *with_measured_state(problem.plant, blocks)]
    return compose_informed(
        problem, ready, Layout((reads[0], *given_states(problem), raw, *others)), every, [*delays, *own]
    )


def given_states(problem: Problem) -> tuple[Signal, ...]:
    """Return the signal of the state where it is given beside raw measurements: these are of outputs, and nothing is believed."""
    estimated = problem.sensing.estimates and problem.sensing.observer is None
    return measured_signals(problem.plant)[:-1] if estimated else ()


def raw_signal(problem: Problem) -> Signal | None:
    """Return the signal of the raw measurements that a step begins with; None where state and response are both measured."""
    if not problem.sensing.estimates:
        return None
    late = problem.dead_time.measurement_wait(problem.period)
    return problem.sensing.raw(problem.plant, first_shown(problem), late)


def sensor_ranges(problem: Problem) -> dict[str, Interval]:
    """Return the stated ranges of the sensors by column of the sample: "state.q1", "realised.q1", "output.y", "measured.q1"."""
    plant, raw = problem.plant, raw_signal(problem)
    signals = measured_signals(plant) if raw is None else (*given_states(problem), raw)
    columns = [
        (column, name) for signal in signals for column, name in zip(signal.columns, signal.elements, strict=True)
    ]
    if raw is None:
        columns += zip(plant.response_signal("realised").columns, response_names(plant), strict=True)
    sensors = problem.sensing.sensors
    stated = {column: sensors[name].range for column, name in columns if name in sensors}
    return {column: ends for column, ends in stated.items() if ends is not None}


def seeing_blocks(problem: Problem) -> list[Block]:
    """Return the blocks from the raw measurements to 'state' and 'realised'; none where both are measured.

    Of a plant with outputs these are estimated, 'output' and 'realised', and 'state' where it is believed.
    """
    raw = raw_signal(problem)
    if raw is None:
        return []
    believing, plant = _believing(problem), problem.plant
    if believing is not None:
        return with_steps_ahead(plant, believing.block)
    selecting, seen = ([], raw) if problem.sensing.measured is None else _selecting(problem, raw)
    start = first_estimates(problem)[0]
    return [*selecting, *with_steps_ahead(plant, problem.sensing.estimator.block(plant, problem.period, start, seen))]


def first_estimates(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Return state, or outputs, and response that sensors without noise show at the start, shapes (nx,) and (n,)."""
    followed = problem.plant.output.elements
    first = _first(problem, followed)
    return np.array([first[e] for e in followed]), _first_values(problem, response_names(problem.plant))


def first_shown(problem: Problem) -> dict[str, float]:
    """Return what sensors without noise show at the start, by name of everything that a sensor may show."""
    plant, (motion, response) = problem.plant, first_estimates(problem)
    names = (*plant.output.elements, *response_names(plant))
    shown = dict(zip(names, map(float, np.concatenate([motion, response])), strict=True))
    return _first(problem, plant.state.elements) | shown


def _first(problem: Problem, quantities: Sequence[str]) -> dict[str, float]:
    """First values of the plant that moves, by name in the model; the model's states where it does not have them."""
    shown = problem.truth.shown(quantities)
    states = dict(zip(problem.plant.state.elements, map(float, problem.start_state), strict=True))
    return states | dict(zip(shown, map(float, _first_values(problem, shown)), strict=True))


def _first_values(problem: Problem, quantities: Sequence[str]) -> np.ndarray:
    """Measured quantities at the start, of the plant that moves."""
    at = problem.real_start, problem.inputs_before, problem.real_parameters, np.zeros(len(problem.real_plant.names))
    known = problem.truth.function(quantities, seen=True)
    return _SHOWN.of((problem,), (tuple(quantities),), lambda: np.asarray(known(*at).full()).ravel())


def _believing(problem: Problem) -> Believing | None:
    raw = raw_signal(problem)
    if raw is None or problem.sensing.observer is None:
        return None
    return Believing(problem, raw, first_estimates(problem)[0])


def _selecting(problem: Problem, raw: Signal) -> tuple[list[Block], Signal]:
    """A block that leaves out what the estimator does not need, and what it needs."""
    names = problem.sensing.estimator.measures(problem.plant)
    places = [raw.elements.index(n) for n in names]
    needed = Signal("_needed", names)
    select = Block("select", Layout((raw,)), Layout((needed,)), lambda s: {needed.name: getattr(s, raw.name)[places]})
    return [select], needed


_MEASURED, _PAST, _COUNT = "_differences", "outputs_expected", "outputs_measured"


def with_steps_ahead(plant: Plant, estimate: Block) -> list[Block]:
    """Return the estimator, and behind it the block that brings its differences to this cycle where an order is above one.

    A law of order r needs y_k, delta y_k ... delta^(r-1) y_k. The forward difference delta^j y_k contains y_{k+1} ... y_{k+j},
    which follow from the state without the command of this cycle, and are measured j cycles later. The model has both at the
    measured states,

        delta^j y_k = y^_j(x_k) + (delta^j y_{k-j} - y^_j(x_{k-j})),      j = 1 ... r - 1.

    With an exact model it is exact, so that a law may be deadbeat. At rest the model does not count, and for short cycles the
    measured difference alone is left. A prediction without the last measured difference would keep the model's error for ever.

    Args:
        plant: a map, or any other plant, whose estimator then stays alone.
        estimate: writes the signal of the outputs, and of the state where it is believed.
    """
    if not response_age(plant) * (max(plant.chains.values()) - 1):
        return [estimate]
    measured = replace(plant.output, name=_MEASURED)

    def step(s: Signals) -> dict[str, Value]:
        return {_MEASURED if name == plant.output.name else name: value for name, value in estimate.step(s).items()}

    writes = Layout(tuple(measured if w.name == plant.output.name else w for w in estimate.writes.signals))
    return [replace(estimate, step=step, writes=writes), _ahead_block(plant, measured)]


def _ahead_block(plant: Plant, measured: Signal) -> Block:
    """Block (differences of the last cycles, state, parameters) -> outputs and their differences at this cycle."""
    elements = plant.output.elements
    powers = [e.count("'") for e in elements]
    x, u, p = plant.symbols()
    no_input, calm = ca.SX.zeros(u.numel()), ca.SX.zeros(len(plant.names))
    expected_at = ca.Function("fpirhc_expected", [x, p], [plant.equations.output(x, no_input, p, calm)])
    past = Signal(_PAST, tuple(f"{e}@{i}" for e, j in zip(elements, powers, strict=True) for i in range(1, j + 1)))
    counted = Signal(_COUNT)

    def step(s: Signals) -> dict[str, Expression]:
        now, arrived = expected_at(s.state, s.parameters), getattr(s, _MEASURED)
        before, count, at = getattr(s, _PAST), getattr(s, _COUNT), 0
        outputs, remembered = [], []
        for k, power in enumerate(powers):
            queue = [now[k], *(before[at + i] for i in range(power))]
            at += power
            brought = now[k] + ca.if_else(count > power - 0.5, arrived[k] - queue[-1], 0)
            outputs.append(brought if power else arrived[k])
            remembered += queue[:power]
        return {
            plant.output.name: ca.vertcat(*outputs),
            f"{_PAST}_next": ca.vertcat(*remembered),
            f"{_COUNT}_next": ca.fmin(count + 1, max(powers)),
        }

    reads = Layout((measured, plant.state, plant.parameter))
    writes, memory = Layout((plant.output,)), Layout((past, counted))
    return Block("steps_ahead", reads, writes, step, memory)


def controller_reads(problem: Problem, controller: Controller) -> Layout:
    """Return what a controller reads in every cycle: time, motion, realised response, parameters, and what a reference is given."""
    plant, response = problem.plant, given_response(problem, controller)
    realised = response.signal if response else plant.response_signal("realised")
    parameters = controller.plant_model(problem).plant.parameter
    return Layout((time_signal(plant), *measured_signals(plant), realised, parameters, *given_signals(problem)))


def compose_controller(problem: Problem, controller: Controller, *, ahead: bool = False) -> Composite:
    """Return the controller as one step: (memory, time, state, realised, parameters) -> (memory, trace, command).

    Args:
        problem: that the controller is composed for.
        controller: checked here against the problem.
        ahead: whether time and state are those at which the command will act. The step then also reads the measured state, its
            time, and the signals of the last cycle, where a block needs them.
    """
    ready = checked(problem, controller)
    blocks, delays = _blocks_of(problem, ready)
    blocks = with_reference(problem, blocks)
    reads = controller_reads(problem, ready)
    if ahead:
        reads = reads + Layout(measured_reads(problem.plant, blocks))
    else:
        blocks = with_measured_state(problem.plant, blocks)
    return compose_informed(problem, ready, reads, blocks, delays, ahead=ahead)


def dependencies_of_command(step: Composite) -> frozenset[str]:
    """Return the names of what the command of a composed controller depends on, in its cycle or by the memory in a later one."""
    function = step.function
    results = [function.index_out(name) for name in ("command", "memory_next")]
    reads = enumerate(function.name_in())
    return frozenset(name for k, name in reads if any(function.jac_sparsity(one, k).nnz() for one in results))


def _blocks_of(problem: Problem, controller: Controller) -> tuple[list[Block], list[Delay]]:
    given: object = controller.blocks(problem)
    pair = given if isinstance(given, tuple) and len(given) == 2 else None
    kinds = (Block, Delay)
    if pair is None or not all(
        isinstance(part, list | tuple) and all(isinstance(one, kind) for one in part)
        for part, kind in zip(pair, kinds, strict=True)
    ):
        raise InvalidProblem(
            f"{type(controller).__name__}.blocks(problem) must return two lists (blocks, delays), got {described(given)}"
        )
    return list(pair[0]), list(pair[1])


def compose_informed(
    problem: Problem, ready: Controller, reads: Layout, blocks: list[Block], delays: list[Delay], *, ahead: bool = False
) -> Composite:
    """Return blocks as one step to the command, behind a block of what the controller is told of signals from outside.

    `ahead`: whether the time is the one at which the command will act.
    """
    model = ready.plant_model(problem)
    known = KnownSignals(model.plant, model.signals, problem.period)
    compares = any(ACTED in block.reads for block in blocks)
    first = known.block(remembers=compares and not ahead)
    if first is None:
        return compose("controller", reads, blocks, delays, outputs=("command",))
    needed = reads + Layout(known.reads if compares else ())
    inner = compose("informed", needed, blocks, delays, outputs=("command",))
    block = embedded("informed", inner, {"parameters": like(known.plant.parameter, NOW)})
    return compose("controller", needed if ahead else reads, [first, block], outputs=("command",))


def embedded(name: str, composite: Composite, feeds: dict[str, Signal]) -> Block:
    """Return a composed step as one block.

    `feeds`: name of a signal that the step reads -> the signal that it is given instead.

    Args:
        feeds: name of a signal that the step reads -> the signal that it is given instead.
    """
    reads = tuple(feeds.get(s.name, s) for s in composite.reads.signals)

    def step(s: Signals) -> dict[str, Expression]:
        memory = composite.memory.join({m: getattr(s, m) for m in composite.memory.names})
        next_memory, trace, *_ = composite.function(memory, *(getattr(s, r.name) for r in reads))
        remembered = {f"{m}_next": v for m, v in composite.memory.split(next_memory).items()}
        return {**composite.trace.split(trace), **remembered}

    return Block(
        name,
        Layout(reads),
        composite.trace,
        step,
        composite.memory,
        opaque=composite.opaque,
        derived=composite.derived_if_any,
    )
