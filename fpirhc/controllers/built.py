"""A controller built for a problem: everything automatic is chosen and everything is checked once, at `build`; and its one step.

    build(problem, controller) -> Built -> blocks(built) -> raw measurements -> [estimator -> controller] -> command

Blocks are handed the result. They read facts from it, and look nothing up again. A real plant gives the step what its sensors show;
a skipped cycle leaves the estimator's memory as it was, like every other one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import repeat

import casadi as ca

from fpirhc.contraction.delayed import require_converging
from fpirhc.controllers.believed import ACTED, NOW, Pairs, Path, PlantModel, Told, believed_path, measured, plant_model
from fpirhc.controllers.contract import Controller, resolved, tracking_law
from fpirhc.controllers.reference_states import largest_response
from fpirhc.controllers.seeing import against_believed, check_observed, seeing_blocks
from fpirhc.deformation.base import Deformation, against_wrappers
from fpirhc.errors import InvalidProblem, refuse
from fpirhc.fields.kinds import described
from fpirhc.plant.maps import against_lags
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Composite, Delay, compose, fed, rename
from fpirhc.symbolic.driver import plans_are_compiled
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal, like, vector
from fpirhc.task.dead_time import every
from fpirhc.task.problem import Problem


@dataclass(frozen=True, eq=False)
class Built:
    """What blocks are made from."""

    problem: Problem  # as the controller is given it
    controller: Controller  # with every automatic number chosen
    model: PlantModel  # what it knows of its plant
    largest: tuple[float, ...]  # response of every controlled quantity that the limits of the inputs allow
    ends: tuple[list[float], list[float]]  # lower and upper limits of the inputs
    rates: tuple[list[float], list[float]]  # the same of their changes, where these limits are hard
    before: Signal  # the last command; in the first cycle the input before it
    state: Signal  # with its first values
    pairs: Pairs  # state and command of a measured response
    own: tuple[Signal, ...]  # the reference's own signals
    given: tuple[Signal, ...]  # what is given from outside for it
    motion: ca.Function  # (time, own signals) -> (outputs, response) of the reference
    later: ca.Function  # the same one cycle ahead
    aim: Block | None  # that writes the reference's own signals
    error: Signal  # of the judged outputs
    judged: tuple[int, ...]  # their places among the outputs
    warm_up: int  # number of the first cycle whose response may be used
    planned: Problem | None  # the problem as plans have it, with their cost and limits
    follows: bool = False  # whether what the model has learned corrects the inputs of a plan in every cycle

    @property
    def plant(self) -> Plant:
        """The model, in whose signals blocks are written."""
        return self.problem.plant

    @property
    def period(self) -> float:
        """The control cycle."""
        return self.problem.period

    @property
    def told(self) -> Told:
        """What the model is told of signals from outside."""
        return Told(self.model.plant, self.model.signals, self.period)

    @cached_property
    def step(self) -> Composite:
        """Sensing and controller as one step: (memory, time, raw measurements, parameters) -> (memory, trace, command).

        Where nothing is estimated it is `compose_controller`. A loop and a stepper of the same values have the same one.
        """
        (blocks, delays), (seeing, seen) = _blocks_of(self), seeing_blocks(self.problem)
        reads, own = _reads(self, *self.problem.sample), [*seeing, *_measuring(self, blocks), *blocks]
        return _informed(self, reads, own, [*delays, *seen])

    def own_values(self, s: Signals) -> list[Expression]:
        """Return the reference's own signals inside a step."""
        return [getattr(s, signal.name) for signal in self.own]

    def inner(self, wrapper: Controller) -> Built:
        """Return what the controller inside a wrapper is built from."""
        assert wrapper.inner is not None
        return replace(made(wrapper.inner_problem(self.problem), wrapper.inner), follows=self.follows)

    def path(self, deformation: Deformation) -> Path:
        """Return the way of the commands to the model, as a deformation believes it."""
        return believed_path(self.problem, deformation)


_LATEST: Latest[Built] = Latest(8)


def build(problem: Problem, controller: Controller) -> Built:
    """Return the controller built for the problem: the one place where a pair is checked and its automatic numbers are chosen."""
    return made(problem, checked(problem, controller))


def made(problem: Problem, ready: Controller) -> Built:
    """Return what `build` returns, of a controller that has been checked: one inside another, or one with open numbers."""
    return _LATEST.of((problem, ready), (plans_are_compiled(),), lambda: _made(problem, ready))


def _made(problem: Problem, ready: Controller) -> Built:
    plant = problem.plant
    planned = ready.planner.planned(problem) if ready.planner is not None else None
    own, before = problem.own_signals, tuple(map(float, problem.inputs_before))
    units = plant.followed
    return Built(
        problem=problem,
        controller=ready,
        model=plant_model(problem, ready),
        largest=largest_response(problem),
        ends=problem.limits.input_ends(plant),
        rates=tuple(one.tolist() for one in problem.limits.rate_bounds(plant)),
        before=replace(plant.input, name="_command_before", start=before),
        state=replace(plant.state, start=tuple(map(float, problem.start_state))),
        pairs=Pairs(problem, problem.dead_time),
        own=own,
        given=problem.given_signals,
        motion=problem.reference.motion_now(plant),
        later=problem.reference.motion_now(plant, problem.period),
        aim=problem.reference.block(plant, problem.period) if own else None,
        error=vector("error", problem.judged_names, [units[name] for name in problem.judged_names]),
        judged=tuple(plant.output.elements.index(name) for name in problem.judged_names),
        warm_up=problem.warm_up_cycles,
        planned=planned,
    )


_CHECKED: Latest[Controller] = Latest(16)  # a comparison asks for the same controllers again and again


def checked(
    problem: Problem, controller: Controller, *, numbers_only: bool = False, any_gain: bool = False
) -> Controller:
    """Return the resolved controller, checked against the problem.

    Args:
        numbers_only: whether only numbers have changed since the last check, so that what is slow to build need not be built again.
        any_gain: whether no gain is refused: a review asks loops that no run would begin.
    """
    facts = numbers_only, any_gain
    return _CHECKED.of((problem, controller), facts, lambda: _checked(problem, controller, *facts))


def _checked(problem: Problem, controller: Controller, numbers_only: bool, any_gain: bool) -> Controller:
    ready = resolved(problem, controller)
    if ready.inner is not None:
        checked(ready.inner_problem(problem), ready.inner, numbers_only=numbers_only, any_gain=any_gain)
    elif (law := ready.planner.tracking if ready.planner else tracking_law(ready)) is not None:
        law.check(problem.plant, problem.period)
    if numbers_only and ready.inner is None and ready.planner is not None:
        ready.planner.planned(problem)  # which checks the weights of a cost of its own
    else:
        ready.check(problem)
    refuse([*_against_form(problem, ready.deformation), *against_believed(problem, ready)])
    if problem.sensing.observer is not None:
        check_observed(problem)
    if ready.deforms not in ("target", "turns") and not any_gain:  # their own checks judge gains
        require_converging(problem, ready.deformation)
    return ready


def _against_form(problem: Problem, deformation: Deformation) -> Iterator[str]:
    """Reasons against the form, the first one first."""
    plant, form, names = problem.plant, deformation.form, problem.plant.controlled_names
    given = "dead times" if form.weights is None else "weights"
    if form.channels not in (None, len(names)):
        yield (
            f"{type(deformation).__name__}: {form.channels} {given} are given, but the plant has {len(names)} "
            f"controlled coordinates ({', '.join(names)}); give one for each, or one number for all"
        )
    yield from against_wrappers(deformation)
    for setting, values in (("cycles", every(form.cycles)), ("lag", every(form.lag))):
        if form.modelled and len(values) not in (1, len(plant.inputs)):
            own = f"{len(plant.inputs)} inputs ({', '.join(plant.inputs)})"
            yield f"ModelReferenced({setting}={values!r}): the plant has {own}; give one number for each, or one for all"
    yield from (f"{type(deformation).__name__}: {reason}" for reason in against_lags(plant, every(form.lag)))


def _reads(built: Built, *seen: Signal) -> Layout:
    """What a controller reads in every cycle: time, what is seen, parameters, and what a reference is given."""
    return Layout((built.plant.time, *seen, built.model.plant.parameter, *built.given))


def compose_controller(built: Built, *, ahead: bool = False) -> Composite:
    """Return the controller as one step: (memory, time, state, realised, parameters) -> (memory, trace, command).

    `ahead`: whether time and state are those at which the command will act. The step then also reads the measured state
    and the signals of the last cycle, where a block needs them.
    """
    blocks, delays = _blocks_of(built)
    reads = _reads(built, *built.plant.motion, built.plant.response_signal("realised"))
    measuring = _measuring(built, blocks)
    if ahead:
        reads = reads + Layout(tuple(signal for block in measuring for signal in block.writes.signals))
        return _informed(built, reads, blocks, delays, ahead=True)
    return _informed(built, reads, [*measuring, *blocks], delays)


def _measuring(built: Built, blocks: Sequence[Block]) -> list[Block]:
    """Blocks that write what is measured, where some blocks read it: what is given, unless a controller acts on predictions."""
    read = _read_by(blocks)
    return [rename(f"measured_{o.name}", o, measured(o)) for o in built.plant.motion if measured(o).name in read]


def _read_by(blocks: Sequence[Block]) -> set[str]:
    return {name for block in blocks for name in block.reads.names}


def dependencies_of_command(step: Composite) -> frozenset[str]:
    """Return the names of what the command of a composed controller depends on, in its cycle or by the memory in a later one."""
    function = step.function
    results = [function.index_out(name) for name in ("command", "memory_next")]
    reads = enumerate(function.name_in())
    return frozenset(name for k, name in reads if any(function.jac_sparsity(one, k).nnz() for one in results))


def _blocks_of(built: Built) -> tuple[list[Block], list[Delay]]:
    given: object = built.controller.blocks(built)
    pair = given if isinstance(given, tuple) and len(given) == 2 else None
    kinds = (Block, Delay)
    if pair is None or not all(
        isinstance(part, list | tuple) and all(map(isinstance, part, repeat(kind)))
        for part, kind in zip(pair, kinds, strict=True)
    ):
        raise InvalidProblem(
            f"{type(built.controller).__name__}.blocks(built) must return two lists (blocks, delays), got {described(given)}"
        )
    return with_aim(built, pair[0]), list(pair[1])


def with_aim(built: Built, blocks: Sequence[Block]) -> list[Block]:
    """Return the blocks of a controller after the reference's own block, where some of them read its signals."""
    own = {signal.name for signal in built.own}
    return [*([built.aim] if built.aim is not None and own & _read_by(blocks) else []), *blocks]


def _informed(
    built: Built, reads: Layout, blocks: Sequence[Block], delays: Sequence[Delay], *, ahead: bool = False
) -> Composite:
    """Return blocks as one step to the command, behind one of signals from outside; `ahead`: at the time of the command."""
    told = built.told
    compares = bool(told.places) and ACTED in _read_by(blocks)
    first = told.block(remembers=compares and not ahead)
    if first is None:
        return compose("controller", reads, blocks, delays, outputs=("command",))
    reads = reads + Layout(told.reads if compares and ahead else ())
    now = like(told.plant.parameter, NOW)
    return compose(
        "controller", reads, [first, *(fed(b, "parameters", now) for b in blocks)], delays, outputs=("command",)
    )


def embedded(name: str, composite: Composite, feeds: dict[str, Signal]) -> Block:
    """Return a composed step as one block.

    `feeds`: name of a signal that the step reads -> the signal that it is given instead.
    """
    reads = tuple(feeds.get(s.name, s) for s in composite.reads.signals)

    def step(s: Signals) -> dict[str, Expression]:
        memory = composite.memory.join({m: getattr(s, m) for m in composite.memory.names})
        next_memory, trace, *_ = composite.function(memory, *(getattr(s, r.name) for r in reads))
        remembered = {f"{m}_next": v for m, v in composite.memory.split(next_memory).items()}
        return {**composite.trace.split(trace), **remembered}

    return Block(name, Layout(reads), composite.trace, step, composite.memory, composite.opaque)
