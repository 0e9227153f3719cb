"""Time slots: stability of schedules, relative orders, continuity at switches, and what is refused."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers import tasks
from helpers.forms import FORMS
from helpers.plants import pendulum
from helpers.plants import simulated as run

import fpirhc as fp
from fpirhc.contracts import Controller
from fpirhc.errors import FpirhcError

# Slots and schedules of shipped controllers are read and changed, which the contract of controllers says nothing about.

SHIPPED: Any = tasks


def crane(start: dict[str, float], **changes: Any) -> fp.Problem:
    """The crane from another start, measured from the first cycle."""
    values = {e: start.get(e, 0.0) for e in SHIPPED.crane_slots.problem.plant.state.elements}
    return replace(SHIPPED.crane_slots.problem, start=values, measure_from=0.0, **changes)


def switches(run_: fp.Run) -> np.ndarray:
    """First cycles of all slots but the first."""
    return np.flatnonzero(np.diff(run_["slot"][:, 0])) + 1


def pendulum_problem() -> fp.Problem:
    """A pendulum that follows a ramp with hardly enough torque."""
    return fp.Problem(
        plant=pendulum(),
        reference=fp.Trajectory(lambda t: {"angle": 0.5 * t}),
        start={"angle": 0.4},
        period=2e-3,
        duration=2.0,
        limits=fp.Limits(inputs={"torque": (-1.5, 1.5)}),
    )


def alone(name: str, law: Any, deformation: Any) -> fp.Slotted:
    """One slot that lasts the whole run."""
    return fp.Slotted({name: fp.ComputedTorque(law, deformation)}, {name: 0.5}, blend=0.1)


@pytest.mark.parametrize("integral", [False, True])
@pytest.mark.parametrize("deformation", [fp.Identity(), fp.Sigmoid(gain=-0.5, shift=0.3, scale=20.0)])
def test_one_slot_is_computed_torque(integral, deformation):
    """A slot that lasts the whole run, of a plant with one coordinate: law, deformation, integral, limits."""
    problem = pendulum_problem()
    law = fp.Exponential(rate=8.0, integral=integral)
    torque = run(problem, fp.ComputedTorque(law, deformation))
    slots = run(problem, alone("angle", law, deformation))
    assert torque["clipped"].any()  # so that the anti-windup is compared as well
    for name in ("command", "error", "desired", "deformed", "realised", "state", "clipped"):
        np.testing.assert_array_equal(slots[name], torque[name], err_msg=name)


MAPS = fp.Sigmoid(gain=-0.2, scale=100.0), fp.ModelReferenced(fp.Affine(gain=-0.2))
ELSEWHERE = "map", "late", "late curve", "encoder", "believed", "outside"  # where y^(r) is not that of equations


@pytest.mark.parametrize("name", ELSEWHERE)
@pytest.mark.parametrize("deformation", MAPS, ids=["plain", "referenced"])
def test_one_slot_is_computed_torque_where_responses_are_measured(name, deformation):
    """On maps, late, behind estimators, of a body outside: the plain form to rounding."""
    problem, law = replace(FORMS[name][0], horizon=None, cost=None, duration=1.6), fp.Exponential(rate=6.0)
    slots = alone("y", law, deformation)
    if deformation.form.modelled and name in ("encoder", "believed"):
        assert "gives a mean over several; use the map inside" in refused(problem, slots)
        return
    torque = run(problem, fp.ComputedTorque(law, deformation))
    slotted = run(problem, slots)
    scale, late = np.abs(torque["command"]).max(), 0 if not deformation.form.modelled else -80
    tolerance = 1e-9 if not late else 2e-3
    np.testing.assert_allclose(slotted["command"][late:], torque["command"][late:], atol=tolerance * scale)
    np.testing.assert_allclose(slotted["realised_of_slots"], slotted["realised"], atol=0)


@pytest.mark.parametrize("estimator", [fp.PositionDifference(), fp.VelocityDifference()])
def test_a_response_that_nobody_measures_is_the_difference_of_what_is(estimator):
    """The crane measures cart'' alone behind an estimator; the slot of the angle adapts to (angle' - angle'_before) / T."""
    problem = crane({"cart": -1.0}, sensing=fp.Sensing(estimator=estimator))
    plain, adaptive = (run(problem, SHIPPED.crane_slots.controllers[name]) for name in ("slots", "slots+FPI"))
    last = plain.time > 10.6
    errors = [np.sqrt(np.mean(r["error"][last] ** 2, axis=0)) for r in (plain, adaptive)]
    assert (errors[1] < 0.1 * errors[0]).all()
    speed = adaptive["state.angle'"]
    if isinstance(estimator, fp.VelocityDifference):
        found = adaptive["realised_of_slots.angle"][1:]
        np.testing.assert_allclose(found, np.diff(speed) / problem.period, atol=1e-9)


def referenced(slots: Any, **settings: Any) -> Any:
    """The slots with the model-referenced form."""
    return slots.with_deformation(fp.ModelReferenced(fp.Affine(gain=-0.3), **settings))


def test_slots_behind_a_dead_time_switch_without_a_jump():
    """Predicted, with the dead time in the form, which is told it by the problem; a form that is told none chatters."""
    problem = crane({"cart": -1.0}, duration=10.6, dead_time=fp.DeadTime(inputs={"F": 0.01}))
    slots = referenced(SHIPPED.crane_slots.controllers["slots"])
    largest = []
    for controller in (slots, referenced(slots, cycles=0.0)):
        result = run(problem, fp.Predicted(controller, inputs=0.01))
        steps = np.abs(np.diff(result["command"][:, 0]))
        assert steps[switches(result) - 1].max() < 1e-9
        largest.append(steps.max())
    ideal = run(replace(problem, dead_time=fp.DeadTime()), slots)
    assert largest[0] < 1.2 * np.abs(np.diff(ideal["command"][:, 0])).max() < 0.5 * largest[1]


def own_law(run_: fp.Run, name: str, rate: float) -> np.ndarray:
    """y''^Des = 2 rate e' + rate^2 e towards rest."""
    return -(2 * rate * run_[f"state.{name}'"] + rate**2 * run_[f"state.{name}"])


@pytest.mark.parametrize("name", ["slots", "slots+FPI"])
@pytest.mark.parametrize("blend", [0.1, 0.3])
def test_offset_decays_with_the_blend(name, blend):
    """A slot begins with the last command; what its desired response is away from the law falls as e^(-t / blend)."""
    result = run(crane({"cart": -1.0}, duration=5.3), replace(SHIPPED.crane_slots.controllers[name], blend=blend))
    (at,) = switches(result)
    assert abs(np.diff(result["command"][:, 0])[at - 1]) < 1e-12
    offset = result["desired.angle"] - own_law(result, "angle", 3.0)
    expected = offset[at] * np.exp(-(result.time[at:] - result.time[at]) / blend)
    assert abs(offset[at]) > 0.1
    np.testing.assert_allclose(offset[at:], expected, atol=1e-9)
    np.testing.assert_allclose((result["desired.cart"] - own_law(result, "cart", 1.0))[:at], 0, atol=1e-12)
    begins = result["realised_of_slots.angle"] if name == "slots+FPI" else result["deformed.angle"]
    assert result["desired.angle"][at] == pytest.approx(begins[at], rel=1e-9)


def test_a_deformation_starts_afresh_with_every_slot():
    """The tuned gain of one slot says nothing of the next: its factor is 1 at every start, and grows to 3 within."""
    sigmoid = fp.Sigmoid(gain=-1.0, shift=0.3, scale=10.0)
    tuned = fp.Tuned(sigmoid, largest_gain=3 * sigmoid.effective_gain())
    slots = SHIPPED.crane_slots.controllers["slots+FPI"].with_deformation(tuned)
    problem = crane({"cart": -1.0}, duration=10.6)
    result, stepper = run(problem, slots), fp.Stepper(problem, slots, compiled=False)
    memory, factors = stepper.start(), [list[float](), list[float]()]
    for time, state, realised in zip(result.time, result["state"], result["realised"], strict=True):
        _, memory = stepper.step(time, state, realised, memory)
        for k, remembered in enumerate(factors):
            remembered.append(stepper.memory.unpack(memory)[f"_{k}_tuner_factor"].item())
    assert len(result.spans()) == 4
    for start, end, slot in result.spans():
        first, last = round(start / result.period), round(end / result.period) - 1
        active, other = (np.array(factors[k]) for k in (slot, 1 - slot))
        assert active[first] == 1
        assert active[last] > 1.5
        assert (other[first : last + 1] == 1).all()


def refused(problem: fp.Problem, controller: Controller) -> str:
    """The message with which a controller is refused."""
    with pytest.raises(FpirhcError) as caught:
        run(problem, controller)
    return str(caught.value)


SLOT = fp.ComputedTorque(fp.Exponential(rate=2.0))
WRONG: dict[str, tuple[Any, str]] = {
    "never its turn": (({"cart": SLOT, "angle": SLOT}, {"cart": 1.0}), "slot 'angle' is never active; give it time"),
    "unknown": (({"carts": SLOT}, {"carts": 1.0}), "slot 'carts' is unknown. Did you mean 'cart'?"),
    "too short": (({"cart": SLOT}, {"cart": 1e-3}), "below the control cycle of 0.005 s"),
    "none": (({}, {"cart": 1.0}), "give at least one: {coordinate: ComputedTorque(tracking)}"),
    "wrong sign": (
        ({"angle": SLOT.with_deformation(fp.Affine(gain=0.3))}, {"angle": 1.0}),
        "slot 'angle': Affine(gain=0.3)",
    ),
    "no law": (({"cart": fp.PID({"cart": 1.0})}, {"cart": 1.0}), "has no law whose response a map deforms"),
    "pairs of another slot": (
        ({"angle": replace(SLOT, deformation=fp.Paired(fp.Affine(gain=-0.3), cycles=2))}, {"angle": 1.0}),
        "Paired keeps pairs of earlier cycles, which belong to another slot after a switch",
    ),
}


@pytest.mark.parametrize(("given", "words"), WRONG.values(), ids=WRONG)
def test_wrong_slots_are_refused(given, words):
    slots, durations = given
    assert words in refused(crane({"cart": -1.0}), fp.Slotted(slots, durations, blend=0.1))


def test_slots_are_refused_on_several_inputs_and_where_nobody_judges():
    """One input is taken in turn, and what a slot controls is judged."""
    two = tasks.two_mass.problem
    assert "take turns on one input; the plant has" in refused(two, alone("q1", SLOT.tracking, fp.Identity()))
    quiet = crane({"cart": -1.0}, judged=("cart",))
    assert "write Problem(..., judged=('cart', 'angle'))" in refused(
        quiet, alone("angle", SLOT.tracking, fp.Identity())
    )
