"""What a review says of gains that are too small for a plan, of two-cycles and of basins, against the loop itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tasks
from chains import chain, errors_after_request
from reviewed import answer, mass, torque
from test_review_laws import PERIOD, RATE, moving

import fpirhc as fp
from fpirhc.review.questions.speed import gain_times
from fpirhc.review.review import predict

PLANNED = "RHC+FPI, gentle"


@pytest.mark.slow
def test_a_gentle_gain_is_worse_than_none_and_what_would_do():
    """Daily doses with gain -0.3: no, and no benefit; the named gain and the named forms converge."""
    gentle = tasks.tumour_daily.controllers[PLANNED]
    slow = answer(tasks.tumour_daily.problem, gentle, "keep up")
    assert slow.verdict == "no"
    assert slow.numbers["ratio"] < 1
    assert answer(tasks.tumour_daily.problem, gentle, "lower the response error").verdict == "no"
    needed = float(slow.change.split("gain = ")[1].split(",")[0])
    map_ = fp.Sigmoid(gain=-0.3, shift=0.3, scale=gentle.deformation.scale)  # type: ignore[attr-defined]
    assert replace(map_) == gentle.deformation
    larger = replace(map_, gain=needed)
    assert gain_times(map_, needed / map_.gain) == f"gain = {needed:.3g}"
    for mended in (larger, fp.Increment(map_, cycles=0), fp.ModelReferenced(map_)):
        better = predict(tasks.tumour_daily.problem, gentle.with_deformation(mended))
        assert better.verdict == "yes"
    assert "(ModelReferenced, Increment), or use gain = " in slow.change
    without, adapted = (
        fp.measure(
            tasks.tumour_daily.problem,
            fp.simulate(tasks.tumour_daily.problem, gentle.with_deformation(one), seed=0, compiled=False),
        )
        for one in (fp.Identity(), larger)
    )
    [weighed] = tasks.tumour_daily.problem.judged_names
    assert adapted.rms_error[weighed] < without.rms_error[weighed]


def test_smallest_gain_of_a_plan_is_where_its_loop_is_stable():
    """Just below it a pole is outside the unit circle, just above it none is."""
    gentle = tasks.tumour_daily.controllers[PLANNED]
    least = answer(tasks.tumour_daily.problem, gentle, "keep up").numbers["least"]
    for share, stable in ((0.97, False), (1.03, True)):
        one = gentle.with_deformation(gentle.deformation.with_effective_gain(share * least))
        assert (predict(tasks.tumour_daily.problem, one).numbers["radius"] < 1) == stable


def test_a_gain_inside_its_limits_with_which_the_loop_diverges_is_too_small():
    """No, with the smallest gain that does: with a fifth less the error is twenty times as large as with a fifth more."""
    own = answer(tasks.tumour_daily.problem, tasks.tumour_daily.controllers[PLANNED], "gain admissible")
    least = own.numbers["least"]
    assert own.verdict == "no"
    assert least == pytest.approx(-0.731, rel=0.01)
    assert own.evidence.endswith(f"; it is too small, the loop converges from {least:.3g} on")
    assert own.change == f"Use gain beyond {least:.3g}, or another form."
    errors = []
    for gain in (0.8 * least, 1.2 * least):
        one = fp.Sigmoid(gain=gain, shift=0.3, scale=1.0)
        run = fp.simulate(
            tasks.tumour_daily.problem,
            tasks.tumour_daily.controllers[PLANNED].with_deformation(one),
            seed=0,
            compiled=False,
        )
        errors.append(fp.measure(tasks.tumour_daily.problem, run).rms_error["size"])
    assert errors[0] > 20 * errors[1]


@pytest.mark.slow
def test_a_loop_that_diverges_with_every_gain_says_where_to_look():
    """A dead time that nobody told: neither the gain in use nor half of its limit converges."""
    motor = fp.load_problem("problems/noisy_motor.py")
    own = answer(motor.problem, motor.controllers["RHC+FPI, delay not told"], "gain admissible")
    assert own.verdict == "no"
    assert own.evidence.endswith("the loop does not converge; with -0.25 it does not converge either")
    assert own.change == "See the convergence of the deformation."


@pytest.mark.parametrize(("share", "verdict"), [(0.95, "yes"), (0.99, "unknown")])
def test_a_secant_below_the_bound_of_the_map_may_be_beyond_that_of_the_loop(share, verdict):
    """The tracking law adds 3/2 rate x period, 3 %: at 0.99 of 2 / lambda the loop has a two-cycle, which a run ends in."""
    sigmoid = fp.Sigmoid(gain=-1.0, scale=5.0)
    chosen = sigmoid.with_effective_gain(share * 2 / 1.5 * sigmoid.effective_gain() / sigmoid.secant_gain())
    problem, controller = chain(2, 1.5), fp.ComputedTorque(fp.Exponential(rate=RATE), chosen)
    converges = answer(problem, controller, "Does the deformation converge")
    assert converges.verdict == predict(problem, controller).verdict
    slowest = converges.numbers["radius"] ** problem.cycles
    requests = np.random.default_rng(0).uniform(-10, 10, size=(12, 1))
    sizes = np.abs(errors_after_request(problem, controller, requests, 4000)[-50:, 0]).max(axis=0)
    assert (sizes.max() < 1e-6) == (verdict == "yes")
    if slowest < 1e-2:
        assert converges.verdict == verdict


@pytest.mark.parametrize(("scale", "verdict"), [(0.5, "no"), (1.0, "no"), (2.0, "yes")])
def test_basin_of_the_plain_form(scale, verdict):
    """A start 1 m off the reference with a wrong model: steps that are too small for the first errors lose it for good."""
    problem = replace(moving(1.5), start={"y": 1.0})
    controller = fp.ComputedTorque(fp.Exponential(rate=RATE), fp.Sigmoid(gain=-0.5, scale=scale))
    assert answer(problem, controller, "come back").verdict == verdict
    assert predict(problem, controller).verdict == ("yes" if verdict == "yes" else "unknown")
    run = fp.simulate(replace(problem, duration=6.0), controller, seed=0, compiled=False)
    late = np.abs(run["error"][round(5.0 / PERIOD) :]).max()
    assert (late < 0.1) == (verdict == "yes")


@pytest.mark.parametrize("name", ["Cascade", "Cascade, last target"])
def test_the_gain_of_a_map_on_targets_is_limited_by_the_whole_loop(name):
    """The heat exchanger: a run comes to rest with nine tenths of the limit, and never does with 1.15 times the limit."""
    task = fp.load_problem("heat_exchanger")
    controller, problem = task.controllers[name], replace(task.problem.of_model, duration=800.0)
    admissible = answer(task.problem, controller, "Is the map's gain admissible?")
    assert admissible.verdict == "yes"

    def ripple(share: float) -> float:
        deformation = controller.deformation
        factor = share * admissible.numbers["limit"] / admissible.numbers["gain"]
        changed = deformation.with_effective_gain(factor * deformation.effective_gain())
        run = fp.simulate(problem, controller.with_deformation(changed), seed=0, compiled=False)
        return float(np.abs(np.diff(run["command"][-200:, 0])).max())

    assert ripple(0.9) < 0.05
    assert ripple(1.15) > 0.5


def test_a_gain_that_is_too_large_for_the_lightest_plant_of_the_box_is_unknown():
    """It is good for the plant itself; half of the way to the limit of the box is advised, with its sign."""
    problem, controller = mass(), torque(gain=-2.2)
    one = answer(problem, controller, "gain admissible", mismatch=40.0)
    advised = float(one.change.removeprefix("Use gain = ").removesuffix("."))
    assert one.verdict == "caution"
    assert advised == pytest.approx(one.numbers["recommended"], rel=1e-3)
    within = controller.with_deformation(replace(controller.deformation, gain=advised))  # type: ignore[type-var]
    assert answer(problem, within, "gain admissible", mismatch=40.0).verdict == "yes"


def test_an_error_of_the_start_is_no_harm():
    """Half of the limit is worse than none in the first thousand cycles, from which no errors count, and better where they do."""
    task, bare = fp.load_problem("tumour"), "CTC"
    one = task.controllers[f"{bare}+FPI"]
    admissible = answer(task.problem, one, "gain admissible")
    assert admissible.verdict == "yes"
    assert admissible.numbers["recommended"] == pytest.approx(8e-4, rel=0.01)
    recommended = one.with_deformation(replace(one.deformation, gain=admissible.numbers["recommended"]))  # type: ignore[type-var]
    start = replace(task.problem, duration=1000 * task.problem.period, measure_from=500 * task.problem.period)
    early, late = (
        [
            max(fp.measure(problem, fp.simulate(problem, c, seed=0)).rms_error.values())
            for c in (task.controllers[bare], recommended)
        ]
        for problem in (start, task.problem)
    )
    assert early[1] > early[0]
    assert late[1] < 0.6 * late[0]
