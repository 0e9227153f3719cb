"""Every member serves every form of a problem, or says why it cannot: no pair is forgotten.

A form is a way to say a plant (coordinates of any order, outputs of states, a static map, a map of steps) or what lies between
plant and controller (dead time, estimators, beliefs, another plant, a body outside). The law of a pair: the run with a wrong
model stays near its reference, and a Stepper that is given the run's measurements has the run's commands. A pair that is not served
stands below with the sentence that its user reads; every other refusal is a defect. Members are found by search, so a new one is
tried on all forms, and a new form with all members: a quarter of the pairs at once, a Latin square, the others in the slow lane.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.forms import CYCLE, FORMS
from helpers.replay import samples

import fpirhc as fp
from fpirhc.conformance import examples, member_classes
from fpirhc.contracts import Controller
from fpirhc.errors import FpirhcError

REPLAYED = 20
NEAR = 0.2  # m, rms in the last quarter; that of the reference is 0.42
TESTS = Path(__file__).parents[1]

# Members, with settings for a thing of one mass

TRACK, MAP, PLAN = fp.Exponential(6.0), fp.Affine(gain=-0.2), fp.FixedPointSolver(iterations=2, tolerance=1e-3)
TORQUE = fp.ComputedTorque(TRACK, MAP)
UNCERTAIN = fp.Uncertain(lower=0.5, upper=3.0, deviation=0.5)


def filtered(order: int) -> Controller:
    """A disturbance of the response; as many quantities are measured as there are derivatives."""
    noise = {"y" + "'" * k: 10.0 ** (k - 3) for k in range(order + 1)}
    return fp.Estimating(fp.ComputedTorque(TRACK), fp.DisturbanceKalman({"y": 5.0}, noise))


PIDS: dict[int, Controller] = {  # by the order of y
    0: fp.PID({"y": 0.1}, {"y": 10.0}),
    1: fp.PID({"y": 60.0}, {"y": 60.0}),
    2: fp.PID({"y": 60.0}, {"y": 60.0}, {"y": 12.0}),
    3: fp.PID({"y": 60.0}, {"y": 40.0}, {"y": (30.0, 4.0)}),
}
CONTROLLERS: dict[str, Callable[[int], Controller]] = {
    "ComputedTorque": lambda order: TORQUE,
    "RecedingHorizon": lambda order: fp.RecedingHorizon(PLAN, MAP),
    "Predicted": lambda order: fp.Predicted(TORQUE, inputs=CYCLE, measurement=CYCLE),
    "ExactModel": lambda order: fp.ExactModel(TORQUE),
    "Estimating": filtered,
    "PID": lambda order: PIDS[order],
    "ADRC": lambda order: fp.rivals.ADRC(6.0, observer=40.0),
    "AccelerationFeedback": lambda order: fp.rivals.AccelerationFeedback(TRACK, gain=0.5, time_constant=0.1),
    "ForceMRAC": lambda order: fp.rivals.ForceMRAC(TRACK, MAP),
    "INDI": lambda order: fp.rivals.INDI(TRACK, frequency=30.0),
    "L1Adaptive": lambda order: fp.rivals.L1Adaptive(TRACK, bandwidth=30.0),
    "LyapunovMRAC": lambda order: fp.rivals.LyapunovMRAC(6.0, adaptation=3.0, leakage=0.02),
    "ResolvedAccelerationRate": lambda order: fp.rivals.ResolvedAccelerationRate(6.0),
    "SlidingMode": lambda order: fp.rivals.SlidingMode(rate=6.0, gain=30.0, width=1.0),
    "Slotted": lambda order: fp.Slotted({"y": fp.ComputedTorque(TRACK, MAP)}, {"y": 1.0}, blend=0.1),
}
ELSEWHERE = {  # members that need a plant of their own, with the tests that try them on forms
    "AdaptiveInverseDynamics": "controllers/test_adaptive_rivals.py",
    "SlotineLi": "controllers/test_adaptive_rivals.py",
    "Cascade": "outputs/test_cascade.py",
    "FeedforwardOnly": "outputs/test_cascade.py",
}


def around(member: Any, family: str, order: int) -> Controller:
    """A controller with this member of a family."""
    if family == "deformations":
        return fp.ComputedTorque(TRACK, member)
    if family == "tracking laws":
        return fp.ComputedTorque(member, MAP)
    if family == "optimisers":
        return fp.RecedingHorizon(member, MAP)
    return fp.Estimating(fp.ComputedTorque(TRACK), member)


LEARNERS = (fp.RecursiveLeastSquares({"m": UNCERTAIN}, noise={"y": 0.1}, time=1.0),)
MEMBERS: dict[str, Callable[[int], Controller]] = dict(CONTROLLERS)
OF_CLASS: dict[str, list[str]] = {name: [name] for name in CONTROLLERS}  # the examples of each member
for family, found in (
    ("deformations", examples("deformations", MAP)),
    ("tracking laws", examples("tracking laws")),
    ("optimisers", examples("optimisers", PLAN)),
    ("estimators", LEARNERS),
):
    for example in found:  # a number within its class, which other members do not change
        group = OF_CLASS.setdefault(type(example).__name__, [])
        group.append(f"{type(example).__name__} {len(group)}")
        MEMBERS[group[-1]] = partial(around, example, family)


# Pairs that are not served, with the sentence that their user reads

WRONG_SIGN = "has the wrong sign, so every cycle enlarges the error"
WRONG_PAIR = "so the iteration alone does not converge with this gain"
NEEDS = (
    "{} needs derivatives below the response, and {}; use ComputedTorque, with a deformation where the model is wrong"
)
OF_DERIVATIVES = ("ADRC", "L1Adaptive", "LyapunovMRAC", "ResolvedAccelerationRate", "SlidingMode")
OF_TIME = ("LyapunovMRAC", "ResolvedAccelerationRate")
NO_FILTER = "no stationary gain makes the filter stable; give noise={'a': ...}, or measure more states"
IN_STEPS = "map", "believed map"
REFUSED: dict[tuple[str, str], str] = {
    **{("Sigmoid 2", form): WRONG_SIGN for form in FORMS},
    **{("Sigmoid 3", form): WRONG_SIGN for form in FORMS},
    **{
        (OF_CLASS["FullSpaceFixedPoint"][0], form): "serves problems without limits only (it is a baseline)"
        for form in FORMS
    },
    **{("Paired 0", form): WRONG_PAIR for form in ("map", "encoder", "believed", "believed map")},
    ("Estimating", "states"): NO_FILTER,
    ("Estimating", "believed"): NO_FILTER,
    **{(one, "at once"): NEEDS.format(one, "the command moves 'y' at once (order 0)") for one in OF_DERIVATIVES},
    **{(one, form): NEEDS.format(one, "discrete time has only differences") for one in OF_TIME for form in IN_STEPS},
    ("ExactModel", "reality"): "it cannot be the exact model of this controller; leave ExactModel out",
    ("ExactModel", "outside"): "an ExternalPlant has no equations that could be the exact model; leave ExactModel out",
}
YOUNG = "order 1", "curve", "at once", "late", "late curve"
FARTHER = {  # pairs that are served and leave their reference
    **{("Paired 0", form): "its pairs are three cycles old, where nothing is late by three" for form in YOUNG},
    ("Sigmoid 0", "order 3"): "its scale of 1 m/s^3 is less than the change that a cycle asks for",
}


def test_every_member_is_among_them():
    """A new controller has a line above, or a test that names its forms."""
    named = set(CONTROLLERS) | set(ELSEWHERE)
    assert named == {c.__name__ for c in member_classes("controllers")}
    for file in ELSEWHERE.values():
        assert (TESTS / file).is_file()
    learners = {"DisturbanceKalman", *(type(e).__name__ for e in LEARNERS)}
    assert learners == {c.__name__ for c in member_classes("estimators")}


def test_the_tables_name_what_there_is():
    """A pair that is served now must leave the table, or nobody would notice when it is lost again."""
    for member, form in (*REFUSED, *FARTHER):
        assert member in MEMBERS
        assert form in FORMS


def replayed(problem: fp.Problem, controller: Controller, run: fp.Run) -> np.ndarray:
    """Commands of a Stepper that is given what the run measured."""
    stepper = fp.Stepper(problem, controller, compiled=False, bounded=False)
    memory, measured, commands = stepper.start(), samples(run), []
    for k in range(REPLAYED):
        command, memory = stepper.step_measured(float(run.time[k]), measured[k], memory)
        commands.append(command)
    return np.array(commands)


def pairs() -> list[Any]:
    """A Latin square, every fourth form of a member in turn, with its examples in turn; all other pairs are slow."""
    turns = [
        pytest.param(group[k // 4 % len(group)], form, marks=[pytest.mark.slow] * bool((j + k) % 4))
        for j, group in enumerate(OF_CLASS.values())
        for k, form in enumerate(FORMS)
    ]
    tried = {one.values for one in turns}
    rest = [pair for pair in (*REFUSED, *FARTHER) if pair not in tried]
    return turns + [pytest.param(*pair, marks=[pytest.mark.slow] * bool(k % 4)) for k, pair in enumerate(rest)]


@pytest.mark.parametrize(("member", "form"), pairs())
def test_a_member_serves_a_form_or_says_why_not(member: str, form: str) -> None:
    problem, order = FORMS[form]
    if words := REFUSED.get((member, form)):
        with pytest.raises(FpirhcError, match=re.escape(words)):
            fp.simulate(problem, MEMBERS[member](order), seed=0, compiled=False)
        return
    controller = MEMBERS[member](order)
    if controller.planner is None:
        problem = replace(problem, horizon=None, cost=None)
    else:  # a plan is near its reference sooner than a law
        problem = replace(problem, duration=problem.duration / 2)
    run = fp.simulate(problem, controller, seed=0, compiled=False)
    assert run.stop is None
    error = float(np.sqrt(np.mean(run["true_error"][-run.cycles // 4 :] ** 2)))
    assert (error < NEAR) == ((member, form) not in FARTHER)
    if member in CONTROLLERS or (list(MEMBERS).index(member) - list(FORMS).index(form)) % (len(FORMS) // 2) == 0:
        np.testing.assert_allclose(replayed(problem, controller, run), run["command"][:REPLAYED], rtol=1e-9, atol=1e-9)
