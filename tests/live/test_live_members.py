"""Every number of every member is open and runs as in the loop built with it, or is refused by its path and the place."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.on_problem import named, on_problem

import fpirhc as fp
from fpirhc.conformance import examples, two_masses
from fpirhc.contracts import Controller
from fpirhc.errors import FpirhcError, InvalidProblem, InvalidValue, NotContractive

SIGMOID = fp.Sigmoid(gain=-0.5, scale=50.0)
TRACKING = fp.Exponential(rate=8.0)
MEASURED = dict.fromkeys(("a", "b", "a'", "b'"), 1e-3)
KALMAN = fp.Estimating(
    fp.ComputedTorque(TRACKING, SIGMOID), fp.DisturbanceKalman({"a": 1.0, "b": 1.0}, MEASURED, noise={"a": 0.1})
)
WHY = (  # a number is refused: it decides the structure, or Python computes with it
    "decides what the loop is made of",
    "does not use it",
    "needs its number while the loop is built",
    "turns one of them into a number",
)
WEIGHTS: dict[str, Any] = {"states": {"a": 1e2, "b": 1e2, "a'": 1.0, "b'": 1.0}, "deviation": {"Fa": 1e-3, "Fb": 1e-3}}
FACTORS = (1.07, 0.93, 1.01, 0.5, 2.0)  # the first one that a setting accepts


def numbers(value: Any, start: str = "") -> Iterator[str]:
    """Path of every number in a value."""
    inside = {f.name: getattr(value, f.name) for f in fields(value)} if is_dataclass(value) else value
    inside = dict(enumerate(inside)) if isinstance(inside, list | tuple) else inside
    for name, one in inside.items() if isinstance(inside, Mapping) else ():
        if isinstance(one, int | float) and not isinstance(one, bool):
            yield f"{start}{name}"
        yield from numbers(one, f"{start}{name}.")


def check(
    controller: Controller, problem: fp.Problem, paths: list[str] | None = None, cycles: int = 12, least: int = 1
) -> None:
    """A loop with open numbers is that without them; of all numbers at least so many can be changed, of given ones all."""
    short = replace(problem, duration=cycles * problem.period, measure_from=0.0)
    parts = {"cost.": problem.cost, "limits.": problem.limits}
    own = [name for name in parts if getattr(controller, name[:-1], None) is None]
    opened = paths or [*numbers(controller), *(path for name in own for path in numbers(parts[name], name))]
    ready, why = opening(short, controller, opened)
    while ready is None:
        named = [path for path in opened if f"'{path}'" in why]
        assert named
        assert any(words in why for words in WHY), why
        if len(named) > 1:  # together: those that open alone are not the ones
            named = [path for path in named if opening(short, controller, [path])[0] is None] or named
        opened = [path for path in opened if path not in named]
        ready, why = opening(short, controller, opened)
    plain = fp.simulator(short, controller, compiled=False).run(seed=0)
    assert np.array_equal(ready.run(seed=0).log, plain.log, equal_nan=True), opened
    changed = [path for path in opened if any(runs_as_rebuilt(ready, path, factor, plain) for factor in FACTORS)]
    assert changed == paths if paths else len(changed) >= least


def opening(problem: fp.Problem, controller: Controller, paths: list[str]) -> tuple[Any, str]:
    """A loop with these numbers open, or why it is refused."""
    try:
        return fp.simulator(problem, controller, compiled=False, live=paths), ""
    except FpirhcError as error:
        return None, str(error)


def runs_as_rebuilt(ready: Any, path: str, factor: float, plain: fp.Run) -> bool:
    """Whether another number is accepted; then the loop runs as the one that is built with it."""
    number = {path: ready.live.start[path] * factor}
    try:
        problem, controller, _ = ready.live.changed(number)
    except (InvalidProblem, InvalidValue, NotContractive):
        return False
    built, changed = fp.simulator(problem, controller, compiled=False).run(seed=0), ready.run(seed=0, settings=number)
    if controller.planner is None:
        assert np.array_equal(changed.log, built.log, equal_nan=True), number
        return True
    # Scale, step length and first plan stay those of the build.
    apart, effect = (np.nanmax(np.abs(one["command"] - built["command"])) for one in (changed, plain))
    assert apart <= 0.5 * effect + 1e-6 * np.nanmax(np.abs(built["command"])), number
    return True


MAPS = [d for d in examples("deformations", SIGMOID) if d.effective_gain() >= 0]
MEMBERS = [
    *(fp.ComputedTorque(TRACKING, deformation) for deformation in MAPS),
    *(fp.ComputedTorque(tracking, SIGMOID) for tracking in examples("tracking laws")),
    *examples("controllers", fp.ComputedTorque(TRACKING, SIGMOID)),
]
THIRD = [pytest.param(one, marks=() if k % 3 == 0 else pytest.mark.slow) for k, one in enumerate(MEMBERS)]


@pytest.mark.parametrize("member", THIRD, ids=named(MEMBERS))
def test_every_number_of_a_member(member):
    """No deformation, tracking law, controller or wrapper loses a number on its way into the loop."""
    check(*on_problem(member))


SOLVERS = {
    "reduced gradient": fp.ReducedGradient(iterations=30, tolerance=1e-3),
    "gradient FPI": fp.GradientFixedPoint(iterations=5, tolerance=1e-3),
    "damped": fp.FixedPointSolver(iterations=1, tolerance=1e-3, damping=0.1),
    "solved": fp.FixedPointSolver(),  # to a tolerance that follows from the limits
}


@pytest.mark.parametrize("name", SOLVERS)
def test_weights_and_limits_of_an_optimiser_are_live(name):
    """They are data of the call; scale, step length and a tolerance that follows from limits are those of the build."""
    controller = fp.RecedingHorizon(SOLVERS[name], cost=fp.Quadratic(**WEIGHTS))
    check(controller, two_masses(), ["cost.states.a", "limits.inputs.Fa.1"], cycles=30)


class Branching(fp.Affine):
    """Affine whose gain counts only where it is large."""

    def step(self, request, response, desired, memory):
        """Return r + (A_c / 2) (f - d), or r."""
        return request + (0.5 * self.gain if self.gain < -0.1 else 0.0) * (response - desired), memory


class Lossy(fp.Affine):
    """Affine with its gain in a matrix of numbers; CasADi makes NaN of a symbol there, without an error."""

    def step(self, request, response, desired, memory):
        """Return r + (A_c / 2) (f - d)."""
        return request + ca.DM([0.5 * self.gain]) * (response - desired) + 0 * self.gain * response, memory


ONCE = fp.FixedPointSolver(iterations=1, tolerance=1e-3)
PLANNED = fp.RecedingHorizon(ONCE, cost=fp.Quadratic(**WEIGHTS, terminal=fp.LQRTerminal()))
REFUSED = [  # a number that Python computes with, one that stays live beside it, and the place
    (PLANNED, "cost.states.a", "limits.inputs.Fa.1", "cost.weight needs its number while"),
    (PLANNED, "optimiser.map.gain", "limits.inputs.Fa.1", "needs its number while"),
    (KALMAN, "estimator.drift.a", "deformation.gain", "needs its number while the loop"),
    (fp.ComputedTorque(TRACKING, Branching(gain=-0.5)), "deformation.gain", "tracking.rate", "step needs its number"),
    (fp.ComputedTorque(TRACKING, Lossy(gain=-0.5)), "deformation.gain", "tracking.rate", ""),
]


@pytest.mark.parametrize(("controller", "path", "beside", "words"), REFUSED)
def test_what_python_computes_from_a_number_is_refused_by_path_and_place(controller, path, beside, words):
    """Beside it other numbers stay live; the loop with the refused number is never built."""
    with pytest.raises(FpirhcError, match=rf"'{re.escape(path)}' cannot be live.*{words}"):
        fp.simulator(two_masses(), controller, live=[beside, path], compiled=False)
    fp.simulator(two_masses(), controller, live=[beside], compiled=False)


def test_the_switch_of_slots_may_be_live():
    """How fast the offset of a switch decays, and how fast a slot follows."""
    task = fp.load_problem("mass_spring_slots")
    check(task.controllers["slots"], task.problem, ["blend", "slots.q2.tracking.rate"], cycles=60)
