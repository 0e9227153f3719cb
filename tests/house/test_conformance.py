"""Every shipped member of a family keeps the public laws, and every law catches a class that breaks it."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.kinds import shipped
from helpers.on_problem import named
from wrong.tables import CONTROLLERS as WRONG_CONTROLLERS
from wrong.tables import LOUD
from wrong.tables import MAPS as WRONG_MAPS
from wrong.tables import OBSERVERS as WRONG_OBSERVERS
from wrong.tables import OPTIMISERS as WRONG_OPTIMISERS

import fpirhc as fp
import fpirhc.conformance.controller as controller_laws
import fpirhc.conformance.optimiser as optimiser_laws
import fpirhc.conformance.plant as plant_laws
import fpirhc.conformance.tracking as tracking_laws
import fpirhc.controllers
import fpirhc.optimisers
import fpirhc.tracking
from fpirhc.conformance import check_controller, check_optimiser, check_plant, check_tracking
from fpirhc.conformance.horizons import Trial as OptimiserTrial
from fpirhc.conformance.laws import keep, within
from fpirhc.conformance.loops import Trial, two_masses
from fpirhc.contracts import Block, Controller, Delay, Layout, Optimiser, Signal, Tracking, scalar
from fpirhc.controllers.contract import Planner
from fpirhc.errors import InvalidProblem, InvalidValue
from fpirhc.members import FAMILIES, Example, examples, member_classes
from fpirhc.plant.plant import Equations

FINE = 1e-6  # tolerance of the optimisers, N
TRACKING = fp.Exponential(rate=8.0)


def breaks(law: Any) -> str:
    """What the message says of a broken law."""
    return f"breaks the law '{law.__name__.replace('_', ' ')}'"


# Tracking laws


def promised(t: np.ndarray, order: int) -> np.ndarray:
    """(d/dt + 2)^n e = 0 from rest."""
    return np.exp(-2 * t) * sum((2 * t) ** k / math.factorial(k) for k in range(order))


TRACKINGS = examples("tracking laws")


@pytest.mark.parametrize("tracking", TRACKINGS, ids=named(TRACKINGS))
def test_tracking_laws(tracking):
    """Whatever is shipped decays on ideal plants of mixed order, forgets, and does not wind up."""
    period = getattr(tracking, "step", 5e-3)  # poles in z belong to one cycle
    check_tracking(tracking, seed=1, period=period, duration=6.0)


def test_exponential_decays_as_it_promises():
    """Not only to zero: along the curve of its equation."""
    check_tracking(fp.Exponential(rate=2.0, integral=False), seed=2, duration=6.0, decay=promised)


def test_every_member_has_examples():
    """A new file carries values for the laws, or they would go unchecked."""
    for family in FAMILIES:
        inner = examples(family)[0]
        assert set(member_classes(family)) == {type(on_problem(e)[0]) for e in examples(family, inner)}, family


@dataclass(frozen=True)
class Altered(fp.Exponential):
    """The exponential law with one change made to its step, its update, or both."""

    rate: float = 6.0
    change: str = ""

    def feedback(self, order):
        law_facts = super().feedback(order)
        return replace(law_facts, rate=2 * self.rate) if self.change == "tells another rate" else law_facts

    def law(self, plant, period):
        block = super().law(plant, period)
        reads = Layout((*block.reads.signals, scalar("cycle_time"))) if self.change == "reads" else block.reads

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
            if self.change == "extra":
                signals_value["more"] = s.warm_up
            return signals_value

        return Block(block.name, reads, block.writes, step, block.memory)

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
        (Thawed(), tracking_laws.frozen_value),
        (Altered(change="reads"), tracking_laws.only_declared_signals),
        (Altered(change="extra"), tracking_laws.only_declared_signals),
        (Altered(change="sign"), tracking_laws.error_is_target_minus_state),
        (Altered(change="offset"), tracking_laws.zero_error_asks_for_the_nominal_response),
        (Altered(change="remembers"), tracking_laws.start_forgets),
        (Altered(change="hides NaN"), tracking_laws.nan_shows),
        (Altered(change="winds up"), tracking_laws.clipping_freezes),
        (Altered(change="pushes away"), tracking_laws.error_decays),
        (Altered(rate=0.2), tracking_laws.error_decays),
        (Altered(change="tells another rate"), tracking_laws.feedback_is_what_it_does),
    ],
)
def test_wrong_tracking_laws_are_caught(wrong, law):
    with pytest.raises(AssertionError, match=f"{type(wrong).__name__} {breaks(law)}"):
        check_tracking(wrong, seed=1, period=2e-3, duration=6.0)


def test_a_decay_that_is_not_the_promised_one_is_caught():
    """The numbers are told: where, how much, and what was promised."""
    with pytest.raises(AssertionError, match=r"the error's share is 0\.\d+ at t = \d.*promised is 0\.\d+"):
        check_tracking(fp.Exponential(rate=3.0, integral=False), seed=2, duration=6.0, decay=promised)


# Optimisers


SETTLED = fp.FixedPoint(iterations=20, tolerance=FINE)
SERVES_NO_STATE_LIMITS = fp.ReducedGradient(iterations=200, tolerance=FINE)
OPTIMISERS = (
    *examples("optimisers", SETTLED),
    *(o for o in examples("optimisers", SERVES_NO_STATE_LIMITS) if o not in examples("optimisers")),
)
SINGLE = fp.FixedPoint(iterations=1, tolerance=FINE)


@pytest.mark.parametrize("optimiser", OPTIMISERS, ids=named(OPTIMISERS))
def test_optimiser_laws(optimiser):
    """Riccati, finite differences and least squares agree with what each finds and says."""
    check_optimiser(optimiser, tolerance=FINE, seed=1)


@dataclass(frozen=True)
class Dishonest(Optimiser):
    """A fixed-point optimiser that changes what it is given or what it answers."""

    change: str
    settings: list[float] | None = None
    within: Optimiser = SETTLED

    @property
    def near_plan(self):
        changed = {"wider near a plan": fp.Ipopt(), "off near a plan": Dishonest("off")}
        return changed.get(self.change, self)

    def memory(self, ocp):
        return self.within.memory(ocp)

    def shifted(self, ocp, memory):
        return self.within.shifted(ocp, memory)

    def converging(self, ocp):
        """Honest in an open-loop solve, where only the single step is not."""
        return self.within.converging(ocp) if self.change == "one step OK" else self.step(ocp)

    def step(self, ocp):
        size = self.within.memory(ocp).size
        sizes = {"s": ocp.state.size, "data": (ocp.data.size, ocp.stages + 1), "l": 1, "u": 1, "memory": size}
        s, data, lower, upper, memory = symbols = [ca.MX.sym(n, *np.atleast_1d(k).tolist()) for n, k in sizes.items()]
        if self.change == "own bounds":
            lower, upper = ca.DM(ocp.input_lower), ca.DM(ocp.input_upper)
        if self.change == "hides NaN":
            s = ca.fmin(1e9, ca.fmax(-1e9, s))
        inner = self.within.step(ocp)
        inputs, diagnostics, next_memory = inner(s, data, lower, upper, memory)
        if self.change == "poisoned":
            next_memory = ca.if_else(ca.sum1(ca.fabs(memory)) <= 1e300, next_memory, memory)
        if self.change in ("always OK", "one step OK"):
            diagnostics = ca.vertcat(diagnostics[:4], 0)
        if self.change == "off":
            inputs = inputs + 1e-3
            next_memory = ca.vertcat(ca.vec(inputs), next_memory[inputs.numel() :])
        if self.change == "never feasible":
            diagnostics = ca.vertcat(
                diagnostics[:2], ca.if_else(diagnostics[2] > 1e-4, 0, diagnostics[2]), diagnostics[3:]
            )
        if self.change == "ignores bounds":
            inputs, diagnostics, next_memory = inner(s, data, -math.inf, math.inf, memory)
        return ca.Function("dishonest", symbols, [inputs, diagnostics, next_memory])


@pytest.mark.parametrize(
    ("wrong", "law"),
    [
        (Dishonest("", settings=[1]), optimiser_laws.frozen_value),
        (Dishonest("off"), optimiser_laws.linear_plan_is_riccati),
        (Dishonest("always OK", within=fp.FixedPoint(iterations=1, tolerance=1e-9)), optimiser_laws.plan_is_stationary),
        (Dishonest("one step OK", within=SINGLE), optimiser_laws.status_is_honest),
        (Dishonest("ignores bounds"), optimiser_laws.bounds_of_inputs_are_kept),
        (Dishonest("own bounds"), optimiser_laws.bounds_of_a_call_count),
        (Dishonest("never feasible"), optimiser_laws.infeasible_is_told),
        (Dishonest("hides NaN"), optimiser_laws.nan_is_told),
        (Dishonest("poisoned"), optimiser_laws.poisoned_memory_is_forgotten),
        (Dishonest("wider near a plan"), optimiser_laws.near_plan_is_alike),
        (Dishonest("off near a plan"), optimiser_laws.near_plan_is_alike),
    ],
    ids=lambda v: getattr(v, "change", None),
)
def test_wrong_optimisers_are_caught(wrong, law):
    assert law in optimiser_laws.LAWS
    with pytest.raises(AssertionError, match=f"Dishonest {breaks(law)}"):
        keep(wrong, OptimiserTrial(wrong, FINE, 50), [law], seed=1)


def test_the_tolerance_must_tell_a_solution():
    with pytest.raises(InvalidValue, match="up to 1e-3"):
        check_optimiser(SETTLED, tolerance=0.1, seed=1)


# Controllers


COMPUTED_TORQUE = examples("controllers")[0]
CONTROLLERS = (
    *examples("controllers", COMPUTED_TORQUE),
    *(fp.Estimating(COMPUTED_TORQUE, estimator) for estimator in examples("estimators")),
)


def on_problem(example: Any) -> tuple[Controller, fp.Problem | None]:
    """A controller and the problem that it is tried on, None for that of the laws."""
    one = example if isinstance(example, Example) else Example(example)
    if not one.problem:
        return one.value, replace(two_masses(), **one.changes) if one.changes else None
    task = fp.load_problem(one.problem)
    return one.value or task.controllers[one.controller], replace(task.problem, **one.changes)


def name_of(example: Any) -> str:
    one = example if isinstance(example, Example) else Example(example)
    return one.controller or type(one.value).__name__


OWN_KIND = (
    "ADRC",
    "Cascade",
    "ComputedTorque",
    "ExactModel",
    "PID",
    "Predicted",
    "RecedingHorizon",
    "slots",
    "L1 adaptive",
)


@pytest.mark.parametrize(
    "example",
    [pytest.param(one, marks=[] if name_of(one) in OWN_KIND else pytest.mark.slow) for one in CONTROLLERS],
    ids=name_of,
)
def test_controller_laws(example):
    """Limits, bad measurements, and one command however it is computed; C is compared where it compiles quickly."""
    controller, problem = on_problem(example)
    left = getattr(example, "left", None) or 0.05
    check_controller(controller, problem=problem, seed=1, left=left, compiled=True)


class Counter(ca.Callback):
    """Hidden state: 0 or 1, in turns of three calls."""

    def __init__(self):
        ca.Callback.__init__(self)
        self.calls = 0
        self.construct("counter", {})

    def eval(self, arguments):
        """Count; the argument only keeps CasADi from calling it once for all."""
        del arguments
        self.calls += 1
        return [ca.DM(self.calls % 3 == 0)]


COUNTER = Counter()


@dataclass(frozen=True)
class Faulty(fp.ComputedTorque):
    """Computed torque with one fault."""

    change: str = ""
    settings: tuple[Any, ...] | list[Any] = field(default_factory=tuple)

    @property
    def planner(self):
        nothing: Any = None
        return Planner(nothing, None, restarts=True, tracking=None) if self.change == "tells a plan" else None

    def blocks(self, problem):
        blocks, delays = super().blocks(problem)
        at = next(k for k, b in enumerate(blocks) if b.name == "limit")
        limit = blocks[at]

        def limited(s):
            if self.change == "clamps first":
                s.command_unclipped = ca.fmin(30, ca.fmax(-30, s.command_unclipped))
            signals_value = dict(limit.step(s))
            if self.change == "random":
                signals_value["command"] = signals_value["command"] * (1 - 1e-6 * random.random())
            if self.change == "counts":
                signals_value["command"] = signals_value["command"] * (1 - 1e-6 * COUNTER(s.command_unclipped[0]))
            if self.change == "trusts responses":
                signals_value["command"] = ca.if_else(s.realised[0] > 1e9, s.realised, signals_value["command"])
            return signals_value

        reads = Layout((*limit.reads.signals, problem.plant.response_signal("realised")))
        blocks[at] = Block("limit", reads, limit.writes, limited, opaque=self.change == "counts")
        if self.change == "keeps NaN":
            blocks, delays = self._summing(problem, blocks, delays)
        if self.change == "no status":
            blocks = [b for b in blocks if b.name != "judge"]
        return blocks, delays

    def _summing(self, problem, blocks, delays):
        """A filter of the measured state whose memory keeps a NaN for ever, seen by the law of the next cycle."""
        plant = problem.plant
        parts, new = (Signal(n, plant.state.elements) for n in ("_filtered_before", "filtered"))
        law = next(k for k, b in enumerate(blocks) if b.name == "tracking")
        inner = blocks[law]

        def step(s):
            seen = s.state + 1e-9 * s._filtered_before
            s.state = seen
            return {**inner.step(s), "filtered": seen}

        reads, writes = Layout((*inner.reads.signals, parts)), Layout((*inner.writes.signals, new))
        blocks[law] = Block("tracking", reads, writes, step)
        return blocks, [*delays, Delay(parts, "filtered")]


@pytest.mark.parametrize(
    ("wrong", "law"),
    [
        (Faulty(TRACKING, settings=[1]), controller_laws.frozen_value),
        (Faulty(TRACKING, change="no status"), controller_laws.writes_a_command_and_a_status),
        (Faulty(TRACKING, change="counts"), controller_laws.same_arguments_same_command),
        (Faulty(TRACKING, change="random"), controller_laws.same_command_everywhere),
        (Faulty(TRACKING, change="clamps first"), controller_laws.bad_measurement_never_acts),
        (Faulty(TRACKING, change="keeps NaN"), controller_laws.bad_measurement_never_acts),
        (Faulty(TRACKING, change="trusts responses"), controller_laws.bad_response_never_acts),
        (Faulty(Altered(rate=1.0, integral=False, change="pushes away")), controller_laws.exact_model_tracks),
        (Faulty(TRACKING, change="tells a plan"), controller_laws.facts_hold),
    ],
    ids=lambda v: getattr(v, "change", None),
)
def test_wrong_controllers_are_caught(wrong, law):
    """Also the clamp that turns a NaN into a full command."""
    assert law in controller_laws.LAWS
    trial = Trial(wrong, two_masses(), 1, 0.05, compiled=False)
    with pytest.raises(AssertionError, match=f"Faulty {breaks(law)}"):
        keep(wrong, trial, [law], seed=1)


# Plants


@pytest.mark.parametrize("name", shipped())
def test_plant_laws(name):
    problem = fp.load_problem(name).problem
    box = {e: (v - 0.1, v + 0.1) for e, v in zip(problem.plant.state.elements, problem.start_state, strict=True)}
    check_plant(problem.plant, seed=1, box=box)


def oscillator(response=None, inverse=None, cls=fp.Plant) -> fp.Plant:
    return cls(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        parameters={"m": fp.Parameter(1.5, 1.0, "kg"), "k": fp.Parameter(2.0, 3.0, "N/m")},
        response=response or (lambda q, v, u, p: {"y": (u.u - p.k * q.y) / p.m}),
        inverse=inverse,
    )


class HastyEquations(Equations):
    """Those of a motion that is twice as fast as its velocity says."""

    @property
    def forced_rate(self):
        inner = super().forced_rate
        symbols = inner.sx_in()
        return ca.Function("hasty", symbols, [inner(*symbols) * ca.DM([2, 1])])


class Hasty(fp.Plant):
    """A plant that moves twice as fast as its velocity says."""

    @property
    def equations(self):
        return HastyEquations(self)


def kinked(q, v, u, p):
    """A spring that is written so that its derivative is lost: rounding to a grid much finer than the motion."""
    return {"y": (u.u - p.k * ca.floor(q.y * 1e9) / 1e9) / p.m}


PLANTS = (
    (
        oscillator(lambda q, v, u, p: {"y": u.u / p.m - p.k * ca.sqrt(q.y)}),
        plant_laws.response_is_finite,
        "response of 'y'",
    ),
    (
        oscillator(lambda q, v, u, p: {"y": (u.u - 3.0 * q.y) / p.m}),
        plant_laws.both_parameter_sets_enter,
        "parameter 'k'",
    ),
    (
        oscillator(lambda q, v, u, p: {"y": (u.u - p.k * q.y) / p.m + random.random()}),
        plant_laws.response_is_pure,
        "built twice",
    ),
    (oscillator(cls=Hasty), plant_laws.derivative_is_the_chain, "dy/dt is"),
    (oscillator(kinked), plant_laws.slopes_are_true, "derivative of the response by 'y'"),
    (
        oscillator(inverse=lambda q, v, r, p: {"u": p.m * r.y - p.k * q.y}),
        plant_laws.inverse_inverts,
        "whose response is",
    ),
)


@pytest.mark.parametrize(("wrong", "law", "sentence"), PLANTS, ids=[law.__name__ for _, law, _ in PLANTS])
def test_wrong_plants_are_caught(wrong, law, sentence):
    """A sign in an inverse, a number where a parameter belongs, a lost derivative."""
    with pytest.raises(AssertionError, match=f"{breaks(law)}.*{sentence}"):
        check_plant(wrong, seed=1)


def test_the_box_is_checked():
    """A misspelt state is offered the right one; the box decides where a root is asked for."""
    with pytest.raises(InvalidProblem, match="Did you mean 'y'"):
        check_plant(oscillator(), seed=1, box={"yy": (0, 1)})
    check_plant(PLANTS[0][0], seed=1, box={"y": (1.0, 2.0)})


# The laws themselves


@pytest.mark.parametrize(
    ("laws", "tested"),
    [
        (tracking_laws, test_wrong_tracking_laws_are_caught),
        (optimiser_laws, test_wrong_optimisers_are_caught),
        (controller_laws, test_wrong_controllers_are_caught),
        (plant_laws, test_wrong_plants_are_caught),
    ],
    ids=lambda v: getattr(v, "__name__", ""),
)
def test_every_law_has_caught_something(laws, tested):
    """A law that no wrong class breaks might be one that cannot fail."""
    cases = {case[1].__name__ for mark in tested.pytestmark for case in mark.args[1]}
    others = (WRONG_CONTROLLERS, WRONG_MAPS, WRONG_OPTIMISERS, WRONG_OBSERVERS)
    cases |= {law.replace(" ", "_") for table in others for law, _ in (*table.values(), LOUD)}
    assert {law.__name__ for law in laws.LAWS} <= cases


def test_nan_is_within_nothing():
    """A comparison that NaN passes would let every law pass."""
    assert not within(math.nan, 1.0)
    assert not within([0.0, math.nan], 1.0)
    assert within([0.0, -1.0], 1.0)


def test_what_a_class_raises_is_noted():
    """A mistake of the class itself keeps its traceback, with the law that was tried."""

    @dataclass(frozen=True)
    class Broken(fp.ComputedTorque):
        def blocks(self, problem):
            return len(problem.plant.names) / 0

    with pytest.raises(ZeroDivisionError) as raised:
        check_controller(Broken(TRACKING), seed=1)
    assert any("Broken" in note and "law" in note for note in raised.value.__notes__)
