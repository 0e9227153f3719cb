"""Every shipped member of a family keeps the public laws, and every law catches a class that breaks it."""

import random
from dataclasses import dataclass
from typing import Any

import casadi as ca
import pytest
from helpers.kinds import shipped
from helpers.on_problem import named, on_problem

import fpirhc as fp
from fpirhc.conformance import (
    FAMILIES,
    Example,
    check_controller,
    check_optimiser,
    check_plant,
    check_tracking,
    examples,
    member_classes,
)
from fpirhc.contracts import Block, Tracking
from fpirhc.errors import InvalidProblem, InvalidValue

FINE = 1e-6  # tolerance of the optimisers, N
TRACKING = fp.Exponential(rate=8.0)


# Tracking laws


TRACKINGS = examples("tracking laws")


@pytest.mark.parametrize("tracking", TRACKINGS, ids=named(TRACKINGS))
def test_tracking_laws(tracking):
    """Whatever is shipped decays on ideal plants of mixed order, forgets, and does not wind up."""
    period = getattr(tracking, "step", 5e-3)  # poles in z belong to one cycle
    check_tracking(tracking, seed=1, period=period, duration=6.0)


def test_every_member_has_examples():
    """A new file carries values for the laws, or they would go unchecked."""
    for family in FAMILIES:
        inner = next(one for one in examples(family) if not isinstance(one, Example))
        assert set(member_classes(family)) == {type(on_problem(e)[0]) for e in examples(family, inner)}, family


@dataclass(frozen=True)
class Altered(fp.Exponential):
    """The exponential law with one change made to its step, its update, or both."""

    rate: float = 6.0
    change: str = ""

    def law(self, plant, period):
        block = super().law(plant, period)

        def step(s):
            if self.change == "hides NaN":
                s.state = ca.fmin(1e3, ca.fmax(-1e3, s.state))
            if self.change == "remembers":
                s.warm_up = 1 + 0 * s.warm_up
            signals_value = dict(block.step(s))
            if self.change == "offset":
                signals_value["desired"] = signals_value["desired"] + 1e-3
            if self.change == "sign":
                signals_value["_target_error"] = -signals_value["_target_error"]
            if self.change == "pushes away":
                signals_value["desired"] = 2 * s.nominal - signals_value["desired"]
            if self.change == "tells other gains":
                signals_value["desired"] = 2 * signals_value["desired"] - s.nominal
            return signals_value

        return Block(block.name, block.reads, block.writes, step, block.memory)

    def update(self, plant, period):
        block = super().update(plant, period)

        def step(s):
            if self.change == "winds up":
                s._cut_off = 0 * s._cut_off
            return block.step(s)

        return Block(block.name, block.reads, block.writes, step)


@dataclass
class Thawed(Tracking):
    """A law whose settings can be changed after a loop was built from them."""

    rate: float = 6.0

    def law(self, plant, period):
        return fp.Exponential(self.rate).law(plant, period)

    def update(self, plant, period):
        return fp.Exponential(self.rate).update(plant, period)

    def delays(self, plant):
        return fp.Exponential(self.rate).delays(plant)


@pytest.mark.parametrize(
    ("wrong", "law"),
    [
        (Thawed(), "frozen value"),
        (Altered(change="sign"), "clipping freezes"),
        (Altered(change="offset"), "zero error asks for the nominal response"),
        (Altered(change="remembers"), "start forgets"),
        (Altered(change="hides NaN"), "nan shows"),
        (Altered(change="winds up"), "clipping freezes"),
        (Altered(change="pushes away"), "error decays"),
        (Altered(rate=0.2), "error decays"),
        (Altered(change="tells other gains"), "gains are what it does"),
    ],
)
def test_wrong_tracking_laws_are_caught(wrong, law):
    with pytest.raises(AssertionError, match=f"{type(wrong).__name__} breaks the law '{law}'"):
        check_tracking(wrong, seed=1, period=2e-3, duration=6.0)


# Optimisers


SETTLED = fp.FixedPointSolver(iterations=20, tolerance=FINE)
SERVES_NO_STATE_LIMITS = fp.ReducedGradient(iterations=200, tolerance=FINE)
OPTIMISERS = (
    *examples("optimisers", SETTLED),
    *(o for o in examples("optimisers", SERVES_NO_STATE_LIMITS) if o not in examples("optimisers")),
)


LONG = fp.FullSpaceFixedPoint  # a baseline of thousands of iterations: half a minute
LANES = [pytest.param(o, marks=pytest.mark.slow if isinstance(o, LONG) else ()) for o in OPTIMISERS]


@pytest.mark.parametrize("optimiser", LANES, ids=named(OPTIMISERS))
def test_optimiser_laws(optimiser):
    """Riccati, finite differences and least squares agree with what each finds and says."""
    check_optimiser(optimiser, tolerance=FINE, seed=1)


def test_the_tolerance_must_tell_a_solution():
    with pytest.raises(InvalidValue, match="up to 1e-3"):
        check_optimiser(SETTLED, tolerance=0.1, seed=1)


# Controllers


COMPUTED_TORQUE = next(one for one in examples("controllers") if isinstance(one, fp.ComputedTorque))
CONTROLLERS = (
    *examples("controllers", COMPUTED_TORQUE),
    *(fp.Estimating(COMPUTED_TORQUE, estimator) for estimator in examples("estimators")),
)


def name_of(example: Any) -> str:
    return getattr(example, "controller", "") or type(getattr(example, "value", example)).__name__


QUICK = "ADRC", "Cascade", "ComputedTorque", "ExactModel", "PID", "Predicted", "RecedingHorizon", "slots", "L1 adaptive"


@pytest.mark.parametrize(
    "example",
    [pytest.param(one, marks=[] if name_of(one) in QUICK else pytest.mark.slow) for one in CONTROLLERS],
    ids=name_of,
)
def test_controller_laws(example):
    """Limits, bad measurements, and one command however it is computed; C is compared where it compiles quickly."""
    controller, problem = on_problem(example)
    left = getattr(example, "left", None) or 0.05
    check_controller(controller, problem=problem, seed=1, left=left, compiled=True)


# Plants


@pytest.mark.parametrize("name", shipped())
def test_plant_laws(name):
    problem = fp.load_problem(name).problem
    box = {e: (v - 0.1, v + 0.1) for e, v in zip(problem.plant.state.elements, problem.start_state, strict=True)}
    check_plant(problem.plant, seed=1, box=box)


def oscillator(response=None, inverse=None) -> fp.Plant:
    return fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        parameters={"m": fp.Parameter(1.5, 1.0, "kg"), "k": fp.Parameter(2.0, 3.0, "N/m")},
        response=response or (lambda q, v, u, p: {"y": (u.u - p.k * q.y) / p.m}),
        inverse=inverse,
    )


def kinked(q, v, u, p):
    """A spring that is written so that its derivative is lost: rounding to a grid much finer than the motion."""
    return {"y": (u.u - p.k * ca.floor(q.y * 1e9) / 1e9) / p.m}


PLANTS = (
    (oscillator(lambda q, v, u, p: {"y": u.u / p.m - p.k * ca.sqrt(q.y)}), "response is finite", "response of 'y'"),
    (oscillator(lambda q, v, u, p: {"y": (u.u - 3.0 * q.y) / p.m}), "both parameter sets enter", "parameter 'k'"),
    (
        oscillator(lambda q, v, u, p: {"y": (u.u - p.k * q.y) / p.m + random.random()}),
        "response is pure",
        "built twice",
    ),
    (oscillator(kinked), "slopes are true", "derivative of the response by 'y'"),
    (oscillator(inverse=lambda q, v, r, p: {"u": p.m * r.y - p.k * q.y}), "inverse inverts", "whose response is"),
)


@pytest.mark.parametrize(("wrong", "law", "sentence"), PLANTS, ids=[law for _, law, _ in PLANTS])
def test_wrong_plants_are_caught(wrong, law, sentence):
    """A sign in an inverse, a number where a parameter belongs, a lost derivative."""
    with pytest.raises(AssertionError, match=f"breaks the law '{law}'.*{sentence}"):
        check_plant(wrong, seed=1)


def test_the_box_is_checked():
    """A misspelt state is offered the right one; the box decides where a root is asked for."""
    with pytest.raises(InvalidProblem, match="Did you mean 'y'"):
        check_plant(oscillator(), seed=1, box={"yy": (0, 1)})
    check_plant(PLANTS[0][0], seed=1, box={"y": (1.0, 2.0)})


def test_what_a_class_raises_is_noted():
    """A mistake of the class itself keeps its traceback, with the law that was tried."""

    @dataclass(frozen=True)
    class Broken(fp.ComputedTorque):
        def blocks(self, built):
            return len(built.plant.names) / 0

    with pytest.raises(ZeroDivisionError) as raised:
        check_controller(Broken(TRACKING), seed=1)
    assert any("Broken" in note and "law" in note for note in raised.value.__notes__)
