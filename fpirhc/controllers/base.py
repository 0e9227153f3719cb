"""The part of a control cycle that all controllers share; the contract itself is in `contract`.

Every controller reads (time, state, realised, parameters) and ends in the same four blocks:

    deform   q^Def from the pair (request, response) of the last cycle and q^Des
    invert   the command that the model needs for q^Def
    limit    clip it; what the clipped command means becomes the stored q^Def (anti-windup)
    judge    one status for the cycle

A command that is not finite never reaches the plant: the last command is held, and the status of the cycle is NON_FINITE.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import casadi as ca

from fpirhc.controllers.contract import Controller as Controller
from fpirhc.controllers.contract import Response as Response
from fpirhc.controllers.contract import checked
from fpirhc.controllers.mirror import measured_state, mirror_blocks, with_measured_state
from fpirhc.deformation.base import Deformation
from fpirhc.plant.plant import Plant
from fpirhc.status import Status
from fpirhc.symbolic.block import Block, Composite, Delay, compose
from fpirhc.symbolic.expression import Signals, is_finite
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar, vector
from fpirhc.symbolic.live import nominal
from fpirhc.task.problem import Problem


def controller_reads(problem: Problem, controller: Controller) -> Layout:
    """Return what a controller reads in every cycle: time, state, realised response, parameters."""
    plant, response = problem.plant, controller.response(problem)
    realised = response.signal if response else plant.response_signal("realised")
    return Layout((plant.time, plant.state, realised, controller.model_plant(problem).parameter))


def compose_controller(problem: Problem, controller: Controller, *, ahead: bool = False) -> Composite:
    """Return the controller as one step: (memory, time, state, realised, parameters) -> (memory, trace, command).

    Args:
        problem: that the controller is composed for.
        controller: checked here against the problem.
        ahead: whether time and state are those at which the command will act. The step then also reads the measured state where a
            block needs it.
    """
    ready = checked(problem, controller)
    blocks, delays = ready.blocks(problem)
    reads, named = controller_reads(problem, ready), with_measured_state(problem.plant, blocks)
    if ahead and len(named) > len(blocks):
        reads, named = reads + Layout((measured_state(problem.plant),)), blocks
    return compose("controller", reads, named, delays, outputs=("command",))


def embedded(name: str, composite: Composite, feeds: dict[str, Signal]) -> Block:
    """Return a composed step as one block.

    Args:
        name: of the block.
        composite: the step.
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


def reference_block(problem: Problem) -> Block:
    """Block (time, state) -> (reference state, response of the controlled coordinates, error of the judged ones)."""
    plant = problem.plant
    function = problem.reference.function(plant)
    controlled = list(plant.controlled_indices)
    places = [plant.state.elements.index(c) for c in problem.judged_names]

    def step(s: Signals) -> dict[str, Expression]:
        state, response = function(s.time)
        return {
            "reference": state,
            "_reference_response": response[controlled],
            "error": state[places] - s.state[places],
        }

    reads = Layout((plant.time, plant.state))
    writes = (
        like(plant.state, "reference"),
        plant.response_signal("_reference_response"),
        error_signal(problem, "error"),
    )
    return Block("reference", reads, Layout(writes), step, opaque=problem.reference.opaque)


def error_signal(problem: Problem, name: str) -> Signal:
    """Return a signal that holds an error of every judged coordinate."""
    units = [problem.plant.coordinates[c] for c in problem.judged_names]
    return vector(name, problem.judged_names, units)


def rename(name: str, source: Signal, target: Signal) -> Block:
    """Block that gives `source` a second name."""
    return Block(name, Layout((source,)), Layout((target,)), lambda s: {target.name: getattr(s, source.name)})


def closing_blocks(
    problem: Problem, deformation: Deformation, judged: Sequence[Signal] = ()
) -> tuple[list[Block], list[Delay]]:
    """Return the blocks deform, invert, limit, judge and running with what they remember; `judged` are solver statuses."""
    plant = problem.plant
    closing, delays = commanding_blocks(problem, judged)
    mirrors, mirror_delays = mirror_blocks(problem, deformation)
    blocks = [*mirrors, deform_block(plant, deformation, problem.warm_up_cycles), invert_block(plant), *closing]
    before = [] if mirrors else [Delay(plant.response_signal("_deformed_last"), "deformed")]
    return blocks, [*delays, *mirror_delays, *before]


def commanding_blocks(problem: Problem, judged: Sequence[Signal] = ()) -> tuple[list[Block], list[Delay]]:
    """Return the blocks limit, judge and running with what they remember, for a controller that writes 'command_unclipped'.

    The controller also writes 'desired', and '_deformed_unclipped': the response that its model expects of this command.
    `judged` are solver statuses.
    """
    delays = [Delay(scalar("warm_up"), "_warm_up_now"), Delay(command_before(problem), "command")]
    return [_limit_block(problem), _judge_block(judged), _warm_up_block(problem.longest_warm_up)], delays


def _warm_up_block(warm_up_cycles: float) -> Block:
    """Block that counts the cycles of a run up to `warm_up_cycles`, after which the response may be used."""

    def step(s: Signals) -> dict[str, Expression]:
        return {"_warm_up_now": ca.fmin(s.warm_up + 1, warm_up_cycles)}

    return Block("running", Layout((scalar("warm_up"),)), Layout((scalar("_warm_up_now"),)), step)


def deform_block(plant: Plant, deformation: Deformation, warm_up_cycles: float = 1) -> Block:
    """Block (request before, realised, desired) -> deformed request; without a valid pair it passes the desired response.

    A model-referenced deformation is given the model's response, '_modelled', in place of the request before.

    Args:
        plant: whose responses are deformed.
        deformation: the map.
        warm_up_cycles: number of cycles, counted by 'warm_up', after which a pair is valid: one, or more where the response is
            estimated from more samples.
    """
    memory = deformation.memory(plant.controlled_names)
    request_before = "_deformed_last" if deformation.mirror is None else "_modelled"
    responses = [plant.response_signal(name) for name in (request_before, "realised", "desired")]
    reads = (*responses, scalar("warm_up"))

    def step(s: Signals) -> dict[str, Expression]:
        remembered = {m: getattr(s, m) for m in memory.names}
        deformed, next_memory = deformation.step(getattr(s, request_before), s.realised, s.desired, remembered)
        valid = s.warm_up > warm_up_cycles - 0.5
        next_values = {f"{m}_next": ca.if_else(valid, next_memory[m], remembered[m]) for m in memory.names}
        shown = {name: next_values[f"{source}_next"] for name, source in deformation.shown().items()}
        next_request = ca.if_else(valid, deformed, s.desired)
        return {"_deformed_unclipped": next_request, "_deformation": next_request - s.desired, **shown, **next_values}

    written = [plant.response_signal(name) for name in ("_deformed_unclipped", "_deformation")]
    logged = [scalar(name) for name in deformation.shown()]
    return Block("deform", Layout(reads), Layout((*written, *logged)), step, memory)


def invert_block(plant: Plant) -> Block:
    """Block (state, _deformed_unclipped, parameters) -> the command that the model needs for it."""
    reads = Layout((plant.state, plant.response_signal("_deformed_unclipped"), plant.parameter))
    inverse = plant.inverse_function

    def step(s: Signals) -> dict[str, Expression]:
        return {"command_unclipped": inverse(s.state, s._deformed_unclipped, s.parameters)}

    return Block("invert", reads, Layout((like(plant.input, "command_unclipped"),)), step, opaque=plant.inverse_opaque)


def _limit_block(problem: Problem) -> Block:
    plant = problem.plant
    lower, upper = problem.limits.input_ends(plant)
    meaning = _meaning(plant)
    reads = (
        like(plant.input, "command_unclipped"),
        plant.response_signal("_deformed_unclipped"),
        plant.response_signal("desired"),
        plant.state,
        plant.parameter,
        like(plant.input, "_command_before"),
    )
    writes = (plant.input, plant.response_signal("deformed"), scalar("clipped"), scalar("_held"))

    def step(s: Signals) -> dict[str, Expression]:
        # Finiteness is checked before the clamp: fmin and fmax turn NaN into a full-scale command.
        finite = is_finite(s.command_unclipped)
        safe = ca.if_else(finite, s.command_unclipped, s._command_before)
        command = clip(safe, lower, upper)
        clipped_request = meaning(s.state, command, safe, s._deformed_unclipped, s.parameters)
        return {
            "command": command,
            "deformed": ca.if_else(finite, clipped_request, s.desired),
            "clipped": ca.mmax(command != s.command_unclipped),
            "_held": 1 - finite,
        }

    return Block("limit", Layout(reads), Layout(writes), step)


def _meaning(plant: Plant) -> ca.Function:
    """Function (state, command, unclipped command, request, parameters) -> the request that the clipped command stands for.

    For a response affine in the inputs this is request + B (command - unclipped command): exactly the request where nothing was
    clipped, without a second evaluation of the model.
    """
    x, u, p = plant.symbols()
    unclipped, r = ca.SX.sym("unclipped", u.numel()), ca.SX.sym("r", len(plant.controlled_names))
    response = plant.controlled_response_function(x, u, p)
    shifted = r + ca.mtimes(ca.jacobian(response, u), u - unclipped)
    meaning = shifted if plant.affine else ca.if_else(ca.mmax(u != unclipped), response, r)
    return ca.Function("fpirhc_meaning", [x, u, unclipped, r, p], [ca.densify(meaning)])


def clip(u: Expression, lower: Iterable[float], upper: Iterable[float]) -> Expression:
    """Return u clipped entry by entry; a side without a finite limit adds no operation."""
    entries = []
    for k, (low, high) in enumerate(zip(lower, upper, strict=True)):
        entry = u[k] if math.isinf(nominal(low)) else ca.fmax(u[k], low)
        entries.append(entry if math.isinf(nominal(high)) else ca.fmin(entry, high))
    return ca.vertcat(*entries)


def _judge_block(judged: Sequence[Signal]) -> Block:
    reads = Layout((scalar("_held"), *judged))

    def step(s: Signals) -> dict[str, Expression]:
        worst: Expression = s._held * int(Status.NON_FINITE)
        for signal in judged:
            worst = ca.fmax(worst, getattr(s, signal.name))
        return {"status": worst}

    return Block("judge", reads, Layout((scalar("status"),)), step)


def command_before(problem: Problem) -> Signal:
    """Return the signal of the last command; in the first cycle it is the input before it."""
    plant = problem.plant
    return Signal("_command_before", plant.input.elements, plant.input.units, tuple(map(float, problem.inputs_before)))


def like(signal: Signal, name: str) -> Signal:
    """Return a signal of the same shape and units under another name."""
    return Signal(name, signal.elements, signal.units)
