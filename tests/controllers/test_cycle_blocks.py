"""The blocks that all controllers share, one cycle by value; and the demands that choose automatic settings."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc import Status
from fpirhc.contraction.delayed import step_for_basin
from fpirhc.contracts import Block, Controller, Deformation, Response, reference_block, scalar
from fpirhc.controllers.base import clip, commanding_blocks, deform_block, invert_block
from fpirhc.controllers.check import check_form, checked
from fpirhc.controllers.contract import (
    Planner,
    PlantModel,
    resolved,
    tracking_law,
    with_lateness,
    with_optimiser,
    without_deformation,
)
from fpirhc.controllers.model_inputs import MEASURED
from fpirhc.controllers.reference_states import (
    largest_response,
    reference_states,
    request_along_reference,
    request_of_commands,
    request_of_plans,
)
from fpirhc.controllers.sensing_chain import compose_controller, controller_reads
from fpirhc.deformation.base import with_inner
from fpirhc.errors import InvalidValue, NotContractive, NotSupported

PERIOD = 0.1
TIMES = np.linspace(0.0, 10.0, 100001)
TRACK = fp.Exponential(rate=2.0)


def masses(**settings: Any) -> fp.Problem:
    """Two masses, 2 and 4 kg, taken for 1 and 8; b'' also feels a force of 3 N. Along sin 2t and cos t."""
    plant = fp.Plant(
        coordinates={"a": "m", "b": "rad"},
        inputs={"u": "N", "w": "N"},
        parameters={"m": fp.Parameter(1.0, 2.0, "kg"), "n": fp.Parameter(8.0, 4.0, "kg")},
        response=lambda q, v, u, p: {"a": u.u / p.m, "b": (u.w - 3.0) / p.n},
    )
    usual: dict[str, Any] = {"start": {"a": 0.0, "b": 1.0}, "period": PERIOD, "duration": 10.0}
    reference = fp.Trajectory(lambda t: {"a": ca.sin(2 * t), "b": ca.cos(t)})
    return fp.Problem(plant, reference, **(usual | settings))


def cycle(block: Block, **signals: Any) -> dict[str, np.ndarray]:
    """What a block writes in one cycle."""
    memory = [block.memory.start()] if block.memory.size else []
    values = [ca.DM(signals.get(s.name, np.zeros(s.size))) for s in block.reads.signals]
    results = block.function(*values, *memory)
    results = results if isinstance(results, tuple | list) else [results]
    names = block.function.name_out()
    return {name: np.asarray(r.full()).ravel() for name, r in zip(names, results, strict=True)}


def closing(problem: fp.Problem, *judged: str) -> dict[str, Block]:
    return {b.name: b for b in commanding_blocks(problem, [scalar(name) for name in judged])[0]}


LIMITED = masses(limits=fp.Limits(inputs={"u": (-2.0, 3.0)}))
BELIEVED, STATE = [1.0, 8.0], [0.0, 0.0, 0.0, 0.0]


# One cycle


def test_a_command_inside_its_limits_is_passed():
    """The stored request is the wanted one, nothing is clipped and nothing held."""
    wanted = {"command_unclipped": [2.5, 99.0], "_deformed_unclipped": [7.0, 8.0], "desired": [1.0, 1.0]}
    result = cycle(closing(LIMITED)["limit"], **wanted, state=STATE, parameters=BELIEVED)
    assert result["command"].tolist() == [2.5, 99.0]
    assert result["deformed"].tolist() == [7.0, 8.0]
    assert (result["clipped"].item(), result["_held"].item()) == (0.0, 0.0)


@pytest.mark.parametrize(("unclipped", "clipped"), [(5.0, 3.0), (-5.0, -2.0)])
def test_a_clipped_command_changes_the_stored_request(unclipped, clipped):
    """By what the model's input gain, 1 / 1 kg, makes of the difference: the request that the command meant."""
    wanted = {"command_unclipped": [unclipped, 99.0], "_deformed_unclipped": [7.0, 8.0], "desired": [1.0, 1.0]}
    result = cycle(closing(LIMITED)["limit"], **wanted, state=STATE, parameters=BELIEVED)
    assert result["command"].tolist() == [clipped, 99.0]
    assert result["deformed"] == pytest.approx([7.0 + clipped - unclipped, 8.0])
    assert (result["clipped"].item(), result["_held"].item()) == (1.0, 0.0)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_a_command_that_is_not_finite_is_held(wrong):
    """One entry is enough: the last command goes on, clipped, and the next cycle begins from the desired response."""
    wanted = {"command_unclipped": [1.0, wrong], "_deformed_unclipped": [7.0, 8.0], "desired": [1.5, 2.5]}
    last = {"_command_before": [4.0, 5.0], "state": STATE, "parameters": BELIEVED}
    result = cycle(closing(LIMITED)["limit"], **wanted, **last)
    assert result["command"].tolist() == [3.0, 5.0]
    assert result["deformed"].tolist() == [1.5, 2.5]
    assert result["_held"].item() == 1.0


def test_a_response_that_is_not_affine_is_evaluated_where_it_was_clipped():
    """u^3 / m at the clipped 2 N is 8, whatever was wanted; unclipped the wanted request is kept to the last digit."""
    plant = fp.Plant(
        coordinates={"a": "m"},
        inputs={"u": "N"},
        parameters={"m": fp.Parameter(1.0, 1.0, "kg")},
        response=lambda q, v, u, p: {"a": u.u**3 / p.m},
        inverse=lambda q, v, r, p: {"u": ca.sign(r.a) * ca.fabs(p.m * r.a) ** (1 / 3)},
    )
    problem = fp.Problem(
        plant,
        fp.Trajectory(lambda t: {"a": t**3}),
        start={"a": 0.0},
        period=PERIOD,
        duration=1.0,
        limits=fp.Limits(inputs={"u": (-2.0, 2.0)}),
    )
    block = closing(problem)["limit"]
    for command, request, stored in ((3.0, 27.0, 8.0), (1.0, 1.0 + 1e-15, 1.0 + 1e-15)):
        result = cycle(block, command_unclipped=command, _deformed_unclipped=request, state=[0.0, 0.0], parameters=1.0)
        assert result["deformed"].item() == stored


def test_clip_takes_one_side_or_both():
    u = ca.SX([-9.0, -9.0, 9.0, 9.0])
    lower, upper = np.array([-1.0, -np.inf, -np.inf, -1.0]), np.array([1.0, 1.0, np.inf, np.inf])
    down, up = (np.asarray(ca.evalf(clip(v, lower, upper)).full()).ravel().tolist() for v in (u, -u))
    assert (down, up) == ([-1.0, -9.0, 9.0, 9.0], [1.0, 1.0, -9.0, -1.0])


def test_the_worst_status_of_a_cycle_counts():
    """A held command is not finite; otherwise the solver's status stands, the worst of several."""
    judge = closing(LIMITED, "first", "second")["judge"]
    assert cycle(judge, _held=0.0, first=1.0, second=2.0)["status"].item() == 2.0
    assert cycle(judge, _held=0.0, first=2.0, second=1.0)["status"].item() == 2.0
    assert cycle(judge, _held=1.0, first=1.0)["status"].item() == int(Status.NON_FINITE)
    assert cycle(closing(LIMITED)["judge"], _held=0.0)["status"].item() == 0.0


def test_warm_up_counts_the_blind_cycles():
    running = closing(LIMITED)["running"]
    assert [cycle(running, warm_up=k)["_warm_up_now"].item() for k in (0.0, 1.0, 5.0)] == [1.0, 1.0, 1.0]


@pytest.mark.parametrize(("counted", "blind", "valid"), [(0, 1, False), (1, 1, True), (2, 3, False), (3, 3, True)])
def test_the_request_is_deformed_once_the_pair_is_valid(counted, blind, valid):
    """Affine(-1): request + 0.5 (desired - realised) = 10 + 0.5 (4 - 2); before that the desired response."""
    block = deform_block(masses().plant, fp.Affine(-1.0), blind)
    pair = {"_deformed_last": [10.0, 20.0], "realised": [2.0, 3.0], "desired": [4.0, 4.0]}
    result = cycle(block, **pair, warm_up=float(counted))
    assert result["_deformed_unclipped"].tolist() == ([11.0, 20.5] if valid else [4.0, 4.0])
    assert result["_deformation"].tolist() == ([7.0, 16.5] if valid else [0.0, 0.0])


@pytest.mark.parametrize(
    ("error", "learns"), [([9_999.0, 0.0], True), ([10_001.0, 0.0], False), ([-1e9, 0.0], False), ([0.0, 1e9], True)]
)
def test_a_map_with_a_memory_remembers_nothing_of_an_absurd_error(error, learns):
    """Beyond 10 000 times the response that limits allow, 1 of the first and any of the second coordinate; the request stays."""
    block = deform_block(masses().plant, fp.Filtered(fp.Affine(-1.0), pole=0.5), largest=(1.0, np.inf))
    pair = {"_deformed_last": [10.0, 20.0], "realised": error, "desired": [0.0, 0.0], "warm_up": 1.0}
    result = cycle(block, **pair)
    assert (result["_deformed_unclipped"].tolist() != [10.0, 20.0]) == learns
    after = np.concatenate([result[f"{name}_next"] for name in block.memory.names])
    assert (after != block.memory.start()).any() == learns


def test_one_blind_cycle_where_nothing_else_is_said():
    """The first cycle has no pair, the second has one."""
    pair = {"_deformed_last": [10.0, 20.0], "realised": [2.0, 3.0], "desired": [4.0, 4.0]}
    block = deform_block(masses().plant, fp.Affine(-1.0))
    assert [cycle(block, **pair, warm_up=k)["_deformation"].tolist() for k in (0.0, 1.0)] == [[0.0, 0.0], [7.0, 16.5]]


def test_a_predicting_controller_reads_the_measured_state_too():
    """A mirror needs it: it is the state itself, unless the controller's state is that of another time."""
    adaptive = fp.ComputedTorque(TRACK, fp.ModelReferenced(fp.Affine(-0.5)))
    own, ahead = (compose_controller(masses(), adaptive, **k).reads for k in ({}, {"ahead": True}))
    assert own.names == ("time", "state", "realised", "parameters")
    assert ahead.names == (*own.names, MEASURED)
    plain = compose_controller(masses(), fp.ComputedTorque(TRACK), ahead=True).reads
    assert plain.names == own.names


def test_command_of_a_request():
    """The believed masses of 1 and 8 kg and the force of 3 N."""
    result = cycle(invert_block(masses().plant), state=STATE, _deformed_unclipped=[5.0, 0.5], parameters=BELIEVED)
    assert result["command_unclipped"].tolist() == [5.0, 7.0]


def test_error_is_of_the_judged_coordinates():
    """Reference minus state, in their units; the response is that of the controlled ones."""
    problem = masses(judged=("b",))
    result = cycle(reference_block(problem), time=0.5, state=[0.1, 0.2, 0.3, 0.4])
    assert result["error"] == pytest.approx([np.cos(0.5) - 0.2])
    assert result["_reference_response"] == pytest.approx([-4 * np.sin(1.0), -np.cos(0.5)])
    assert result["reference"] == pytest.approx([np.sin(1.0), np.cos(0.5), 2 * np.cos(1.0), -np.sin(0.5)])
    assert reference_block(problem).writes["error"].units == ("rad",)


# Facts of controllers


PLANNER = Planner(fp.FixedPoint(iterations=1, tolerance=1e-3), None, True, None)


@dataclass(frozen=True)
class Telling(Controller):
    """A controller that tells facts of its own, on the plant that it sees."""

    deformation: Deformation = field(default_factory=fp.Identity)
    of_its_own: bool = False

    learns = True
    planner = PLANNER
    feeds = MappingProxyType({"state": "predicted"})

    def blocks(self, problem):  # noqa: ARG002
        return [], []

    def plant_model(self, problem):
        return PlantModel(problem.plant, problem.signals, given={"m": 2.0})

    def with_defaults(self, problem):
        """The gain of a map is the first approximate parameter."""
        gained = fp.Affine(float(problem.plant.approximate[0]))
        return replace(self, deformation=gained) if self.deformation.adapts else self

    def response(self, problem):
        """The plant's, under the same name, where it reads responses of its own."""
        plant = problem.plant
        return (
            Response(plant.response_signal("realised"), plant.equations.controlled_response)
            if self.of_its_own
            else None
        )

    def notes(self, problem):
        return (f"mass {problem.plant.approximate[0]}",)

    def check(self, problem):
        raise InvalidValue(f"mass {problem.plant.approximate[0]}")


@dataclass(frozen=True)
class Planning(Telling):
    """A controller with an optimiser in a field."""

    optimiser: Any = "one"


def test_a_wrapper_tells_the_facts_of_what_it_wraps():
    """On the problem that the inner controller sees: the exact mass of 2 kg in place of 1 kg."""
    problem, inner = masses(), Telling(fp.Affine(-0.25))
    outer = fp.ExactModel(inner)
    assert outer.learns
    assert (outer.planner, dict(outer.feeds)) == (inner.planner, {"state": "predicted"})
    assert resolved(problem, outer) == fp.ExactModel(Telling(fp.Affine(2.0)))
    assert outer.notes(problem) == ("mass 2.0",)
    assert outer.response(problem) is None
    assert fp.ExactModel(replace(inner, of_its_own=True)).response(problem) is not None
    with pytest.raises(InvalidValue, match=r"mass 2\.0"):
        outer.check(problem)
    assert outer.with_deformation(fp.Identity()) == fp.ExactModel(Telling())
    assert with_optimiser(fp.ExactModel(Planning()), PLANNER.optimiser) == fp.ExactModel(
        Planning(optimiser=PLANNER.optimiser)
    )
    assert without_deformation(outer) == fp.ExactModel(Telling())
    assert without_deformation(fp.ExactModel(Telling())) == fp.ExactModel(Telling())


def test_a_controller_that_stands_alone_has_no_facts_of_others():
    """It believes the approximate parameters, learns nothing, plans nothing, and tracks by its own law."""
    problem, alone = masses(), fp.ComputedTorque(TRACK)
    assert (alone.inner, alone.learns, alone.planner, dict(alone.feeds)) == (None, False, None, {})
    assert tracking_law(alone) is tracking_law(fp.ExactModel(alone)) is TRACK
    assert tracking_law(Telling()) is None
    model = alone.plant_model(problem)
    assert (model.plant, model.exact, model.parameters(problem.plant).tolist()) == (problem.plant, False, [1.0, 8.0])
    assert Telling().plant_model(problem).parameters(problem.plant).tolist() == [2.0, 8.0]
    assert fp.ExactModel(Telling()).plant_model(problem).parameters(problem.plant).tolist() == [2.0, 4.0]
    assert (alone.deforms, alone.response(problem)) == ("response", None)
    assert alone.notes(problem) == ()
    assert alone.inner_problem(problem) is problem
    alone.check(problem)
    with pytest.raises(NotSupported, match="ComputedTorque has no optimiser"):
        with_optimiser(alone, PLANNER.optimiser)
    with pytest.raises(NotSupported, match="no field that holds its `inner`"):
        with_inner(alone, alone)
    assert controller_reads(problem, alone).names == ("time", "state", "realised", "parameters")


def test_automatic_settings_are_chosen_and_others_kept():
    """A controller without automatic settings comes back as it is, within wrappers too."""
    problem = masses()
    values = fp.ExactModel(fp.ComputedTorque(TRACK, fp.Sigmoid(gain=-0.5, scale=3.0)))
    assert resolved(problem, values) is values
    resolved_controller: Any = resolved(problem, fp.ExactModel(fp.ComputedTorque(TRACK, fp.Sigmoid(gain=-0.5))))
    exact = values.inner_problem(problem)
    assert resolved_controller.deformation == fp.Sigmoid(gain=-0.5).with_scale_for(
        request_along_reference(exact, TRACK)
    )


def test_checks_before_a_run():
    """The wrong sign is refused; a controller with responses of its own judges their gains itself, however late they are."""
    with pytest.raises(NotContractive, match="wrong sign"):
        checked(masses(), fp.ComputedTorque(TRACK, fp.Affine(0.5)))

    class Own(Telling):
        def check(self, problem):
            """Accept."""

    own = Own(fp.Identity(), of_its_own=True)
    assert checked(masses(), own) == own
    assert checked(masses(dead_time=fp.DeadTime(measurement=0.1)), own) == own


# Demands


def test_a_reference_asks_for_its_largest_change_in_a_cycle():
    """That of (-4 sin 2t, -cos t): the largest size of (-8 cos 2t, sin t) per second."""
    demand = request_along_reference(masses())
    assert demand.change == pytest.approx(np.hypot(8 * np.cos(2 * TIMES), np.sin(TIMES)).max() * PERIOD, rel=1e-3)
    assert (demand.sudden, demand.recovery) == (False, 0.0)


def test_a_tracking_law_asks_for_the_basin_of_its_largest_error():
    """What the model does without commands is (0, -3 / 8); the reference asks for (-4 sin 2t, -cos t): the largest distance."""
    largest = np.hypot(-4 * np.sin(2 * TIMES), -np.cos(TIMES) + 3 / 8).max()
    assert request_along_reference(masses(), TRACK).recovery == pytest.approx(
        step_for_basin(largest, 3, 2.0, PERIOD), rel=1e-4
    )
    no_gains = fp.Fractional(rate=2.0, order=0.8, memory=1.0)
    assert request_along_reference(masses(), no_gains).recovery == 0.0


def test_a_plan_asks_for_a_jump_between_the_limits():
    """5 N on 1 kg and 16 N on 8 kg: (5, 2). An input without a limit bounds nothing."""
    demand = request_of_plans(masses(limits=fp.Limits(inputs={"u": (-2.0, 3.0), "w": (-8.0, 8.0)})))
    assert demand.change == pytest.approx(np.hypot(5.0, 2.0))
    assert (demand.sudden, demand.recovery) == (True, 0.0)
    for free in ({"u": (-2.0, 3.0)}, {"u": (-2.0, 3.0), "w": (0.0, np.inf)}):
        with pytest.raises(InvalidValue, match="input 'w' has no finite limits"):
            request_of_plans(masses(limits=fp.Limits(inputs=free)))
    with pytest.raises(InvalidValue, match="input 'u' has no finite limits"):
        request_of_plans(masses())


def test_a_filtered_command_asks_for_its_largest_change_in_a_cycle():
    """With masses of 2 and 4 kg u = (-8 sin 2t, 3 - 4 cos t): the largest size of (-16 cos 2t, 4 sin t) N/s."""
    demand = request_of_commands(masses(), np.array([2.0, 4.0]))
    largest = np.hypot(16 * np.cos(2 * TIMES), 4 * np.sin(TIMES)).max()
    assert demand.change == pytest.approx(largest * PERIOD, rel=1e-3)
    assert not demand.sudden


def test_demands_count_the_beginning_of_the_reference():
    """Along e^(-3 t) everything is largest at t = 0: 27 per second, and an error of (9, 3 / 8); with 2 kg u falls by 54 N/s."""
    problem = replace(masses(), reference=fp.Trajectory(lambda t: {"a": ca.exp(-3 * t), "b": 1 + 0 * t}))
    assert request_of_commands(problem, np.array([2.0, 4.0])).change == pytest.approx(54.0 * PERIOD, rel=1e-2)
    demand = request_along_reference(problem, TRACK)
    assert demand.change == pytest.approx(27.0 * PERIOD, rel=1e-2)
    assert demand.recovery == pytest.approx(step_for_basin(np.hypot(9.0, 3 / 8), 3, 2.0, PERIOD), rel=1e-9)


def test_states_along_a_reference_are_those_of_a_motion_that_follows_it():
    """Of y = x, x' = u and z' = x - z along sin t: x = sin t, and z = (sin t - cos t + e^-t) / 2, which no output shows."""
    plant = fp.Plant.of_states(
        states={"x": "m", "z": "m"},
        inputs={"u": "m/s"},
        rates=lambda x, u, p: {"x": u.u, "z": x.x - x.z},
        parameters={},
        outputs={"y": fp.Output("m", lambda x, p: x.x)},
    )
    reference = fp.Trajectory(lambda t: {"y": ca.sin(t)})
    problem = fp.Problem(plant, reference, {"x": 0.0, "z": 0.0}, period=0.01, duration=10.0)
    t = np.linspace(0.0, 10.0, 5)
    wanted = [np.sin(t), (np.sin(t) - np.cos(t) + np.exp(-t)) / 2]
    np.testing.assert_allclose(reference_states(problem, 5), wanted, atol=0.02)


def test_a_response_is_as_large_as_its_limits_allow():
    """By the model a'' = u and b'' = (w - 3) / 8: from their middle, plus what half of them adds; rounded up by < 10 %."""
    largest = np.array(largest_response(masses(limits=fp.Limits(inputs={"u": (-5.0, 2.0), "w": (-2.0, 6.0)}))))
    exact = np.array([1.5 + 3.5, (1 + 4) / 8])
    assert (exact <= largest).all()
    assert (largest < 1.1 * exact).all()
    assert largest_response(masses(limits=fp.Limits(inputs={"u": (-5.0, 3.0)}))) == (np.inf, np.inf)


def test_a_state_without_a_response_does_not_count_as_a_size():
    """Of y'' = u / (10 y) along y = 2, and then y = 0, where there is none: up to 4 / 20 m/s^2."""
    plant = fp.Plant(
        coordinates={"y": "m"}, inputs={"u": "N"}, parameters={}, response=lambda q, v, u, p: {"y": u.u / (10 * q.y)}
    )
    reference = fp.Trajectory(lambda t: {"y": ca.if_else(t < 0.5, 2.0, 0.0)})
    limits = fp.Limits(inputs={"u": (-4.0, 4.0)})
    problem = fp.Problem(plant, reference, {"y": 2.0}, period=0.01, duration=1.0, limits=limits)
    assert 0.2 <= largest_response(problem)[0] < 0.22


def test_a_small_error_asks_for_a_small_step():
    """At rest only the model's 3 / 8 is to be recovered from."""
    problem = replace(masses(), reference=fp.Trajectory(lambda t: {"a": 0 * t, "b": 1 + 0 * t}))
    demand = request_along_reference(problem, TRACK)
    assert demand.change == 0.0
    assert demand.recovery == pytest.approx(step_for_basin(3 / 8, 3, 2.0, PERIOD), rel=1e-9)


def test_a_jump_is_that_of_the_slope_between_the_limits():
    """With y'' = u^3 / 2 from 1 N to 3 N: slope 3 x 4 / 2 at 2 N, times 2 N."""
    plant = fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        parameters={"m": fp.Parameter(2.0, 1.0, "kg")},
        response=lambda q, v, u, p: {"y": u.u**3 / p.m},
        inverse=lambda q, v, r, p: {"u": ca.sign(r.y) * ca.fabs(p.m * r.y) ** (1 / 3)},
    )
    reference, limits = fp.Trajectory(lambda t: {"y": 4 * t**2}), fp.Limits(inputs={"u": (1.0, 3.0)})
    problem = fp.Problem(plant, reference, start={"y": 0.0}, period=PERIOD, duration=1.0, limits=limits)
    assert request_of_plans(problem).change == pytest.approx(12.0)


# What a form believes


@pytest.mark.parametrize(
    ("cycles", "late", "believed"), [(None, True, (3.0, 0.0)), (2.0, True, 2.0), (None, False, None)]
)
def test_a_form_believes_the_dead_times_that_it_leaves_open(cycles, late, believed):
    """In cycles of each input, zero where none is stated. What is given stays, and a controller that is told nothing is itself."""
    problem = masses(period=1 / 8, dead_time=fp.DeadTime(inputs={"u": 3 / 8 if late else 0.0}))
    controller: Any = fp.ComputedTorque(TRACK, fp.ModelReferenced(fp.Affine(-1.0), cycles=cycles))
    told: Any = with_lateness(problem, controller)
    assert told.deformation.cycles == believed
    assert (told is controller) == (believed == cycles)


# What a plan is made for, and steps inside of others


def test_a_plan_has_its_own_cost_margins_and_share_of_a_stage():
    """Plans every 2 of the 5 cycles of a stage; without a horizon there is the cost alone."""
    cost, margins = fp.Quadratic(states={"a": 3.0}), {"a'": 0.1}
    own, free = (
        replace(PLANNER, cost=cost, margins=margins),
        masses(cost=fp.Quadratic(states={"a": 1.0}), limits=fp.Limits(states={"a'": (-9.0, 9.0)})),
    )
    assert PLANNER.planned(free) is free
    assert (own.planned(free).cost, own.planned(free).horizon) == (cost, None)
    often, stage = (replace(free, horizon=fp.Horizon(stages=4, step=0.5, replan=r)) for r in (2, "stage"))
    planned = own.planned(often).horizon
    assert planned is not None
    assert (planned.share, planned.margins, planned.measured) == (2 / 5, margins, ())
    assert own.planned(often).cost is cost
    assert PLANNER.planned(stage) is stage


@pytest.mark.parametrize(
    ("adapts", "disturbance", "consistent", "starts"),
    [
        (False, "", None, False),
        (True, "", None, True),
        (False, "w", None, True),
        (True, "", False, False),
        (False, "", True, True),
    ],
)
def test_a_plan_starts_where_the_model_has_the_measured_outputs(adapts, disturbance, consistent, starts):
    """Where the response is corrected, or it is asked for. Limits of what no output shows then hold for the measured state."""
    plant = fp.Plant.of_states(
        states={"angle": "rad", "speed": "rad/s"},
        inputs={"u": "V"},
        parameters={"a": fp.Parameter(0.7, 1.0, "1"), "w": fp.Parameter(0.1, 0.2, "rad/s^2")},
        rates=lambda x, u, p: {"angle": p.a * x.speed, "speed": u.u - x.speed},
        outputs={"y": fp.Output("rad", lambda x, p: x.angle, response_disturbance=disturbance)},
    )
    planner = replace(PLANNER, adapts=adapts, consistent=consistent)
    assert planner.corrects(plant) == (adapts or bool(disturbance))
    assert planner.starts_consistent(plant) == starts
    assert not planner.starts_consistent(masses().plant)
    problem = fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"y": 0 * t}),
        start={"angle": 0.1, "speed": 0.0},
        period=PERIOD,
        duration=1.0,
        horizon=fp.Horizon(stages=4, step=PERIOD),
        cost=fp.Quadratic(outputs={"y": 1.0}),
        limits=fp.Limits(states={"angle": (-1.0, 1.0), "speed": (-1.0, 1.0)}),
    )
    horizon = planner.planned(problem).horizon
    assert horizon is not None
    assert horizon.measured == (("speed",) if starts else ())


def test_a_form_with_too_many_dead_times_is_refused():
    three = fp.ComputedTorque(TRACK, fp.Paired(fp.Affine(gain=-0.5), cycles=(1, 2, 3)))
    with pytest.raises(NotSupported, match="3"):
        check_form(masses(), three)


def test_a_reference_that_jumps_asks_for_its_largest_change_in_a_cycle():
    """A set-point of 2 m through a filter of rate 3 and the plant's order: its response jumps by 3^2 x 2 m at once."""
    aims = fp.Setpoint({"a": 2.0, "b": 0.0}, rate=3.0, order=2, start={"a": 0.0, "b": 0.0})
    jump = replace(masses(), reference=aims, start={"a": 0.0, "b": 0.0})
    assert request_along_reference(jump).change == pytest.approx(18.0, rel=1e-9)
    moves = {0.0: 1.0, 7.0: 3.0, 7.2: -6.0}  # s, m: each adds 3^2 e^(-3 t) (1 - 3 t) per metre from its time on
    aims = replace(aims, values={"a": [(0.0, 1.0), (7.0, 4.0), (7.2, -2.0)], "b": 0.0})

    def response(t: np.ndarray) -> np.ndarray:
        kicks = [m * np.where(t >= at, 9 * np.exp(-3 * (t - at)) * (1 - 3 * (t - at)), 0.0) for at, m in moves.items()]
        return np.sum(kicks, axis=0)

    largest = np.abs(response(TIMES + PERIOD) - response(TIMES))[TIMES < 9.9].max()
    assert request_along_reference(replace(jump, reference=aims)).change == pytest.approx(largest, rel=2e-2)  # sampled
