"""Laws that every tracking law keeps, tried on ideal plants y_i^(r_i) = u_i with one coordinate per order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from fpirhc.conformance.laws import Array, Broken, Draw, keep, within
from fpirhc.controllers.computed_torque import ComputedTorque
from fpirhc.errors import InvalidValue
from fpirhc.plant.motion import places
from fpirhc.plant.plant import Plant
from fpirhc.simulation.simulate import simulate
from fpirhc.symbolic.block import Composite, compose
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.symbolic.layout import Layout, Signal, scalar
from fpirhc.task.problem import Problem
from fpirhc.task.reference import Trajectory
from fpirhc.tracking.base import Tracking

_TRIALS = 5
_EXACT = 1e-9  # relative
_LEFT = 0.05  # share of an error that may be left
_WIND = 0.01  # relative change of the desired response that counts as winding up


def check_tracking(
    tracking: Tracking, *, seed: int, orders: Sequence[int] = (2, 1, 3), period: float = 1e-3, duration: float = 10.0
) -> None:
    """Check every law on a tracking law.

    Args:
        orders: relative orders of the ideal plants.
        period: of the control cycle, s.
        duration: time after which an error must have decayed, s.
    """
    if not {*orders} or not {*orders} <= {1, 2, 3}:
        raise InvalidValue(f"check_tracking(orders={tuple(orders)!r}): expected whole numbers from 1 to 3")
    keep(_Trial(tracking, tuple(orders), period, duration), seed)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A tracking law on the ideal plants, and as one cycle of numbers."""

    tracking: Tracking
    orders: tuple[int, ...]
    period: float
    duration: float

    @cached_property
    def plant(self) -> Plant:
        names = [f"y{k}" for k in range(len(self.orders))]
        gives: Any = lambda u: {name: u[f"u{k}"] for k, name in enumerate(names)}  # noqa: E731
        of_order = lambda a, u, p: gives(u), lambda a, b, u, p: gives(u), lambda a, b, c, u, p: gives(u)
        inputs, orders = {f"u{k}": "N" for k in range(len(names))}, dict(zip(names, self.orders, strict=True))
        return Plant(dict.fromkeys(names, "m"), inputs, {}, of_order[max(self.orders) - 1], orders)

    @cached_property
    def cycle(self) -> Composite:
        """The law and its update as one step (memory, state, target, nominal, warm_up, clipped, cut off, held)."""
        plant, law, period = self.plant, self.tracking, self.period
        target, cut = Signal("_target", plant.state.elements, plant.state.units), plant.response_signal("_cut_off")
        offered = plant.state, target, plant.response_signal("nominal"), scalar("warm_up"), scalar("clipped"), cut
        blocks, reads = [law.law(plant, period), law.update(plant, period)], Layout((*offered, scalar("_held")))
        return compose("tracking_cycle", reads, blocks, law.delays(plant), outputs=("desired",))

    @cached_property
    def evaluator(self) -> Evaluator:
        return Evaluator(self.cycle.function)

    def __call__(
        self, memory: Array, state: Array, target: Array, nominal: Array, warm_up: float = 1.0, cut: Array | None = None
    ) -> tuple[Array, Array]:
        """(memory of the next cycle, desired response)."""
        cut = np.zeros(len(self.orders)) if cut is None else cut
        after, _, desired = self.evaluator(memory, state, target, nominal, warm_up, float(np.any(cut != 0)), cut, 0.0)
        return after, desired

    def start(self) -> Array:
        return self.cycle.memory.start()

    def motion(self, draw: Draw) -> tuple[Array, Array, Array]:
        """A state, a target, and a nominal response."""
        size = self.plant.state.size
        return draw.normal(size=size), draw.normal(size=size), draw.normal(size=len(self.orders))


def zero_error_asks_for_the_nominal_response(trial: _Trial, draw: Draw) -> Broken:
    """On the target, at the start and after it, the desired response is the nominal one."""
    memory = trial.start()
    for cycle in range(_TRIALS):
        state, _, nominal = trial.motion(draw)
        memory, desired = trial(memory, state, state, nominal, warm_up=float(cycle > 0))
        if not within(desired - nominal, _EXACT):
            yield f"without any error the desired response is {desired} in cycle {cycle}, the nominal response is {nominal}"


def start_forgets(trial: _Trial, draw: Draw) -> Broken:
    """The first cycle of a run does not depend on the memory of an earlier run."""
    for _ in range(_TRIALS):
        motion = trial.motion(draw)
        _, fresh = trial(trial.start(), *motion, warm_up=0)
        _, soiled = trial(draw.normal(size=trial.cycle.memory.size), *motion, warm_up=0)
        if not within(soiled - fresh, _EXACT * (1 + float(np.abs(fresh).max()))):
            yield f"with `warm_up` at 0 an earlier run changes the desired response from {fresh} to {soiled}"


def nan_shows(trial: _Trial, draw: Draw) -> Broken:
    """A measured coordinate that is not a number gives a desired response that is not one, so that it never acts."""
    for k, place in enumerate(places(trial.plant, 0)):
        state, target, nominal = trial.motion(draw)
        state[place] = np.nan
        _, desired = trial(trial.start(), state, target, nominal)
        if not np.isnan(desired[k]):
            yield f"'{trial.plant.names[k]}' of NaN is hidden: the desired response is {desired[k]:.6g}"


def clipping_freezes(trial: _Trial, draw: Draw) -> Broken:
    """A constant error does not wind the law up further into a limit: its desired response settles."""
    state, target, nominal = trial.motion(draw)
    cycles, memory, cut_off, said = round(trial.duration / trial.period), trial.start(), target - state, []
    for cycle in range(cycles + 1):
        memory, desired = trial(
            memory, state, target, nominal, warm_up=float(cycle > 0), cut=cut_off[places(trial.plant, 0)]
        )
        said.append(desired)
    halfway, last = said[cycles // 2], said[-1]
    if not within((last - halfway) / (np.abs(last - nominal) + _EXACT), _WIND):
        yield (
            f"clipped for {trial.duration:g} s at a constant error, the desired response goes from {halfway} at half time to "
            f"{last}; leave the memory unchanged where the error has the sign of `_cut_off`, or where `clipped` is 1"
        )


def error_decays(trial: _Trial, draw: Draw) -> Broken:
    """On an ideal plant that starts at rest the error goes to zero."""
    names = trial.plant.names
    first = {name: float(draw.uniform(0.5, 2.0) * draw.choice([-1, 1])) for name in names}
    rest = Trajectory(lambda t: dict.fromkeys(names, 0 * t))
    problem = Problem(trial.plant, rest, first, period=trial.period, duration=trial.duration)
    run = simulate(problem, ComputedTorque(trial.tracking), seed=0, compiled=False)
    if run.stop is not None:
        yield f"the loop on an ideal plant diverges: {run.stop}"
    for name, order in zip(names, trial.orders, strict=True):
        share = run[f"error.{name}"] / -first[name]
        if not within(share[-1], _LEFT):
            words = f"of an error on an ideal plant of order {order} the share {share[-1]:.3g} is left"
            yield f"{words} after {trial.duration:g} s, more than {_LEFT:g}"


def gains_are_what_it_does(trial: _Trial, draw: Draw) -> Broken:
    """A law that tells constant gains feeds errors back with them."""
    elements = trial.plant.state.elements
    for k, order in enumerate(trial.orders):
        told = trial.tracking.gains(order)
        if told is None:
            continue
        gains, own = np.asarray(told), [elements.index(trial.plant.names[k] + "'" * s) for s in range(order)]
        if len(gains) not in (order, order + 1):
            yield f"it has {len(gains)} gains for order {order}"
        for _ in range(_TRIALS):
            state, target, nominal = trial.motion(draw)
            memory, desired = trial(trial.start(), state, target, nominal)
            _, later = trial(memory, state, state, nominal)
            scale = 1 + float(float(np.abs(gains).max()) * np.abs(target - state).max())
            error = (target - state)[own]
            at_once, summed = np.dot(gains[-order:], error), gains[0] * trial.period * error[0]
            for what, given, expected in (
                ("with the integral at zero", desired[k], at_once),
                (f"one cycle after the error {error[0]:.4g}", later[k], summed * (len(gains) > order)),
            ):
                does = given - nominal[k]
                if not within(does - expected, _EXACT * scale):
                    yield f"{what} its feedback for order {order} is {does:.6g}, its gains {gains} give {expected:.6g}"
