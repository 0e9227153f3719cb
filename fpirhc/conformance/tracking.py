"""Laws that every tracking law keeps, tried on ideal plants y_i^(r_i) = u_i with one coordinate per order."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from fpirhc.conformance.laws import frozen_value, hold, keep, within
from fpirhc.controllers.computed_torque import ComputedTorque
from fpirhc.errors import InvalidValue
from fpirhc.plant.motion import places
from fpirhc.plant.plant import Plant
from fpirhc.simulation.simulate import simulate
from fpirhc.symbolic.block import Block, Composite, compose
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.symbolic.expression import Signals, kind
from fpirhc.symbolic.layout import Expression, Layout, Named, Signal, scalar
from fpirhc.task.problem import Problem
from fpirhc.task.reference import Trajectory
from fpirhc.tracking.base import Tracking

Array = npt.NDArray[Any]
Decay = Callable[[Array, int], Array]

_TRIALS = 5
_OFFERED = ("state", "_target", "nominal", "warm_up")  # what a law may read besides its own memory
_LIMITED = ("clipped", "_cut_off", "_held")  # what the update may read besides
_EXACT = 1e-9  # relative
_DECAY = 0.01  # of the first error: the constant command within a cycle costs about rate x period
_WIND = 0.01  # relative change of the desired response that counts as winding up


def check_tracking(
    tracking: Tracking,
    *,
    seed: int,
    orders: Sequence[int] = (2, 1, 3),
    period: float = 1e-3,
    duration: float = 10.0,
    left: float = 0.05,
    decay: Decay | None = None,
) -> None:
    """Check every law on a tracking law.

    Args:
        tracking: the tracking law.
        seed: of errors and memories.
        orders: relative orders of the ideal plants.
        period: of the control cycle, s.
        duration: time after which an error must have decayed, s.
        left: share of the error that may be left then.
        decay: function of (t, order) that gives the promised share of the error over time, for a plant that starts at
            rest; None: no promise.

    Raises:
        AssertionError: the first law that does not hold, in one sentence.
        FpirhcError: the law cannot be used with these orders or this period.
    """
    if not orders or any(order < 1 for order in orders):
        raise InvalidValue(f"check_tracking(orders={tuple(orders)!r}): expected whole numbers of at least 1")
    keep(tracking, _Trial(tracking, tuple(orders), period, duration, left, decay), LAWS, seed)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A tracking law on the ideal plants, and as one cycle of numbers."""

    tracking: Tracking
    orders: tuple[int, ...]
    period: float
    duration: float
    left: float
    decay: Decay | None

    @cached_property
    def plant(self) -> Plant:
        return _ideal(self.orders)

    @cached_property
    def law(self) -> Block:
        return self.tracking.law(self.plant, self.period)

    @cached_property
    def update(self) -> Block:
        return self.tracking.update(self.plant, self.period)

    @cached_property
    def cycle(self) -> Composite:
        """The law and its update as one step (memory, state, target, nominal, warm_up, clipped, cut off, held)."""
        plant = self.plant
        target, cut = Signal("_target", plant.state.elements, plant.state.units), plant.response_signal("_cut_off")
        offered = plant.state, target, plant.response_signal("nominal"), scalar("warm_up"), scalar("clipped"), cut
        blocks, delays = [self.law, self.update], self.tracking.delays(plant)
        reads = Layout((*offered, scalar("_held")))
        return compose("tracking_cycle", reads, blocks, delays, outputs=("desired", "_target_error"))

    @cached_property
    def evaluator(self) -> Evaluator:
        return Evaluator(self.cycle.function)

    def __call__(
        self, memory: Array, state: Array, target: Array, nominal: Array, warm_up: float = 1.0, cut: Array | None = None
    ) -> tuple[Array, Array, Array]:
        """(memory of the next cycle, desired response, error to the target)."""
        cut = np.zeros(len(self.orders)) if cut is None else cut
        clipped = float(np.any(cut != 0))
        after, _, desired, error = self.evaluator(memory, state, target, nominal, warm_up, clipped, cut, 0.0)
        return after, desired, error

    def start(self) -> Array:
        return self.cycle.memory.start()

    def motion(self, generator: np.random.Generator) -> tuple[Array, Array, Array]:
        """A state, a target, and a nominal response."""
        size = self.plant.state.size
        return generator.normal(size=size), generator.normal(size=size), generator.normal(size=len(self.orders))


def _ideal(orders: tuple[int, ...]) -> Plant:
    names = [f"y{k}" for k in range(len(orders))]

    def response(*arguments: Named) -> dict[str, Expression]:
        return {name: arguments[-2][f"u{k}"] for k, name in enumerate(names)}

    argument_names = [*(f"d{k}" for k in range(max(orders))), "u", "p"]
    kind = inspect.Parameter.POSITIONAL_ONLY
    vars(response)["__signature__"] = inspect.Signature([inspect.Parameter(n, kind) for n in argument_names])
    inputs = {f"u{k}": "N" for k in range(len(orders))}
    return Plant(dict.fromkeys(names, "m"), inputs, {}, response, dict(zip(names, orders, strict=True)))


def only_declared_signals(trial: _Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """Both blocks read signals that are offered or remembered, and write exactly the declared signals."""
    delays = trial.tracking.delays(trial.plant)
    law, update, offered = trial.law, trial.update, {*_OFFERED, *(d.now.name for d in delays)}
    for name in ("_target_error", "desired"):
        hold(name in law.writes, f"law() writes {list(law.writes.names)}, but not '{name}'")
        size = law.writes[name].size
        hold(size == len(trial.orders), f"law() writes '{name}' with {size} entries, expected {len(trial.orders)}")
    for delay in delays:
        written = delay.source in {*law.writes.names, *update.writes.names}
        hold(written, f"delays() carries '{delay.source}' on, which neither law() nor update() writes")
    for block, allowed, what in (
        (law, offered, "law()"),
        (update, {*offered, *law.writes.names, *_LIMITED}, "update()"),
    ):
        foreign = sorted(set(block.reads.names) - allowed)
        hold(not foreign, f"{what} reads {foreign}, which are not offered; it may read {sorted(allowed)}")
        matrix = kind(block.opaque)
        symbols = {s.name: matrix.sym(s.name, s.size) for s in [*block.reads.signals, *block.memory.signals]}
        gives = set(block.step(Signals(symbols)))
        expected = {*block.writes.names, *(f"{m}_next" for m in block.memory.names)}
        hold(gives == expected, f"the step of {what} gives {sorted(gives)}, but the block declares {sorted(expected)}")


def error_is_target_minus_state(trial: _Trial, generator: np.random.Generator) -> None:
    """The error that the law passes on is target minus state of every controlled coordinate."""
    for _ in range(_TRIALS):
        state, target, nominal = trial.motion(generator)
        expected = (target - state)[places(trial.plant, 0)]
        _, _, error = trial(trial.start(), state, target, nominal, warm_up=0)
        hold(within(error - expected, _EXACT), f"'_target_error' is {error}, target minus state is {expected}")


def zero_error_asks_for_the_nominal_response(trial: _Trial, generator: np.random.Generator) -> None:
    """On the target, at the start and after it, the desired response is the nominal one."""
    for _ in range(_TRIALS):
        memory = trial.start()
        for cycle in range(_TRIALS):
            state, _, nominal = trial.motion(generator)
            memory, desired, _ = trial(memory, state, state, nominal, warm_up=float(cycle > 0))
            hold(
                within(desired - nominal, _EXACT),
                f"without any error the desired response is {desired} in cycle {cycle}, the nominal response is {nominal}",
            )


def gains_are_what_it_does(trial: _Trial, generator: np.random.Generator) -> None:
    """A law that tells constant gains feeds errors back with them."""
    for k, order in enumerate(trial.orders):
        told = trial.tracking.gains(order)
        if told is None:
            continue
        gains, elements = np.asarray(told), trial.plant.state.elements
        own = [elements.index(trial.plant.names[k] + "'" * s) for s in range(order)]
        hold(len(gains) in (order, order + 1), f"it has {len(gains)} gains for order {order}")
        for _ in range(_TRIALS):
            state, target, nominal = trial.motion(generator)
            memory, desired, error = trial(trial.start(), state, target, nominal)
            _, later, _ = trial(memory, state, state, nominal)
            summed = gains[0] * trial.period * error[k] if len(gains) > order else 0.0
            scale = 1 + float(float(np.abs(gains).max()) * np.abs(target - state).max())
            for what, given, expected in (
                ("with the integral at zero", desired[k], np.dot(gains[-order:], (target - state)[own])),
                (f"one cycle after the error {error[k]:.4g}", later[k], summed),
            ):
                hold(
                    within(given - nominal[k] - expected, _EXACT * scale),
                    f"{what} its feedback for order {order} is {given - nominal[k]:.6g}, its gains {gains} give {expected:.6g}",
                )


def start_forgets(trial: _Trial, generator: np.random.Generator) -> None:
    """The first cycle of a run does not depend on the memory of an earlier run."""
    for _ in range(_TRIALS):
        motion = trial.motion(generator)
        _, fresh, _ = trial(trial.start(), *motion, warm_up=0)
        _, soiled, _ = trial(generator.normal(size=trial.cycle.memory.size), *motion, warm_up=0)
        scale = 1 + float(np.abs(fresh).max())
        hold(
            within(soiled - fresh, _EXACT * scale),
            f"with `warm_up` at 0 an earlier run changes the desired response from {fresh} to {soiled}",
        )


def error_decays(trial: _Trial, generator: np.random.Generator) -> None:
    """On an ideal plant that starts at rest the error goes to zero, as fast as the law promises."""
    names = trial.plant.names
    first = {name: float(generator.uniform(0.5, 2.0) * generator.choice([-1, 1])) for name in names}
    rest = Trajectory(lambda t: dict.fromkeys(names, 0 * t))
    problem = Problem(trial.plant, rest, first, period=trial.period, duration=trial.duration)
    run = simulate(problem, ComputedTorque(trial.tracking), seed=0, compiled=False)
    hold(run.stop is None, f"the loop on an ideal plant diverges: {run.stop}")
    for name, order in zip(names, trial.orders, strict=True):
        share = run[f"error.{name}"] / -first[name]
        left = float(np.abs(share[-1]))
        hold(
            within(left, trial.left),
            f"of an error on an ideal plant of order {order} the share {left:.3g} is left after {trial.duration:g} s, "
            f"more than {trial.left:g}",
        )
        if trial.decay is not None:
            missed = np.abs(share - trial.decay(run.time, order))
            worst = int(np.argmax(np.nan_to_num(missed, nan=np.inf)))
            hold(
                within(missed, _DECAY),
                f"on an ideal plant of order {order} the error's share is {share[worst]:.5g} at t = {run.time[worst]:g} s, "
                f"promised is {trial.decay(run.time, order)[worst]:.5g}",
            )


def clipping_freezes(trial: _Trial, generator: np.random.Generator) -> None:
    """A constant error does not wind the law up further into a limit: its desired response settles."""
    state, target, nominal = trial.motion(generator)
    cycles = round(trial.duration / trial.period)
    memory, halfway, cut_off = trial.start(), np.zeros(0), (target - state)[places(trial.plant, 0)]
    for cycle in range(cycles + 1):
        memory, desired, _ = trial(memory, state, target, nominal, warm_up=float(cycle > 0), cut=cut_off)
        if cycle == cycles // 2:
            halfway = desired
    change, size = np.abs(desired - halfway), np.abs(desired - nominal) + _EXACT
    hold(
        within(change / size, _WIND),
        f"clipped for {trial.duration:g} s at a constant error, the desired response goes from {halfway} at half time to "
        f"{desired}; leave the memory unchanged where the error has the sign of `_cut_off`, or where `clipped` is 1",
    )


def nan_shows(trial: _Trial, generator: np.random.Generator) -> None:
    """A measured coordinate that is not a number gives a desired response that is not one, so that it never acts."""
    for k, place in enumerate(places(trial.plant, 0)):
        state, target, nominal = trial.motion(generator)
        state[place] = np.nan
        _, desired, _ = trial(trial.start(), state, target, nominal)
        hold(
            bool(np.isnan(desired[k])),
            f"'{trial.plant.names[k]}' of NaN is hidden: the desired response is {desired[k]:.6g}",
        )


LAWS = (
    frozen_value,
    only_declared_signals,
    error_is_target_minus_state,
    zero_error_asks_for_the_nominal_response,
    start_forgets,
    nan_shows,
    clipping_freezes,
    error_decays,
    gains_are_what_it_does,
)
