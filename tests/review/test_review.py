"""What a review says before a run, and whether it is right."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from kinds import shipped, slow_but
from random_plants import dies_out, random_case
from reviewed import PERIOD, about, answer, answers, mass, torque

import fpirhc as fp
from fpirhc.cli.main import main
from fpirhc.controllers import check
from fpirhc.plant.motion import with_exact_parameters
from fpirhc.review.grid import review_grid
from fpirhc.review.loops import loops_along, own_loops
from fpirhc.review.questions.horizon import plan_gain
from fpirhc.review.questions.margins import margins
from fpirhc.review.questions.right_model import forms_of
from fpirhc.review.review import predict


def predicted(seeds: range) -> tuple[int, int, int]:
    """(right, wrong, unknown) verdicts against simulated closed loops."""
    counts = {"right": 0, "wrong": 0, "unknown": 0}
    for seed in seeds:
        case = random_case(seed)
        with pytest.MonkeyPatch.context() as patch:  # a gain beyond its limit, refused otherwise, has a verdict too
            patch.setattr(check, "check_gain_size", lambda *_: None)
            verdict = predict(case.problem, case.controller).verdict
        if verdict == "unknown":
            counts["unknown"] += 1
        else:
            counts["right" if (verdict == "yes") == dies_out(case) else "wrong"] += 1
    return counts["right"], counts["wrong"], counts["unknown"]


@pytest.mark.parametrize("count", [14, pytest.param(300, marks=pytest.mark.slow)])
def test_verdicts_on_random_closed_loops(count):
    """Linear and nonlinear, one to three coordinates, right and wrong signs, over-gained, with dead time: see `random_plants`.

    No wrong yes and no wrong no, and fewer than 15 % undecided.
    """
    right, wrong, unknown = predicted(range(count))
    assert (right + unknown, wrong) == (count, 0)
    assert unknown < 0.15 * count


def wrong_null_answers(seeds: range) -> list[str]:
    """Random loops, and their maps in the model-referenced form, that pass the null test by a review and fail it in runs."""
    wrong = []
    for seed in seeds:
        case = random_case(seed)
        plant = case.problem.plant
        model = replace(case.problem, plant=with_exact_parameters(plant, plant.approximate))
        bare = fp.simulate(model, replace(case.controller, deformation=fp.Identity()), seed=0, compiled=False)
        for form in (
            case.controller.deformation,
            forms_of(case.problem, case.controller.deformation)["model-referenced"],
        ):
            controller = replace(case.controller, deformation=form)
            verdict = answer(case.problem, controller, "right model alone").verdict
            if verdict == "yes" and _is_worse(fp.simulate(model, controller, seed=0, compiled=False), bare):
                wrong.append(f"{case.name}, {form}")
    return wrong


def _is_worse(run: fp.Run, bare: fp.Run) -> bool:
    """Whether adaptation adds a quarter and 0.2 % of the largest error or of the largest motion, 0.8 m, to a coordinate's error."""
    if run.stop is not None:
        return bare.stop is None
    sizes = [np.sqrt(np.mean(r["error"] ** 2, axis=0)) for r in (run, bare)]
    scale = np.maximum(np.abs(bare["error"]).max(axis=0), 0.8)
    return bool(((sizes[0] > 1.25 * sizes[1]) & (sizes[0] - sizes[1] > 2e-3 * scale)).any())


@pytest.mark.parametrize("count", [3, pytest.param(300, marks=pytest.mark.slow)])
def test_null_answers_on_random_closed_loops(count, monkeypatch):
    """A yes of the null test is never wrong; gains of the wrong sign, refused otherwise, are asked and run too."""
    monkeypatch.setattr(check, "check_gain_sign", lambda *_: None)
    monkeypatch.setattr(check, "check_gain_size", lambda *_: None)
    assert wrong_null_answers(range(count)) == []


def test_own_loops_are_those_beside_the_ideal_one():
    """A prediction and the advice on a gain ask for the former alone; the ideal loop of a wrong model is that of the right one."""
    grid, right = review_grid(mass(), 0.0, 0), fp.ExactModel(fp.ComputedTorque(fp.Exponential(rate=1.0)))
    alone, whole = own_loops(grid, torque(rate=1.0)), loops_along(grid, torque(rate=1.0))
    assert alone.ideal is None
    assert alone.places == whole.places
    np.testing.assert_array_equal(alone.radii, whole.radii)
    assert whole.ideal is not None
    for loop in (whole.ideal, own_loops(grid, right).loops[0]):  # a threefold pole is soft, its mean is not
        slow = loop.poles[np.abs(loop.poles) > 0.5]
        assert np.log(slow).mean() / PERIOD == pytest.approx(-1.0, rel=0.01)
    assert own_loops(grid, fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-6))).reason


@pytest.mark.parametrize("cycles", slow_but([0, 1, 2, 5], 0, 2))
def test_dead_time_limit_is_where_the_loop_leaves_the_unit_circle(cycles):
    """Unpaired, a lambda < 2 sin(pi / (2 (2 d + 1))), here with the slow outer loop in place; the gain question says the same."""
    problem = mass(dead_time=fp.DeadTime(inputs={"u": cycles * PERIOD}))
    limit = 2 * math.sin(math.pi / (2 * (2 * cycles + 1))) / 1.5
    for share, stable in ((0.95, True), (1.05, False)):
        controller = fp.ComputedTorque(fp.Exponential(rate=1.0), fp.Affine(gain=-2 * share * limit))
        loops = loops_along(review_grid(problem, 0.0, 0), controller)
        assert (loops.radii.max() < 1) == stable
        if not stable or cycles == 1:
            verdict = answer(problem, controller, "gain admissible").verdict
            assert (verdict == "yes") == stable


def test_margins_are_where_the_loop_loses_its_stability():
    """More gain than the gain margin, or more delay than the delay margin, puts a pole outside the unit circle, less does not."""
    [loop, *_] = loops_along(review_grid(mass(), 0.0, 0), torque()).loops
    gain, phase, delay = margins(loop, 0)
    [one] = loop.cycles
    f, g, c = one.dynamics, one.entry[:, [0]], one.arriving[[0]]

    def radius(matrix: np.ndarray) -> float:
        return float(np.abs(np.linalg.eigvals(matrix)).max())

    scaled = [radius(f + (k - 1) * g @ c) for k in (0.99 * gain, 1.01 * gain, 0.99 / gain, 1.01 / gain)]
    assert (scaled[0] < 1) != (scaled[1] < 1) or (scaled[2] < 1) != (scaled[3] < 1)

    def delayed(cycles: int) -> float:
        n = len(f)
        queue = np.zeros((n + cycles, n + cycles))
        queue[:n, :n], queue[:n, [-1]], queue[[n], :n] = f - g @ c, g, c
        queue[range(n + 1, n + cycles), range(n, n + cycles - 1)] = 1
        return radius(queue)

    whole = math.floor(delay / PERIOD)
    assert delayed(whole) < 1 < delayed(whole + 1)
    assert 30 < phase < 90


def test_feedback_of_a_plan_is_that_of_the_riccati_equation():
    """Far horizons of a constant problem have the stationary discrete LQ gain."""
    problem = mass(
        reference=fp.Trajectory(lambda t: {"q": 0 * t}),
        horizon=fp.Horizon(stages=400, step=1e-2),
        cost=fp.Quadratic(states={"q": 1e3, "q'": 1.0}, effort={"u": 1e-2}),
    )
    import control
    import scipy.linalg

    assert problem.horizon is not None
    result = plan_gain(problem, problem.horizon)
    m, k = problem.plant.approximate
    whole = scipy.linalg.expm(np.array([[0, 1, 0], [-k / m, 0, 1 / m], [0, 0, 0]]) * 1e-2)
    stationary, *_ = control.dlqr(whole[:2, :2], whole[:2, 2:], np.diag([1e3, 1.0]), np.array([[1e-2]]))
    assert result[:, :2] == pytest.approx(-stationary, rel=1e-3)
    assert not result[:, 2:].any()


def test_a_good_problem_is_ready():
    """Every answer about a mild mismatch is yes, in the form that suits the problem and in the plain one, whose run is as good."""
    problem, plain = mass(limits=fp.Limits(inputs={"u": (-20.0, 20.0)})), torque()
    answers_by_question = answers(problem, replace(plain, deformation=fp.ModelReferenced(plain.deformation)))
    assert {a.verdict for a in answers_by_question.values()} == {"yes"}
    assert all(not a.change for a in answers_by_question.values())
    assert {a.verdict for a in answers(problem, plain).values()} == {"yes"}


@pytest.mark.parametrize(
    ("words", "controller", "settings"),
    [
        ("Does the deformation converge", torque(gain=-4.0), {}),
        ("gain admissible", torque(gain=-4.0), {}),
        ("gain admissible", torque(), {"dead_time": fp.DeadTime(inputs={"u": 0.06})}),
        ("map fast enough", torque(scale=1e-4), {}),
        ("sampling fast enough", torque(rate=8.0), {"dead_time": fp.DeadTime(inputs={"u": 0.06})}),
        ("sampling fast enough", torque(rate=900.0), {}),
        ("range large enough", fp.ComputedTorque(fp.Exponential(6.0), fp.Rotation(fraction=0.3, radius=1.0)), {}),
        ("commands", torque(), {"limits": fp.Limits(inputs={"u": (-0.3, 0.3)})}),
        ("margin", torque(gain=-4.0), {}),
    ],
)
def test_what_is_wrong_is_answered_no(words, controller, settings):
    """Each question finds its own mistake, and says what to change."""
    one = answer(mass(**settings), controller, words)
    assert one.verdict == "no"
    assert one.change


def test_wrong_sign_is_found_before_the_run():
    answers_by_question = answers(mass(), torque(gain=0.5))
    assert about(answers_by_question, "Does the deformation converge").verdict == "no"
    gain = about(answers_by_question, "gain admissible")
    assert gain.verdict == "no"
    assert (
        -1 / 0.396737 / 1.5 < gain.numbers["recommended"] < 0
    )  # J from 1 to 1.5 over the box; the whole loop bears less
    assert gain.numbers["recommended"] == pytest.approx(0.5 * gain.numbers["limit"])


def test_an_inverse_that_vanishes_on_the_way_is_found():
    """The pole's response to the cart's force passes through zero where the pole is level."""
    plant = fp.Plant(
        coordinates={"angle": "rad"},
        inputs={"u": "N"},
        parameters={"b": fp.Parameter(1.2, 1.0, "1/kg")},
        response=lambda q, v, u, p: {"angle": p.b * ca.cos(q.angle) * u.u},
    )
    problem = fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"angle": 2 * ca.sin(t)}),
        start={"angle": 0.0},
        period=PERIOD,
        duration=4.0,
    )
    assert answer(problem, torque(), "inverse exist").verdict == "no"


def test_unstable_zero_dynamics_are_found():
    """While the cart is controlled an upright pole falls at sqrt(g / l); a plan that carries the pole in its cost holds it."""
    task = fp.load_problem("cart_pole")
    alone = answer(task.problem, torque(), "zero dynamics")
    assert alone.verdict == "no"
    assert alone.numbers["rate"] == pytest.approx(math.sqrt(9.81 / 0.8), rel=0.02)
    assert answer(task.problem, task.controllers["RHC+FPI"], "zero dynamics").verdict == "yes"


def test_box_spans_model_and_plant_and_a_margin():
    """From the approximate to the exact value, and P percent around the latter."""
    grid = review_grid(mass(), 20.0, 0)
    assert grid.draws[0] == pytest.approx([1.0, 10.0])
    assert grid.draws.min(axis=0) == pytest.approx([0.8, 6.0])
    assert grid.draws.max(axis=0) == pytest.approx([1.5, 12.0])
    wide = answer(mass(), torque(gain=-2.2), "one sign", mismatch=40.0)
    assert wide.numbers["largest_over_box"] == pytest.approx(1.5 / 0.6)


def test_a_plan_that_is_too_stiff_for_its_map_is_found():
    """The case that two_mass shows failing: the start asks for more than 0.81 S per cycle."""
    task = fp.load_problem("two_mass")
    name = "RHC+FPI, stiff, small S"
    controller = task.controllers[name]
    slew = answer(task.problem, controller, "map fast enough")
    assert slew.verdict == "no"
    assert (
        "'Is the map fast enough for reference and disturbances?' is answered no"
        in predict(task.problem, controller).evidence
    )


def test_values_that_make_no_sense_are_refused():
    """Percentages outside 0 to 100."""
    for wrong in (-1.0, 100.0, math.nan):
        with pytest.raises(ValueError, match="mismatch"):
            fp.review(mass(), {}, mismatch=wrong, seed=0)


# They differentiate plans of 10 ms and more; the journey below reviews dead time, and others of their kind are quicker.
LONG = (
    "anaesthesia",
    "building",
    "chain_of_masses",
    "delayed_mass",
    "diabetes",
    "freeway",
    "leaking_tanks",
    "noisy_motor",
)
ALSO_LONG = ("cart_pole", "freeway_metering", "stick_slip", "tumour", "turbojet", "two_link_arm", "van_der_pol")


@pytest.mark.parametrize("name", shipped(*LONG, *ALSO_LONG))
def test_every_shipped_problem_can_be_reviewed(name, capsys):
    """Through the command line: one JSON object, every answer with its facts, and the exit code that its verdicts ask for."""
    task = fp.load_problem(name)
    few = list(task.controllers)[1:2]  # the adaptive one of the headline pair
    code = main(["review", name, "--controllers", *few, "--json"])
    document = json.loads(capsys.readouterr().out)
    assert set(document["controllers"]) == set(few)
    every = [*document["answers"], *(a for group in document["controllers"].values() for a in group)]
    assert all(a["evidence"] and a["question"].endswith("?") for a in every)
    assert all(a["change"] for a in every if a["verdict"] == "no")
    assert code == int(any(a["verdict"] == "no" for a in every))


def test_journey_with_text(capsys):
    """Delayed mass: the unpaired map diverges, the increment form converges, and both are told why."""
    assert main(["review", "delayed_mass", "--controllers", "CTC+FPI unpaired"]) == 1
    text = capsys.readouterr().out
    assert "no      Does the deformation converge?" in text
    assert "no gain is recommended, because with -0.0183, half of it, the loop does not converge" in text
    task = fp.load_problem("delayed_mass")
    assert predict(task.problem, task.controllers["CTC+FPI increment"]).verdict == "yes"


def test_slots_are_judged_by_their_schedule():
    """Crane: the published radius; a controller that does not fit is a no with its reason."""
    task = fp.load_problem("crane_slots")
    controller: Any = task.controllers["slots+FPI"]
    answers_by_question = answers(task.problem, controller)
    assert about(answers_by_question, "schedule").numbers["floquet_radius"] == pytest.approx(0.0485, abs=1e-3)
    wrong = replace(controller, slots=(replace(controller.slots[0], order=3), controller.slots[1]))
    assert about(answers(task.problem, wrong), "fit the problem").verdict == "no"


def test_estimators_and_filters_are_part_of_the_loop():
    """The motor's derivatives come from a window: told of its delay a deformation converges, not told it does not."""
    task = fp.load_problem("noisy_motor")
    diagnostics, untold = (
        predict(task.problem, task.controllers[n]) for n in ("RHC+FPI, filtered error", "RHC+FPI, delay not told")
    )
    assert (diagnostics.verdict, untold.verdict) == ("yes", "no")
