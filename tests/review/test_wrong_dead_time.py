"""A review and a dead time that is not known exactly: the pairing, the margin in cycles, the box, dead times that differ."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from plants import heavy
from reviewed import about, answer, answers, case

import fpirhc as fp
from fpirhc.contraction.delayed import leaking_limit
from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import without_deformation
from fpirhc.deformation import Deformation
from fpirhc.problem_files.problem_file import Task
from fpirhc.review.grid import review_grid
from fpirhc.review.loops import loops_at
from fpirhc.review.questions.convergence import box_converges
from fpirhc.review.questions.dead_time import bears_latency, bears_wrong_dead_time, pays_when_late
from fpirhc.review.review import predict
from fpirhc.studies.scenarios.bench import Bench, Conditions
from fpirhc.studies.scenarios.draws import COMPARING, TUNING

PERIOD, RATE = 1e-3, 6.0  # s, 1/s
MAP = fp.Affine(gain=-1.0)  # effective gain 0.5


def mass(cycles: int, **settings) -> fp.Problem:
    """A mass behind a dead time, the model's 1.3 times too large."""
    return fp.Problem(
        heavy(1.3, 1.0),
        fp.Trajectory(lambda t: {"q": 0.5 * ca.sin(2 * t)}),
        start={"q": 0.0},
        period=PERIOD,
        duration=4.0,
        measure_from=2.0,
        dead_time=fp.DeadTime(inputs={"u": cycles * PERIOD}),
        **settings,
    )


def told(deformation: Deformation, cycles: int = 20) -> Controller:
    """The controller that believes in a dead time."""
    return fp.Predicted(fp.ComputedTorque(fp.Exponential(rate=RATE), deformation), inputs=cycles * PERIOD)


def grows(problem: fp.Problem, controller: Controller) -> bool:
    """Whether the response error of a run grows."""
    run = fp.simulate(problem, controller, seed=0, compiled=False)
    if run.stop is not None:
        return True
    sizes = np.abs(run["realised"] - run["desired"])[:, 0]
    early, late = sizes[200:1000].max(), sizes[-500:].max()
    return bool(late > 3 * early)


@pytest.mark.parametrize(
    ("form", "borne"),
    [
        (fp.Increment(MAP, cycles=20, uncertainty=0), False),
        (fp.Paired(MAP, cycles=20), False),
        (fp.Increment(MAP, cycles=20, uncertainty=5), True),
        (fp.Paired(MAP, cycles=20, uncertainty=5), True),
        (fp.ModelReferenced(MAP, cycles=20), True),
    ],
)
def test_a_pairing_that_is_wrong_by_a_cycle(form, borne):
    """Without a leak it grows whatever the gain: a no although the loop converges with the true dead time. Runs agree."""
    controller = told(form)
    assert predict(mass(20), controller).verdict == "yes"
    margin = bears_wrong_dead_time(case(mass(20), controller))
    assert margin is not None
    assert margin.verdict == ("yes" if borne else "no")
    assert (margin.numbers["borne"] >= 1) == borne
    assert borne or margin.numbers["delay_margin"] < 1
    assert grows(mass(20), controller) is False
    assert grows(mass(21), controller) == (not borne)
    assert grows(mass(19), controller) == (not borne)


@pytest.mark.parametrize("cycles", [-5, -1, 1, 3])
def test_a_loop_with_another_dead_time_is_the_one_that_is_built_with_it(cycles):
    """A queue more, or commands that arrive sooner: the poles of the loop that is composed with that dead time."""
    controller = told(fp.Increment(MAP, cycles=20, uncertainty=5))
    [loop] = loops_at(review_grid(mass(20), 0.0, 0), controller, [10])
    [built] = loops_at(review_grid(mass(20 + cycles), 0.0, 0), controller, [10])
    assert loop.delayed([0], cycles).radius == pytest.approx(built.radius, abs=1e-7)


def test_plans_with_another_dead_time_are_those_that_are_built_with_it():
    """Over the ten cycles from plan to plan, with both inputs later and with one of them."""
    task = fp.load_problem("two_mass")
    controller, names = task.controllers["RHC"], tuple(task.problem.plant.inputs)
    [loop] = loops_at(review_grid(task.problem, 0.0, 0), controller, [10])
    for late in ([0, 1], [1]):
        times = fp.DeadTime(inputs={names[k]: 2 * task.problem.period for k in late})
        [built] = loops_at(review_grid(replace(task.problem, dead_time=times), 0.0, 0), controller, [10])
        assert loop.delayed(late, 2).radius == pytest.approx(built.radius, rel=1e-4)


@pytest.mark.slow
def test_what_survives_is_ready_and_what_grows_is_not():
    """The plant's dead time is one cycle longer than believed: no with certainty, and ready with an uncertainty of five."""
    for form in (fp.Increment, fp.Paired):
        sure, unsure = (told(form(MAP, cycles=20, uncertainty=cycles)) for cycles in (0, 5))
        assert answer(mass(21), sure, "gain admissible").verdict == "no"
        assert (predict(mass(21), sure).verdict, predict(mass(21), unsure).verdict) == ("no", "yes")
    assert "no" not in {a.verdict for a in answers(mass(21), unsure).values()}


def test_the_box_contains_the_dead_time():
    """With 10 % of twenty cycles two cycles are in the box: a pairing without a leak is stable at the true dead time alone."""
    for uncertainty, verdict in ((0, "caution"), (5, "yes")):
        controller = told(fp.Increment(MAP, cycles=20, uncertainty=uncertainty))
        narrow, wide = (case(mass(20), controller, mismatch) for mismatch in (0.0, 10.0))
        assert box_converges(narrow).verdict == "yes"
        boxed = box_converges(wide)
        assert boxed.verdict == verdict
        assert (boxed.numbers["radius"] < 1) == (verdict == "yes")


def two_masses(second: int) -> fp.Problem:
    """Two masses that do not know each other, behind 5 and some other cycles."""
    plant = fp.Plant(
        coordinates={"a": "m", "b": "m"},
        inputs={"u": "N", "v": "N"},
        parameters={"m": fp.Parameter(1.3, 1.0, "kg")},
        response=lambda q, v, u, p: {"a": u.u / p.m, "b": u.v / p.m},
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"a": 0.5 * ca.sin(2 * t), "b": 0.3 * ca.sin(t)}),
        start={"a": 0.0, "b": 0.0},
        period=PERIOD,
        duration=4.0,
        dead_time=fp.DeadTime(inputs={"u": 5 * PERIOD, "v": second * PERIOD}),
    )


@pytest.mark.slow
def test_dead_times_that_differ_are_judged():
    """Told each its own: yes and borne. Told the longer one for both: the shorter channel is wrong by seven cycles, and no."""
    law = fp.Exponential(rate=2.0)
    both = answers(two_masses(12), fp.ComputedTorque(law, fp.Increment(MAP, cycles=(5.0, 12.0), uncertainty=2)))
    assert about(both, "gain admissible").verdict == "yes"
    assert about(both, "wrong by a cycle").verdict == "yes"
    assert about(both, "Does the deformation converge").verdict == "yes"
    wrong = fp.ComputedTorque(law, fp.Increment(MAP, cycles=12.0, uncertainty=0))
    assert predict(two_masses(12), wrong).verdict == "no"


@pytest.mark.parametrize(("late", "own", "width"), [(20, 20, 5), (21, 20, 5), (26, 20, 5), (4, 3, 1)])
def test_limit_of_a_mean_is_where_the_roots_leave_the_circle(late, own, width):
    """Against the roots of the polynomial, written down from the definition of the triangular mean."""
    limit = leaking_limit(np.append(np.zeros(late), [1.0, 0.0]), cycles=own, width=width)

    def radius(gain: float) -> float:
        polynomial = np.zeros(max(late, own + width) + 2)
        polynomial[0] = 1.0
        for j in range(-width, width + 1):
            polynomial[own + j + 1] -= (1 - abs(j) / (width + 1)) / (width + 1)
        polynomial[late + 1] += gain
        return float(np.abs(np.roots(polynomial)).max())

    assert radius(0.99 * limit) < 1 < radius(1.01 * limit)


def test_an_input_without_dead_time_beside_one_with():
    """Their queues have none and three entries: the run is that of the mass behind three cycles."""
    problem = replace(two_masses(3), dead_time=fp.DeadTime(inputs={"v": 3 * PERIOD}), duration=0.5)
    run = fp.simulate(problem, fp.ComputedTorque(fp.Exponential(rate=2.0)), seed=0, compiled=False)
    arriving = run["arriving"]
    np.testing.assert_allclose(arriving[3:, 1], run["command"][:-3, 1], rtol=1e-12)
    np.testing.assert_allclose(arriving[:, 0], run["command"][:, 0], rtol=1e-12)


@pytest.mark.parametrize(("weight", "verdict"), [(1e4, "yes"), pytest.param(3e4, "no", marks=pytest.mark.slow)])
def test_the_loop_is_asked_and_not_the_iteration_alone(weight, verdict):
    """A plan that predicts over 60 cycles, 66 or 54 in truth: the leaky iteration is stable, the eager plan loses with it.

    The answer has the errors of runs; without adaptation the same loop is three times better.
    """
    problem = replace(
        mass(60),
        duration=2.0,
        measure_from=1.0,
        horizon=fp.Horizon(stages=20, step=0.01),
        cost=fp.Quadratic(states={"q": weight, "q'": 1.0}, deviation={"u": 1e-2}),
    )
    plan = fp.RecedingHorizon(
        fp.FixedPoint(iterations=1, tolerance=1e-2), fp.Increment(fp.Affine(gain=-1.5), cycles=60)
    )
    controller = fp.Predicted(plan, inputs=60 * PERIOD)
    assert 0.75 * 1.3 < 1  # the product of gain and eigenvalue for which the leak is proved to be enough
    answer = pays_when_late(case(problem, controller))
    assert answer is not None
    assert answer.verdict == verdict
    for name, cycles in (("longer", 66), ("shorter", 54)) if verdict == "no" else ():
        late = replace(problem, dead_time=fp.DeadTime(inputs={"u": cycles * PERIOD}))
        for which, one in (("without", without_deformation(controller)), ("with", controller)):
            run = fp.simulate(late, one, seed=0, compiled=False)
            assert answer.numbers[f"{name}_{which}"] == pytest.approx(fp.measure(late, run).rms_error["q"], rel=1e-9)
    assert (answer.numbers["longer_with"] > 3 * answer.numbers["longer_without"]) == (verdict == "no")


def test_no_question_without_dead_time():
    """Nothing is late, nothing is paired: nothing to be wrong. Nor is an increment that is paired with the last request."""
    problem = replace(mass(20), dead_time=fp.DeadTime())
    for form, applies in ((MAP, False), (fp.Increment(MAP, cycles=0), False), (fp.Increment(MAP, cycles=2), True)):
        one = case(problem, fp.ComputedTorque(fp.Exponential(rate=RATE), form))
        assert (bears_wrong_dead_time(one) is not None) == applies
        assert pays_when_late(one) is None


@pytest.mark.parametrize("gain", [-0.8, -1.6, -2.4])
def test_the_latency_that_a_loop_bears_and_the_gain_that_bears_three_cycles(gain):
    """Runs are stable up to the latency of the answer and not one cycle beyond; with the share of the gain they bear three."""
    problem = replace(mass(0), duration=20.0, reference=fp.Trajectory(lambda t: {"q": 0 * t}), start={"q": 0.1})
    law = fp.ComputedTorque(fp.Exponential(rate=RATE))
    adaptive = law.with_deformation(fp.ModelReferenced(fp.Affine(gain=gain)))
    answer = bears_latency(case(problem, adaptive))
    assert answer is not None
    borne, share = int(answer.numbers["borne"]), answer.numbers["share"]
    assert answer.verdict == "caution"
    assert f"{share:.2g} times the gain, gain = {share * gain:.3g}, bears them" in answer.change

    def most(controller: Controller) -> int:
        late = (
            fp.simulate(replace(problem, dead_time=fp.DeadTime({"u": k * PERIOD})), controller, seed=0)
            for k in range(1, 6)
        )
        return next((k for k, run in enumerate(late) if run.stop is not None or abs(run["error.q"][-1]) > 1e-3), 5)

    fixed = replace(adaptive, deformation=fp.ModelReferenced(fp.Affine(gain=gain), cycles=0.0))
    assert most(fixed) == borne < 3
    assert most(replace(fixed, deformation=fp.ModelReferenced(fp.Affine(gain=share * gain), cycles=0.0))) >= 3


def test_latency_is_asked_where_none_is_stated_and_something_adapts():
    law = fp.ComputedTorque(fp.Exponential(rate=RATE))
    gentle = law.with_deformation(fp.ModelReferenced(fp.Affine(gain=-0.2)))
    assert bears_latency(case(mass(20), told(fp.Increment(MAP, cycles=20)))) is None
    assert bears_latency(case(mass(0), law)) is None
    answer = bears_latency(case(mass(0), gentle))
    assert answer is not None
    assert (answer.verdict, answer.numbers["borne"]) == ("yes", 3.0)


def test_scenarios_draw_the_dead_time():
    """With 5 % of 20 cycles the plant has 19, 20 or 21, and the controllers believe in 20: a sharp pairing fails in two thirds."""
    problem = replace(mass(20), duration=1.5, measure_from=0.5)
    controllers = {
        "sharp": told(fp.Increment(MAP, cycles=20, uncertainty=0)),
        "leaky": told(fp.Increment(MAP, cycles=20, uncertainty=5)),
    }
    task = Task("late", Path(__file__), "", "", problem, controllers)
    bench = Bench(task, Conditions(seed=0, use=COMPARING, percent=5.0, compiled=False))
    lateness = [int(str(bench._scenario(k).build)) for k in range(8)]
    assert set(lateness) == {-1, 0, 1}
    for k in (lateness.index(-1), lateness.index(0), lateness.index(1)):
        cycles = bench._scenario(k).problem.dead_time.inputs["u"] / PERIOD
        assert cycles == pytest.approx(20 + lateness[k])
        sharp, leaky = (bench.record(k, name)["error"] for name in controllers)
        assert leaky < 0.1
        assert (sharp is not None and sharp < 0.1) == (lateness[k] == 0)
    tuning = Bench(task, Conditions(seed=0, use=TUNING, percent=5.0, compiled=False))
    assert {tuning._scenario(k).problem.dead_time.inputs["u"] for k in range(8)} == {20 * PERIOD}


@pytest.mark.slow
def test_a_loop_that_grows_too_slowly_for_a_short_run_is_no_yes():
    """Plans that are stiffer than the shipped ones swing at 66 cycles: a run of 2 s shows .043 m, and one of 12 s .072."""
    task = fp.load_problem("delayed_mass")
    problem = replace(task.problem, cost=fp.Quadratic(states={"q": 1e3, "q'": 1.0}, deviation={"Q": 9e-4}))
    one = answer(problem, task.controllers["RHC+FPI"], "wrong by a tenth")
    assert one.verdict == "caution"
    assert one.evidence.startswith("longer: the rms error of q is 0.0402 m without adaptation, 0.043 m with it; ")
    assert "; but 6 cycles off, the slowest mode is multiplied by 1.000" in one.evidence
    assert one.numbers["radius"] == pytest.approx(1.00017, abs=4e-5)
    assert (
        one.change
        == "Weigh the inputs more, lower the rate or the gain, or measure the dead time better than to a tenth."
    )
    late = replace(problem, dead_time=fp.DeadTime(inputs={"Q": 0.066}))
    run = fp.simulate(late, task.controllers["RHC+FPI"], seed=0)
    assert fp.measure(late, run).rms_error["q"] == pytest.approx(0.072, rel=0.02)
    shipped = answer(task.problem, task.controllers["RHC+FPI"], "wrong by a tenth")
    assert shipped.verdict == "yes"
