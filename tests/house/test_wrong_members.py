"""A wrong member of a family is caught by the public laws, with the law that it breaks; the right one beside it is not.

Members are as somebody else might write them: one right member of each family, and wrong ones that differ from it in one thing.
"""

# ruff: noqa: ARG002 - arguments are those of the contract

from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.conformance import check_controller, check_deformation, check_observer, check_optimiser, laws_of
from fpirhc.contracts import (
    Block,
    Controller,
    Deformation,
    Form,
    Layout,
    Optimiser,
    Signal,
    StateObserver,
    Tracking,
    clip,
    closing_blocks,
    is_finite,
    judge,
    like,
    reduced_gradient,
    reference_block,
    remembered_plan,
    sane,
    shift,
    status_of,
    values_of,
)
from fpirhc.errors import NotSupported

DEFORMATION = fp.Sigmoid(gain=-0.5)


# Controllers


@dataclass(frozen=True)
class Gentle(Controller):
    """q''Des = q''N + rate^2 e + 2 rate e', saturated; a controller that keeps every law."""

    rate: float
    deformation: Deformation = field(default_factory=fp.Identity)
    limit: float = 40.0

    def blocks(self, built):
        plant, motion = built.plant, self.motion(built.plant)
        size = len(plant.chains)

        def step(s):
            error = s.reference - getattr(s, motion.name)
            wanted = self.rate**2 * error[:size] + 2 * self.rate * error[size:]
            nominal = s._reference_response
            return {"nominal": nominal, "desired": nominal + self.limit * ca.tanh(wanted / self.limit)}

        reads = Layout((motion, like(plant.output, "reference"), plant.response_signal("_reference_response")))
        writes = Layout((plant.response_signal("nominal"), plant.response_signal("desired")))
        closing, delays = closing_blocks(built, self.deformation)
        return [reference_block(built), Block("law", reads, writes, step), *closing], delays

    def check(self, problem):
        if problem.plant.step is not None or set(problem.plant.chains.values()) != {2}:
            raise NotSupported("Gentle feeds back an error and its derivative: outputs of relative order 2 only")

    def motion(self, plant):
        return plant.output


GENTLE = Gentle(6.0, DEFORMATION)


def changed(name: str, change: Any) -> Any:
    """Its blocks with the step of one of them, or of every one, wrapped: change(step, signals, plant)."""

    def blocks(self, built):
        own, delays = Gentle.blocks(self, built)
        wrapped = lambda block: replace(block, step=lambda s: change(block.step, s, built.plant))  # noqa: E731
        return [wrapped(block) if name in (block.name, "every") else block for block in own], delays

    return blocks


def with_exact_parameters(step, s, plant):
    if hasattr(s, "parameters"):
        s.parameters = ca.DM(plant.exact)
    return step(s)


def with_a_louder_desire(step, s, plant):
    s.desired = 1.05 * s.desired
    return step(s)


def turned(step, s, plant):
    said = step(s)
    return {**said, "desired": 2 * said["nominal"] - said["desired"]}


CONTROLLERS: dict[str, dict[str, Any]] = {
    "KnowsThePlant": {"blocks": changed("every", with_exact_parameters)},
    "LeavesTheLimits": {"blocks": changed("limit", lambda step, s, _: {**step(s), "command": s.command_unclipped})},
    "SaysItLearns": {"learns": True},
    "SaysItDeformsNoResponse": {"deforms": "command"},
    "DeformsAnotherResponse": {"blocks": changed("deform", with_a_louder_desire)},
    "AlwaysOk": {"blocks": changed("judge", lambda step, s, _: {"status": 0 * s._held})},
    "TakesTheStateForTheOutput": {"motion": lambda self, plant: plant.state},
    "IgnoresItsDeformation": {"blocks": lambda self, built: Gentle(self.rate).blocks(built)},
    "NamesAnotherLaw": {"tracking": property(lambda self: fp.Exponential(rate=10 * self.rate, integral=False))},
    "PushesAway": {"blocks": changed("law", turned)},
    "NotesAreOneText": {"notes": lambda self, problem: "It feeds back a saturated error."},
    "SaysItControlsMaps": {"check": lambda self, problem: None},
}


# Maps


@dataclass(frozen=True)
class Softsign(Deformation):
    """r+ = r - gain e / sqrt(1 + |e|^2 / size^2) with e = f - d; a map that keeps every law."""

    gain: float
    size: float

    def step(self, request, response, desired, memory):
        return request - self.gain * self.move(response - desired), {}

    def move(self, error):
        return error / ca.sqrt(1 + self.share(error))

    def share(self, error):
        return ca.sumsqr(error) / self.size**2

    def effective_gain(self):
        return self.gain

    def with_effective_gain(self, gain):
        return replace(self, gain=gain)


SOFTSIGN = Softsign(0.3, 5.0)


def bump(self, error):
    """Beyond one around an error of three sizes, so that steps turn back from two to four."""
    return 1.5 * ca.exp(-((ca.sqrt(self.share(error) + 1e-12) - 3) ** 2) * 4)


MAPS: dict[str, dict[str, Any]] = {
    "HalfTheSecant": {"secant_gain": lambda self: 0.5 * self.gain},
    "MovesItsFixedPoint": {"move": lambda self, error: Softsign.move(self, error) + 1e-3 / self.gain},
    "DividesByZero": {"move": lambda self, error: error / ca.norm_2(error) * ca.norm_2(error)},
    "OtherSign": {"effective_gain": lambda self: -self.gain},
    "Kinked": {"move": lambda self, error: Softsign.move(self, ca.if_else(error > 0, error, 2 * error))},
    "Wavelet": {"move": lambda self, error: error * (1 - self.share(error)) * ca.exp(-self.share(error) / 2)},
    "Rests": {"move": lambda self, error: Softsign.move(self, error) * (1 - bump(self, error))},
    "GivesAnotherGain": {"with_effective_gain": lambda self, gain: replace(self, gain=2 * gain)},
    "HidesNaN": {"step": lambda self, r, f, d, m: Softsign.step(self, r, ca.fmax(-1e3, ca.fmin(1e3, f)), d, m)},
    "TellsTwiceItsGain": {
        "effective_gain": lambda self: 2 * self.gain,
        "with_effective_gain": lambda self, gain: replace(self, gain=0.5 * gain),
    },
    "SaysItIsLate": {"form": Form(cycles=3)},
    "SaysItIncrements": {"form": Form("increment")},
}


# Optimisers


@dataclass(frozen=True)
class HeavyBall(Optimiser):
    """Projected gradient descent with momentum; an optimiser that keeps every law."""

    iterations: int
    tolerance: float

    def check(self, ocp):
        if ocp.bounds_states:
            raise NotSupported("HeavyBall keeps limits of inputs only")

    def memory(self, ocp):
        names = tuple(f"{i}@{k}" for k in range(ocp.stages) for i in ocp.input.elements)
        return Layout((Signal("plan_inputs", names),))

    def shifted(self, ocp, memory):
        return ca.vec(shift(ca.reshape(memory, ocp.input.size, ocp.stages), ocp))

    def step(self, ocp):
        nu, ns, n = ocp.input.size, ocp.state.size, ocp.stages
        s0, data = ca.MX.sym("s0", ns), ca.MX.sym("data", ocp.data.size, n + 1)
        lower, upper, memory = ca.MX.sym("lower", nu), ca.MX.sym("upper", nu), ca.MX.sym("memory", nu * n)
        start, none = remembered_plan(memory, nu, lower, upper), ca.DM.zeros(ns, n)
        plan: Any = start
        before: Any = start
        scale = ca.repmat(ca.DM(1 / (ocp.step * ocp.curvature)), 1, n)
        for _ in range(self.iterations):
            downhill = reduced_gradient(ocp)(s0, plan, data, none)[1] * scale
            plan, before = clip(plan - 0.12 * downhill + 0.5 * (plan - before), lower, upper), plan
        numbers: Any = ca.vertcat(*judge(ocp)(plan, s0, data, lower, upper, none))
        finite = ca.logic_and(sane(s0, data, lower, upper), is_finite(ca.vertcat(ca.vec(plan), numbers)))
        plan, numbers = ca.if_else(finite, plan, start), ca.if_else(finite, numbers, ca.DM.zeros(3))
        judged = status_of(finite, numbers[1], numbers[2], self.tolerance)
        status = ca.if_else(ca.mmax(lower - upper) > 0, int(fp.Status.INFEASIBLE), judged)
        results = self.final(plan, ca.vertcat(numbers, self.iterations, status), ca.vec(plan))
        return ca.Function("heavy_ball", [s0, data, lower, upper, memory], list(results))

    def final(self, plan, numbers, memory):
        return plan, numbers, memory


HEAVY_BALL = HeavyBall(100, 1e-6)


def ending(change: Any) -> dict[str, Any]:
    """What it returns, otherwise: change(plan, (cost, stationarity, feasibility, iterations, status), memory)."""
    return {"final": lambda self, *results: change(*results)}


OPTIMISERS: dict[str, dict[str, Any]] = {
    "AlwaysOk": ending(lambda plan, n, memory: (plan, ca.vertcat(n[:4], 0), memory)),
    "NoCost": ending(lambda plan, n, memory: (plan, ca.vertcat(0, n[1:]), memory)),
    "DoesNotShift": {"shifted": lambda self, ocp, memory: memory},
    "LeavesTheBox": ending(lambda plan, n, memory: (1.5 * plan, n, memory)),
    "ForgetsItsPlan": ending(lambda plan, n, memory: (plan, n, 0 * memory)),
    "CountsThree": ending(lambda plan, n, memory: (plan, ca.vertcat(n[:3], 3, n[4]), memory)),
    "TenthOfTheResidual": ending(lambda plan, n, memory: (plan, ca.vertcat(n[0], 0.1 * n[1], n[2:]), memory)),
    "SaysItMayTakeAnyTime": {"unbounded": "it may take any time"},
}

# Observers of states


@dataclass(frozen=True)
class ConstantGain(StateObserver):
    """x^ = x- + gain (y - h(x-)) for every state that is measured itself; an observer that keeps every law."""

    gain: float

    def check(self, plant, measured):
        """Accept every plant."""

    def memory(self, model):
        state = model.plant.state
        return Layout((Signal("observed_state", state.elements, state.units, tuple(map(float, model.start))),))

    def predict(self, model):
        calm = np.zeros(len(model.plant.names))
        return lambda evidence, memory: model.move(
            memory["observed_state"], evidence.command, evidence.parameters, calm, evidence.moves
        )

    def correct(self, model):
        """A share of what is measured beyond the prediction."""
        elements = model.plant.state.elements

        def corrected(evidence, memory, predicted):
            expected = values_of(model.plant, predicted, evidence.command, evidence.parameters)
            shown = [evidence.measured[e] - expected[e] if e in model.measured else 0 for e in elements]
            state = ca.if_else(evidence.counts, predicted + self.gain * ca.vertcat(*shown), predicted)
            return state, {"observed_state": state}

        return corrected


def told(change: Any) -> dict[str, Any]:
    """The observer with evidence that is changed before it is used: change(evidence, model)."""

    def predict(self, model):
        inner = ConstantGain.predict(self, model)
        return lambda evidence, memory: inner(change(evidence, model), memory)

    def correct(self, model):
        inner = ConstantGain.correct(self, model)
        return lambda evidence, memory, predicted: inner(change(evidence, model), memory, predicted)

    return {"predict": predict, "correct": correct}


def forgetting(self, model):
    """Remember what was predicted."""
    inner = ConstantGain.correct(self, model)
    return lambda evidence, memory, predicted: (inner(evidence, memory, predicted)[0], {"observed_state": predicted})


CONSTANT_GAIN = ConstantGain(0.4)
OBSERVERS: dict[str, dict[str, Any]] = {
    "EverySampleCounts": told(lambda evidence, model: replace(evidence, counts=ca.SX(1))),
    "EverySampleMoves": told(lambda evidence, model: replace(evidence, moves=ca.SX(1))),
    "KnowsThePlant": told(lambda evidence, model: replace(evidence, parameters=ca.DM(model.plant.exact))),
    "ForgetsItsCorrection": {"correct": forgetting},
}


# The laws that they break, each with a part of the sentence about it


def made(right: Any, changes: dict[str, dict[str, Any]], laws: dict[str, tuple[str, str]]) -> list[Any]:
    """The wrong members, which differ from the right one in one thing, with their laws."""
    assert changes.keys() == laws.keys()
    kinds = [type(name, (type(right),), change) for name, change in changes.items()]
    return [pytest.param(kind(**vars(right)), *laws[kind.__name__], id=kind.__name__) for kind in kinds]


OF_CONTROLLERS = {
    "KnowsThePlant": ("exact parameters are unknown", "in place of.*use plant.approximate"),
    "LeavesTheLimits": ("command keeps the limits", "outside"),
    "SaysItLearns": ("learning remembers", "learns is true, but after 400 cycles"),
    "SaysItDeformsNoResponse": ("deformation acts", "deforms is 'command', but"),
    "DeformsAnotherResponse": ("deformation acts", r"'deformed' misses .* by the share 0\.00[34]"),
    "AlwaysOk": ("bad measurement never acts", "'a' measured as nan.*status of that cycle is OK"),
    "TakesTheStateForTheOutput": ("what it takes it controls", "read plant.output and not plant.state"),
    "IgnoresItsDeformation": ("deformation acts", "half of the effective gain 0.198"),
    "NamesAnotherLaw": ("law is what it does", "fed back with 36, its law Exponential says 3600"),
    "PushesAway": ("exact model tracks", "with the exact model"),
    "NotesAreOneText": ("facts hold", "its notes are 'It feeds"),
    "SaysItControlsMaps": ("what it takes it controls", "can control a map, but cannot be built"),
}
OF_MAPS = {
    "HalfTheSecant": ("step is bounded", r"secant_gain\(\) 0.15 is below the effective gain 0.3"),
    "MovesItsFixedPoint": ("step is bounded", "an error of 0 moves the request by 0.00141"),
    "DividesByZero": ("derivatives are finite", "the value is not finite"),
    "OtherSign": ("gain can be set", "a OtherSign with the effective gain -0.8"),
    "Kinked": ("step is bounded", r"above \|secant_gain\(\)\| times it"),
    "Wavelet": ("only desired is fixed", "an error of 5.* a false fixed point is near"),
    "Rests": ("only desired is fixed", "an error of 1.* a false fixed point is near"),
    "GivesAnotherGain": ("gain can be set", "the effective gain 1.6"),
    "HidesNaN": ("nan shows", "a response of NaN is hidden"),
    "TellsTwiceItsGain": ("gain and pairs are told", "a pair takes 0.5 times the gain off"),
    "SaysItIsLate": ("gain and pairs are told", "a response 3 cycles late a pair takes 4.01 times"),
    "SaysItIncrements": ("compares as it says", "with the increment, .* it requests 0.2887 and not 1"),
}
OF_OPTIMISERS = {
    "AlwaysOk": ("numbers are true", "calls a plan OK whose stationarity by"),
    "NoCost": ("numbers are true", "reports the cost 0 of the plan, simulation gives"),
    "DoesNotShift": ("solution stays", r"shifted\(\) changes inputs of the plan by"),
    "LeavesTheBox": ("remembers a plan", "differs from the plan that it gave"),
    "ForgetsItsPlan": ("remembers a plan", "the next call would not begin with it"),
    "CountsThree": ("iterations are counted", "reports 3 iterations, but with iterations=3"),
    "TenthOfTheResidual": ("numbers are true", "reports the stationarity"),
    "SaysItMayTakeAnyTime": ("work is bounded as told", "calls no solver"),
}
OF_OBSERVERS = {
    "EverySampleCounts": ("old samples do nothing", "with counts = 0.*by 0.4"),
    "EverySampleMoves": ("old samples do nothing", "with moves = 0"),
    "KnowsThePlant": ("exact parameters are unknown", "use evidence.parameters"),
    "ForgetsItsCorrection": ("wrong start is corrected", r"wrong by 0\.07 in the later|by 0\.07"),
}
WRONG = [
    *made(GENTLE, CONTROLLERS, OF_CONTROLLERS),
    *made(SOFTSIGN, MAPS, OF_MAPS),
    *made(HEAVY_BALL, OPTIMISERS, OF_OPTIMISERS),
    *made(CONSTANT_GAIN, OBSERVERS, OF_OBSERVERS),
    # A gain with which every correction is worse than the error.
    pytest.param(ConstantGain(3.0), "wrong start is corrected", "does not converge", id="Loud"),
]


def check(member: Any) -> None:
    """Try the laws of its family."""
    if isinstance(member, Controller):
        check_controller(member, seed=1, compiled=False)
    elif isinstance(member, Deformation):
        check_deformation(member, seed=1)
    elif isinstance(member, Optimiser):
        check_optimiser(member, tolerance=1e-6, seed=1)
    else:
        check_observer(member, seed=1)


@pytest.mark.parametrize(("member", "law", "sentence"), WRONG)
def test_a_wrong_member_is_caught(member, law, sentence):
    """One sentence that names the class, the law, the numbers and what to do."""
    told = f"^{type(member).__name__} breaks the law '{law}': .*{sentence}.*The law: "
    with pytest.raises(AssertionError, match=told):
        check(member)


@pytest.mark.parametrize("member", [GENTLE, SOFTSIGN, HEAVY_BALL, CONSTANT_GAIN], ids=lambda one: type(one).__name__)
def test_the_right_members_are_not_refused(member):
    check(member)


def test_a_controller_that_knows_the_exact_parameters_may_say_so():
    """As the bound of a comparison: the same command, honestly named."""
    honest = type("Honest", (Gentle,), {**CONTROLLERS["KnowsThePlant"], "exact_model": True})
    check_controller(honest(6.0, DEFORMATION), seed=1, compiled=False)
    assert fp.Predicted(fp.ExactModel(Gentle(6.0)), inputs=0.0).exact_model
    assert not fp.ComputedTorque(fp.Exponential(rate=6.0)).exact_model


# Members of the contracts -> the laws that test them

MEMBERS: dict[str, tuple[Any, dict[str, str]]] = {
    "controller": (
        Controller,
        {
            "blocks": "same command everywhere",
            "check": "what it takes it controls",
            "deformation": "deformation acts",
            "deforms": "deformation acts",
            "exact_model": "exact parameters are unknown",
            "inner": "frozen value",
            "inner_problem": "same command everywhere",
            "learns": "learning remembers",
            "notes": "facts hold",
            "planner": "facts hold",
            "with_deformation": "deformation acts",
        },
    ),
    "deformation": (
        Deformation,
        {
            "adapts": "gain and pairs are told",
            "effective_gain": "gain and pairs are told",
            "inner": "frozen value",
            "form": "compares as it says",
            "memory": "gain and pairs are told",
            "secant_gain": "step is bounded",
            "step": "step is bounded",
            "with_effective_gain": "gain can be set",
        },
    ),
    "observer": (
        StateObserver,
        {
            "check": "wrong start is corrected",
            "correct": "wrong start is corrected",
            "memory": "old samples do nothing",
            "predict": "right model believes what is",
            "uses": "wrong start is corrected",
        },
    ),
    "tracking": (
        Tracking,
        {
            "check": "error decays",
            "delays": "clipping freezes",
            "gains": "gains are what it does",
            "law": "zero error asks for the nominal response",
            "update": "clipping freezes",
        },
    ),
}


@pytest.mark.parametrize("module", MEMBERS)
def test_every_member_of_a_contract_has_a_law(module):
    """A fact that no law tests may be anything."""
    contract, table = MEMBERS[module]
    own = {n for n in (*vars(contract), *contract.__annotations__) if not n.startswith("_")}
    assert own == {*table}
    laws = laws_of(f"fpirhc.conformance.{module}")
    assert {*table.values()} <= {"frozen value", *(law.__name__.replace("_", " ") for law in laws)}
