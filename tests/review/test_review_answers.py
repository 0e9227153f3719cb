"""Where the answers of a review change, and their numbers, on loops and grids that were made by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from plants import heavy
from reviewed import answer as asked
from reviewed import linear

import fpirhc as fp
from fpirhc.contraction.spectrum import Spectrum, assess_gain
from fpirhc.deformation.base import Deformation
from fpirhc.review.grid import ReviewGrid, review_grid
from fpirhc.review.loops import Loops
from fpirhc.review.question import Answer, Verdict, duration, graded, per_cycle
from fpirhc.review.questions.convergence import _NEAR, _without, box_converges, converges
from fpirhc.review.questions.gain import (
    FAR,
    Recommended,
    _converging,
    _gain,
    _sign,
    gain_admissible,
    gain_of_target,
    least_gain,
    recommended_gain,
)
from fpirhc.review.questions.margins import LEAST_PHASE, MARGINS, margins_enough
from fpirhc.review.questions.reference import commands_inside, inverse_exists
from fpirhc.review.questions.right_model import _no_gain
from fpirhc.review.questions.slew import _start_deviation, effect, range_enough, slew_enough
from fpirhc.simulation.linearise.linear_loop import LinearLoop

PERIOD, CYCLES = 0.1, 100
EDGE = math.log(100) / CYCLES  # of the logarithm of a factor per cycle


def mass(**settings: Any) -> fp.Problem:
    """2 kg and 10 N/m, taken for 1.5 kg and 6 N/m, along 0.5 sin 3t: u* = -4 sin 3t N, r* = -4.667 sin 3t, J = 0.75."""
    usual: dict[str, Any] = {"start": {"q": 0.0, "q'": 1.5}, "period": PERIOD, "duration": PERIOD * CYCLES}
    return fp.Problem(
        heavy(1.5, 2.0, (6.0, 10.0)), fp.Trajectory(lambda t: {"q": 0.5 * ca.sin(3 * t)}), **(usual | settings)
    )


@pytest.fixture(scope="module")
def grid() -> ReviewGrid:
    """Points of the reference."""
    return review_grid(mass(), 0.0, 0)


def loop(radius: float) -> LinearLoop:
    """A loop with one mode."""
    one = np.array([[radius]])
    return linear(one, one, one, np.array([0]), PERIOD)


def loops(*radii: float, ideal: float | None = 0.5, **more: Any) -> Loops:
    """Loops with these radii at points of the reference."""
    return Loops(tuple(range(len(radii))), tuple(map(loop, radii)), None if ideal is None else loop(ideal), **more)


def torque(deformation: Deformation) -> fp.ComputedTorque:
    return fp.ComputedTorque(fp.Exponential(rate=1.0), deformation)


def convergence(grid: ReviewGrid, ours: Loops, deformation: Any = None, doubts: list[str] | None = None) -> fp.Answer:
    return converges(grid, torque(deformation or fp.Affine(-0.5)), ours, doubts or [])


# Convergence


@pytest.mark.parametrize(
    ("logarithms", "verdict"),
    [
        ((-1.001 * EDGE,), "yes"),
        ((-0.999 * EDGE,), "caution"),
        ((0.999 * EDGE,), "unknown"),
        ((1.001 * EDGE,), "no"),
        ((-5 * EDGE, -0.999 * EDGE), "caution"),
        ((-5 * EDGE, -1.001 * EDGE), "yes"),
        ((5 * EDGE, 0.999 * EDGE), "unknown"),
        ((5 * EDGE, 1.001 * EDGE), "no"),
        ((-math.inf,), "yes"),
    ],
)
def test_convergence_is_a_hundredfold_change_over_the_run(grid, logarithms, verdict):
    """Errors that shrink a hundredfold at every point converge, those that grow so diverge; slower ones are a caution."""
    radii = np.exp(logarithms)
    one = convergence(grid, loops(*radii))
    assert one.verdict == verdict
    assert one.evidence.startswith(f"the slowest mode of the linear loop is multiplied by {max(radii):.6g} per cycle")
    assert one.numbers == {"radius": max(radii), "smallest_radius": min(radii)}
    assert bool(one.change) == (verdict != "yes")


@pytest.mark.parametrize("rate", [-2.0, -0.2])
@pytest.mark.parametrize(("share", "left"), [(0.99, 0.5), (-0.99, 0.5), (1.01, None), (-1.01, None)])
def test_a_decaying_mode_of_the_zero_dynamics_takes_the_pole_beside_it(share, left, rate):
    """A pole within the stated share of its distance from 1; a mode that grows takes none, nor does a pole that does not decay."""
    exact = math.exp(rate * PERIOD)
    pole = exact + share * _NEAR * (1 - exact)
    both, turned = (linear(np.diag(d), np.eye(2), np.eye(2), np.arange(2), PERIOD) for d in ([pole, 0.5], [0.5, pole]))
    assert _without(both, np.array([rate])) == pytest.approx(pole if left is None else left)
    assert _without(turned, np.array([rate])) == pytest.approx(pole if left is None else left)
    assert _without(loop(exact), np.array([rate])) == 0.0
    assert _without(both, np.array([-rate])) == pytest.approx(max(pole, 0.5))
    assert _without(loop(1.0), np.array([-1e-9])) == 1.0


def test_poles_and_times_are_in_the_units_of_the_field():
    """0.1 s per cycle: -0.1 / ln 0.976 = 4.12 s; ms and us below a second; a mode that does not decay has no time constant."""
    problem = mass()
    assert per_cycle(0.976, problem) == "is multiplied by 0.976 per cycle (time constant 4.12 s)"
    assert per_cycle(0.5, problem) == "is multiplied by 0.5 per cycle (time constant 144 ms)"
    assert per_cycle(1.02, problem) == "is multiplied by 1.02 per cycle"
    assert [duration(t, problem) for t in (2.5, 0.0591, 2.1e-5)] == ["2.5 s", "59.1 ms", "21 us"]
    hours = replace(problem.plant, time_unit="h")
    assert duration(0.25, replace(problem, plant=hours)) == "0.25 h"


def test_margins_of_an_integrator_by_hand(grid):
    """x+ = x + w, w = -0.1 x: L(-1) = -1/20; |z - 1| = 0.1 at 0.10004 rad a cycle, where the phase is -90 - 2.87 deg."""
    one = np.eye(1)
    integrator = linear(0.9 * one, one, -0.1 * one, np.array([0]), PERIOD)
    answer = margins_enough(grid.problem, Loops((0,), (integrator,), integrator), adapts=True, planned=False)
    assert answer.evidence == (
        "largest closed-loop pole magnitude 0.9; gain margin 20 (26 dB), phase margin 87.1 deg, delay margin 1.52 s (15.2 cycles)"
    )
    unstable = linear(1.1 * one, one, 0.1 * one, np.array([0]), PERIOD)
    lost = margins_enough(grid.problem, Loops((0,), (unstable,), unstable), adapts=True, planned=False)
    assert (lost.verdict, lost.numbers) == ("no", {"radius": 1.1})
    assert lost.change == "See the rates and the zero dynamics."
    for adapts, advice in ((False, "mend the model, or adapt."), (True, "see the convergence of the deformation.")):
        wrong = margins_enough(grid.problem, Loops((0,), (unstable,), integrator), adapts=adapts, planned=False)
        assert wrong.change == f"With a right model and no adaptation the loop converges: {advice}"
    assert lost.evidence == (
        "largest closed-loop pole magnitude 1.1; a pole is outside the unit circle all along the reference"
    )


def test_the_range_along_the_reference_is_told(grid):
    """What is unknown has its smallest and its largest factor, or the one that is everywhere the same."""
    assert "between" not in convergence(grid, loops(1.0, 1.0)).evidence
    assert convergence(grid, loops(0.5, 1.25)).evidence.endswith("per cycle (between 0.5 and 1.25 along the reference)")


OUTER = "The outer loop does not converge even with the right model: lower its rate, or predict over the dead time."
OWN = "See the questions about the gain, the form and the tracking law."


@pytest.mark.parametrize(("ideal", "change"), [(1.0, OUTER), (0.999, OWN), (None, OWN)])
def test_the_fault_of_an_outer_loop_is_not_the_gains(grid, ideal, change):
    """A loop that does not converge with the right model needs another rate, and no other gain."""
    assert convergence(grid, loops(2.0, ideal=ideal)).change == change


def test_what_the_zero_dynamics_do_is_not_the_gains(grid, monkeypatch):
    """Where the slowest mode is theirs and grows, along the reference or in the box; a slow loop has other cures."""
    monkeypatch.setattr("fpirhc.review.questions.convergence.of_zero_dynamics", lambda *_: True)
    monkeypatch.setattr("fpirhc.review.questions.convergence.loops_over_box", lambda *_: (loop(1.25),))
    theirs = "The slowest mode is that of the zero dynamics, which no gain changes: see there."
    case: Any = SimpleNamespace(grid=grid, controller=None, loops=loops(0.5))
    assert box_converges(case).change == convergence(grid, loops(1.0)).change == theirs
    assert convergence(grid, loops(0.9, 1.25, ideal=1.25)).change == theirs
    assert convergence(grid, loops(math.exp(-0.5 * EDGE), ideal=0.999)).change.startswith("It converges as slowly")


@pytest.mark.parametrize(
    ("deformation", "change"),
    [(fp.Affine(-0.5), "Pair the deformation through the dead time."), (fp.Paired(fp.Affine(-0.5), cycles=3), OWN)],
)
def test_only_the_plain_form_behind_a_dead_time_is_told_to_pair(deformation, change):
    """One that is paired has other cures: a leak, the model-referenced form, another gain."""
    late = review_grid(mass(dead_time=fp.DeadTime(inputs={"u": 3 * PERIOD})), 0.0, 0)
    assert convergence(late, loops(2.0), deformation).change == change


def test_a_box_around_a_loop_that_diverges_is_not_told_to_shrink(grid, monkeypatch):
    """The cure is that of the loop with the exact parameters; where that one converges, the box is too wide for the gain."""
    monkeypatch.setattr("fpirhc.review.questions.convergence.loops_over_box", lambda *_: (loop(1.25),))
    cases: list[Any] = [SimpleNamespace(grid=grid, controller=None, loops=loops(r)) for r in (1.25, 0.5)]
    assert [box_converges(one).change for one in cases] == [
        "It does not converge along the reference either: see there.",
        "Lower the gain, or narrow the box of the parameters.",
    ]


def test_the_middle_of_a_box_is_in_it(grid, monkeypatch):
    """The worst of all plants is no better than that with the exact parameters, at any point of the reference."""
    monkeypatch.setattr("fpirhc.review.questions.convergence.loops_over_box", lambda *_: (loop(0.5), loop(0.7)))
    cases: list[Any] = [SimpleNamespace(grid=grid, controller=None, loops=loops(0.6, r)) for r in (0.9, 1.25)]
    inside, outside = (box_converges(one) for one in cases)
    assert inside.verdict == "yes"
    assert inside.numbers["radius"] == pytest.approx(0.9)
    assert outside.verdict == "caution"
    assert outside.change == "It does not converge at some points of the reference: see there."


@pytest.mark.parametrize(
    ("share", "ideal", "seconds"),
    [(0.5, 0.5, "20 s"), (0.25, 0.5, "40 s"), (-0.5, 0.5, ""), (0.0, 0.5, ""), (0.5, None, "")],
)
def test_a_slow_loop_is_told_its_time_where_the_right_model_is_quicker(grid, share, ideal, seconds):
    """A share of the hundredfold change in a run of 10 s takes its inverse of it; of what grows it is not told."""
    one = convergence(grid, loops(math.exp(-share * EDGE), ideal=ideal))
    assert one.verdict == ("caution" if seconds else "unknown")
    told = f"It converges, and takes {seconds} for a factor of 100, more than the run has: a larger gain is quicker."
    assert (told if seconds else OWN) == one.change


def test_a_loop_that_changes_on_line_is_unknown(grid):
    """Whether the map changes or the model, its factor is that of the start."""
    tuned = fp.Tuned(fp.Sigmoid(gain=-0.5, scale=20.0), largest_gain=1.0)
    for one, name in (
        (convergence(grid, loops(0.5), tuned), "Tuned changes its map"),
        (convergence(grid, loops(0.5), fp.Increment(tuned, cycles=2)), "Tuned changes its map"),
        (convergence(grid, loops(0.5, learns=True)), "ComputedTorque changes its model"),
    ):
        assert (one.verdict, one.change) == ("unknown", f"{name} on line; the factor is that of the first cycle.")
    none = convergence(grid, Loops((), (), None, reason="the inverse does not exist"))
    assert (none.verdict, none.evidence) == ("unknown", "no linear loop: the inverse does not exist")


def test_doubts_and_steep_maps_speak_against_convergence(grid):
    """J = 0.75 and A = -A_c / 2: the product reaches its limit 2 at A_c = -16 / 3, where a large error may oscillate."""
    assert convergence(grid, loops(0.5), fp.Affine(-5.33)).verdict == "yes"
    steep = convergence(grid, loops(0.5), fp.Affine(-5.36), ["the map is too slow"])
    assert steep.verdict == "unknown"
    assert steep.evidence.endswith(
        "near the reference its steepest secant times an eigenvalue reaches 2.01, and the limit is 2; the map is too slow"
    )
    wrong = convergence(grid, loops(0.5), fp.Affine(0.5))
    assert wrong.evidence.endswith("but near the reference the response Jacobian changes its sign")


@pytest.mark.parametrize(
    ("drawn", "verdict", "text"),
    [
        ((0.5, 0.9), "yes", "in 100 % of 2 draws; the worst mode is multiplied by 0.9 per cycle"),
        ((0.5, 1.0), "caution", "in 50 % of 2 draws; the worst mode is multiplied by 1 per cycle"),
        ((0.5, 0.9, 1.25), "caution", "in 66.7 % of 3 draws; the worst mode is multiplied by 1.25 per cycle"),
        ((), "yes", "in 100 % of 1 draw; the worst mode is multiplied by 0.25 per cycle"),
    ],
)
def test_share_of_the_box_that_converges(grid, drawn, verdict, text, monkeypatch):
    """Of the draws; without draws of the loops along the reference."""
    case: Any = SimpleNamespace(grid=grid, controller=None, loops=loops(0.25))
    monkeypatch.setattr("fpirhc.review.questions.convergence.loops_over_box", lambda *_: tuple(map(loop, drawn)))
    one = box_converges(case)
    radii = drawn or (0.25,)
    assert (one.verdict, one.evidence, bool(one.change)) == (verdict, text, verdict == "caution")
    assert one.numbers == {"share": pytest.approx(np.mean(np.array(radii) < 1)), "radius": max(radii)}
    without: Any = SimpleNamespace(grid=grid, loops=Loops((), (), None, reason="none"))
    assert box_converges(without).evidence == "no linear loop: none"


# The gain


def admissible(gain: float, own: Any, boxed: Any, limit: float = 2.0) -> fp.Answer:
    plant, box = (Spectrum(np.array(eigenvalues, complex)[:, None]) for eigenvalues in (own, boxed))
    advice = recommended_gain(fp.Affine(gain), assess_gain(fp.Affine(gain), box), limit / 2, None)
    return gain_admissible(fp.Affine(gain), plant, box, limit, advice)


def test_numbers_of_the_gain():
    """J from 1 to 1.5: A = -A_c / 2 below 2 / 1.5, half of it recommended; under a dead time that halves it, half of all."""
    one = admissible(-0.5, [1.0], [1.0, 1.5])
    assert (one.verdict, one.change) == ("yes", "")
    assert one.evidence == (
        "gain = -0.5; the smallest limit is -2.67, set by the map's steepest secant; recommended -1.33, half of it"
    )
    assert one.numbers == pytest.approx(
        {"gain": -0.5, "recommended": -4 / 3, "factor": 0.75, "limit": -8 / 3, "linear_limit": -8 / 3}
    )
    late = admissible(-0.5, [1.0], [1.0, 1.5], limit=1.0)
    assert [late.numbers[n] for n in ("recommended", "limit", "linear_limit")] == pytest.approx(
        [-2 / 3, -4 / 3, -4 / 3]
    )


@pytest.mark.parametrize(
    ("gain", "limit", "verdict"),
    [
        (-1.99, 2.0, "yes"),
        (-2.01, 2.0, "caution"),
        (-3.99, 2.0, "caution"),
        (-4.01, 2.0, "no"),
        (0.5, 2.0, "no"),
        (-0.99, 1.0, "yes"),
        (-1.99, 1.0, "caution"),
        (-2.01, 1.0, "no"),
    ],
)
def test_where_a_gain_stops_being_admissible(gain, limit, verdict):
    """J = 1, and up to 2 in the box: the plant bears |A_c| < 4, the box |A_c| < 2, and half of both at half the limit."""
    one = admissible(gain, [1.0], [1.0, 2.0], limit)
    assert one.verdict == verdict
    assert one.change == ("" if verdict == "yes" else f"Use gain = {-limit / 2:.3g}.")


@pytest.mark.parametrize(
    ("own", "limit", "stable", "least"),
    [
        (-0.1, -1.0, (0.3, 0.8), -0.3),  # the smallest gain of the range with which the loop converges
        (0.1, 1.0, (0.3, 0.8), 0.3),
        (0.5, 1.0, (0.3, 0.8), None),  # its own does
        (0.9, 0.4, (0.1, 0.5), None),  # too large, not too small
        (0.1, 1.0, (2.0, 3.0), None),  # none up to the limit does
        (0.3, 1.0, (0.1, 0.5), None),  # its own does, the lower one that is looked at beside it need not
        (0.15, 1.0, (0.2, 0.5), 0.2),
    ],
)
def test_the_smallest_gain_is_where_the_loop_begins_to_converge(own, limit, stable, least):
    loops: Any = SimpleNamespace(
        gains=(0.5 * own, own),
        along=lambda most: [most],
        all_stable=lambda gain, pairs: stable[0] <= abs(gain) <= stable[1],
    )
    answer = least_gain(loops, limit)
    assert answer == (None if least is None else pytest.approx(least, rel=1e-3))


def test_both_signs_have_no_gain():
    """Neither in the box nor on the plant itself is there a gain to recommend."""
    box = admissible(-0.5, [1.0], [-1.0, 1.0])
    assert (box.verdict, box.change) == ("unknown", "Use another form, or leave the deformation out.")
    assert box.evidence == "gain = -0.5; no gain is recommended, because no gain converges all over the box"
    assert box.numbers["linear_limit"] == pytest.approx(-4.0)  # the plant's own
    own = admissible(-0.5, [-1.0, 1.0], [-1.0, 1.0])
    assert (own.verdict, own.change) == ("no", "See the question about the eigenvalues' sign.")


@pytest.mark.parametrize(("limit", "verdict"), [(-0.51, "yes"), (-0.49, "caution")])
def test_a_limit_that_is_not_the_maps_counts_too(limit, verdict):
    """J = 1 bears |A_c| < 4; what else limits the loop, such as its poles, is in the advice."""
    spectrum = Spectrum(np.array([[1.0 + 0j]]))
    advice = replace(recommended_gain(fp.Affine(-0.5), assess_gain(fp.Affine(-0.5), spectrum), 1.0, None), limit=limit)
    assert gain_admissible(fp.Affine(-0.5), spectrum, spectrum, 2.0, advice).verdict == verdict


def test_both_signs_of_an_inverse_are_inside():
    """J of the other sign: the gains that converge are positive, and the far end of their interval is the limit."""
    one = admissible(0.5, [-1.0], [-1.0, -1.5])
    assert one.numbers["linear_limit"] == pytest.approx(8 / 3)


@pytest.mark.parametrize(
    ("limit", "radius", "verdict", "said", "change"),
    [
        (1.0, 1.5, "yes", "the smallest limit is -2, set by a pole", ""),
        (0.25, 0.9, "caution", "the smallest limit is -0.5, set by a pole", "Use gain = -0.25, half of it."),
        (0.2, 0.9, "caution", "the smallest limit is -0.4, set by a pole", "Use gain = -0.2, half of it."),
        (0.2, 1.0, "no", "the smallest limit is -0.4, set by a pole", "Use gain = -0.2, half of it."),
        (0.2, 1.5, "no", "the smallest limit is -0.4, set by a pole", "Use gain = -0.2, half of it."),
        (math.inf, 0.9, "yes", f"no gain up to {FAR:g} times as large is a limit of the whole loop", ""),
    ],
)
def test_gain_of_a_map_on_targets(monkeypatch, limit, radius, verdict, said, change):
    """A_c = -0.5 is the effective gain 0.25: numbers are those of A_c, and a loop that converges at the plant refuses nothing."""
    monkeypatch.setattr("fpirhc.review.questions.gain.limit_of_loop", lambda deformation, loops: (limit, "a pole"))
    controller, loops = SimpleNamespace(deformation=fp.Affine(-0.5)), SimpleNamespace(radii=np.array([0.5, radius]))
    case: Any = SimpleNamespace(
        controller=controller, by_gain=object(), loops=loops, grid=SimpleNamespace(real=object())
    )
    one = gain_of_target(case)
    assert one is not None
    said += "; of the model by itself, without the reality"
    assert (one.verdict, one.evidence, one.change) == (verdict, f"gain = -0.5; {said}", change)
    assert one.numbers == pytest.approx({"gain": -0.5, "limit": -2 * limit, "recommended": -limit})
    case.by_gain = None
    assert gain_of_target(case) is None


def test_of_a_map_without_a_gain_of_its_own_the_effective_one_is_told(monkeypatch):
    """Numbers and words are those of the iteration, where no field of the map stands for them."""
    monkeypatch.setattr("fpirhc.review.questions.gain.limit_of_loop", lambda deformation, loops: (0.2, "a pole"))
    nameless = SimpleNamespace(effective_gain=lambda: 0.25, gain_name="nothing")
    case: Any = SimpleNamespace(
        controller=SimpleNamespace(deformation=nameless),
        by_gain=object(),
        loops=SimpleNamespace(radii=np.array([2.0])),
        grid=SimpleNamespace(real=None),
    )
    one = gain_of_target(case)
    assert one is not None
    assert one.numbers == pytest.approx({"gain": 0.25, "limit": 0.2, "recommended": 0.1})
    assert one.evidence == "effective gain = 0.25; the smallest limit is 0.2, set by a pole"
    assert one.change == "Use effective gain = 0.1, half of it."


SMALL = "; it is too small, the loop converges from -1.2 on"
ADVICE = Recommended(value=-1.5, limit=-3.0, sets="a pole")


@pytest.mark.parametrize(
    ("advice", "said", "change"),
    [
        (replace(ADVICE, limit=-0.5), "", "told"),
        (
            replace(ADVICE, limit=-math.inf),
            "; with -0.5 it does not converge either",
            "See the convergence of the deformation.",
        ),
        (ADVICE, SMALL, "Use gain = -1.5."),
        (replace(ADVICE, value=-1.2), SMALL, "Use gain = -1.2."),
        (
            replace(ADVICE, value=-1.1),
            "; it is too small, the loop converges from -1.2 on",
            "Use gain beyond -1.2, or another form.",
        ),
        (
            replace(ADVICE, why_not="x"),
            "; it is too small, the loop converges from -1.2 on",
            "Use gain beyond -1.2, or another form.",
        ),
    ],
)
def test_a_gain_with_which_the_loop_diverges_is_a_no(monkeypatch, advice, said, change):
    """A_c = -0.5 is the effective gain 0.25, the limit -3 six times that: a smallest one is sought up to there."""
    asked: list[Any] = []

    def least(*arguments: Any) -> float:
        asked.append(arguments)
        return 0.6

    monkeypatch.setattr("fpirhc.review.questions.gain.least_gain", least)
    by_gain = SimpleNamespace(gains=(0.2, 0.25))
    case: Any = SimpleNamespace(by_gain=by_gain, diverges=True, controller=SimpleNamespace(deformation=fp.Affine(-0.5)))
    told = fp.Answer("gain", Verdict.CAUTION, "gain = -0.5", "told", {"gain": -0.5})
    one = _converging(case, told, advice)
    assert (one.verdict, one.evidence, one.change) == ("no", told.evidence + said, change)
    assert asked == ([(by_gain, 1.5)] if "small" in said else [])
    assert one.numbers == pytest.approx({"gain": -0.5} | ({"least": -1.2} if "small" in said else {}))
    refused = replace(told, verdict=Verdict.NO)
    assert _converging(case, refused, advice) is refused
    for same in ({"by_gain": None}, {"diverges": False}):
        vars(case).update(by_gain=by_gain, diverges=True)
        vars(case).update(same)
        assert _converging(case, told, advice) is told


def test_of_a_map_on_targets_the_loop_decides_and_without_eigenvalues_nobody(monkeypatch):
    monkeypatch.setattr("fpirhc.review.questions.gain.gain_of_target", lambda case: "its loop")
    asked: Any = [SimpleNamespace(controller=SimpleNamespace(deforms=d), spectra=None) for d in ("target", "response")]
    answers: list[Any] = [_gain(case) for case in asked]
    assert answers == ["its loop", None]


def test_the_sign_of_eigenvalues_is_that_of_the_box():
    """J = 1 at the plant; one of the other sign in the box leaves it open, one at the plant is a no; none is no answer."""
    plant, box, both = (Spectrum(np.array(e, complex)[:, None]) for e in ([1.0], [1.0, -0.5], [2.0, -1.0]))
    asked: dict[str, Any] = {"yes": (plant, plant), "caution": (plant, box), "no": (both, both), "nothing": None}
    said = {name: _sign(SimpleNamespace(spectra=spectra)) for name, spectra in asked.items()}  # type: ignore[arg-type]
    assert {name: one.verdict for name, one in said.items()} == {n: n for n in asked} | {"nothing": "unknown"}
    assert said["caution"].evidence == "real parts 1 to 1, over the box -0.5 to 1"
    assert said["no"].numbers == {"smallest": -1.0, "largest": 2.0, "smallest_over_box": -1.0, "largest_over_box": 2.0}
    assert said["nothing"].evidence.startswith("no finite eigenvalue of the response Jacobian")
    assert [bool(one.change) for one in said.values()] == [False, True, True, True]


# The inverse


def regular(*smallest: float) -> np.ndarray:
    """Gains of two inputs at as many points, each on its own response, the first one 1."""
    return np.array([np.diag([1.0, one]) for one in smallest])


NAN = float("nan")


@pytest.mark.parametrize(
    ("plant", "drawn", "verdict", "said"),
    [
        ((1.0, 0.5), (0.5, 0.02), "yes", "condition at most 50, the smallest gain is 0.02 of its largest"),
        ((1.0, 1.0), (1.0, 0.0101), "yes", "condition at most 99, the smallest gain is 0.0101 of its largest"),
        ((1.0, 1.0), (1.0, 0.0099), "caution", "condition at most 101, the smallest gain is 0.0099 of its largest"),
        ((1.01e-4,) * 2, (1.01e-4,) * 2, "yes", "condition at most 9 900, the smallest gain is 1 of its largest"),
        ((0.99e-4,) * 2, (0.99e-4,) * 2, "caution", "condition at most 10 100, the smallest gain is 1 of its largest"),
        ((0.99e-8,) * 2, (0.99e-8,) * 2, "no", "of its largest; it vanishes along the reference"),
        ((0.0, 0.0), (0.0, 0.0), "no", "the smallest gain is 0 of its largest; it vanishes along the reference"),
        ((1.0, -1.0), (1.0, 1.0), "no", "of its largest; it vanishes along the reference"),
        ((1.0, 1.0), (1.0, -1.0), "caution", "of its largest; it changes sign within the box of the parameters"),
        ((1.0, 1.0), (1.0, NAN), "caution", "of its largest; it changes sign within the box of the parameters"),
        ((1.0, NAN), (1.0, 1.0), "no", "the gain of the inputs is not finite along the reference"),
    ],
)
def test_an_inverse_exists_where_the_gains_stay_regular(monkeypatch, grid, plant, drawn, verdict, said):
    """Condition and smallest share of diag(1, s) are 1 / s and s; doubts begin at 1e4 and 0.01, the end is at 1e8 and at zero."""
    gains = np.stack([regular(*plant), regular(*drawn)])
    monkeypatch.setattr("fpirhc.review.questions.reference._gains", lambda _: gains)
    one = inverse_exists(grid)
    assert (one.verdict, bool(one.change)) == (verdict, verdict != "yes")
    assert one.evidence.endswith(said)
    if one.numbers:
        smallest = [abs(s) for s in (*plant, *drawn) if np.isfinite(s)]
        share = min(smallest) / max(smallest) if max(smallest) else 0.0
        condition = max(1 / s if s else np.inf for s in smallest)
        assert one.numbers == pytest.approx({"condition": condition, "smallest_share": share})


# The slew


def slew(problem: fp.Problem, step: float, ideal: LinearLoop | None = None) -> fp.Answer:
    """The answer for a map with this largest step per cycle."""
    unit = fp.Sigmoid(gain=-0.5, scale=1.0)
    own = review_grid(problem, 0.0, 0)
    return slew_enough(own, unit.with_scale(step / unit.largest_step()), problem.plant.approximate, ideal)


@pytest.mark.parametrize(("ratio", "verdict"), [(2.01, "yes"), (1.99, "caution"), (1.01, "caution"), (0.99, "no")])
def test_a_map_is_fast_enough_at_twice_the_speed(ratio, verdict):
    """The request is 4.667 sin 3t: 14 per second."""
    one = slew(mass(), ratio * 14.0 * PERIOD)
    assert one.verdict == verdict
    assert one.evidence == f"the request changes by up to 14 m/s^3, the map by {ratio * 14:.3g} m/s^3"
    assert one.numbers == {"needed": pytest.approx(14.0, rel=1e-3), "limit": pytest.approx(ratio * 14.0), "jump": 0.0}
    change = f"Raise the map's scale at least {2 / ratio:.2g} times."
    assert one.change == ("" if verdict == "yes" else change)


def test_a_map_without_bound_is_fast_enough(grid):
    """The affine map takes a step of any size."""
    one = slew_enough(grid, fp.Affine(-0.5), grid.problem.plant.approximate, None)
    assert (one.verdict, one.evidence) == ("yes", "the request changes by up to 14 m/s^3; the map's step has no bound")


def test_disturbances_ask_for_speed_as_well():
    """A jump of 3 N on 2 kg is 1.5, of 2 m/s2 on the coordinate 2; a sine of 4 N at 5 rad/s asks for 4 x 5 / 2 per second."""
    by = {"u": fp.Sine(amplitude=4.0, frequency=5.0 / (2 * math.pi))}
    one = slew(mass(disturbances=by), 0.75)
    assert one.numbers["needed"] == pytest.approx(14.0 + 10.0, rel=1e-3)
    two = slew(mass(disturbances={"u": fp.Step(at=1.0, size=-3.0)}), 0.7)
    assert two.numbers["jump"] == pytest.approx(1.5)
    assert two.evidence.endswith("; a jump of a disturbance takes the map 3 cycles")
    both = {"u": fp.Step(at=1.0, size=3.0), "q": fp.Step(at=1.0, size=2.0)}
    assert slew(mass(disturbances=both), 0.7).numbers["jump"] == pytest.approx(2.0)


def test_a_jump_that_fits_into_one_step_takes_one_cycle():
    one = slew(mass(disturbances={"u": fp.Step(at=1.0, size=-3.0)}), 2.0)
    assert one.evidence.endswith("; a jump of a disturbance takes the map 1 cycle")


def grown(**start: float) -> fp.Problem:
    """Along 0.5 + sin t, with y = a, a' = 3 b (1 + a), b' = u."""
    plant = fp.Plant.of_states(
        states={"a": "m", "b": "m"},
        inputs={"u": "m/s"},
        outputs={"y": fp.Output("m", lambda x, p: x.a)},
        rates=lambda x, u, p: {"a": p.k * x.b * (1 + x.a), "b": u.u},
        parameters={"k": fp.Parameter(3.0, 3.0, "1/s")},
    )
    reference = fp.Trajectory(lambda t: {"y": 0.5 + ca.sin(t)})
    return fp.Problem(plant, reference, start=start, period=PERIOD, duration=PERIOD * CYCLES)


def test_a_disturbance_of_a_state_acts_on_the_response_of_the_output():
    """One unit on b' is 3 (1 + a) = 4.5 on y'' at the start, where a = 0.5; on y none."""
    own = review_grid(grown(a=0.5, b=0.2), 0.0, 0)
    assert [effect(own, name) for name in ("b", "y", "u")] == pytest.approx([4.5, 0.0, 4.5])


def test_a_start_off_the_reference_of_outputs_is_the_state_that_explains_them():
    """The start (0.6, 0.3) has y' = 1.44, the reference 0.5 and 1; coordinates have theirs."""
    shown = np.array([[1.0, 0.0], [2 / 3, 4.5]])  # of y and y' by a and b, at a = 0.5 and b = 2 / 9
    assert _start_deviation(review_grid(grown(a=0.6, b=0.3), 0.0, 0), shown) == pytest.approx(
        [0.1, (0.44 - 0.2 / 3) / 4.5]
    )
    off = review_grid(mass(start={"q": 0.2, "q'": 1.0}), 0.0, 0)
    assert _start_deviation(off, np.full((2, 2), np.nan)) == pytest.approx([0.2, -0.5])


@pytest.mark.parametrize(("ratio", "verdict"), [(10.1, "yes"), (9.9, "caution"), (1.01, "caution"), (0.99, "no")])
def test_a_constant_of_a_map_is_ten_times_the_largest_request(grid, ratio, verdict):
    """Requests of 4.667 and responses of 4.5 at the same time are 6.48; a map without such a constant is not asked."""
    largest = math.hypot(14 / 3, 4.5)
    one = range_enough(grid, fp.RFPT(offset=-ratio * largest, sign=1, gain=1e-3), grid.problem.plant.approximate)
    assert one is not None
    assert one.verdict == verdict
    assert one.numbers == {"ratio": pytest.approx(ratio, rel=1e-3)}
    assert one.change == ("" if verdict == "yes" else "Use offset = 65 or more.")
    assert range_enough(grid, fp.Affine(-0.5), grid.problem.plant.approximate) is None


def test_a_start_off_the_reference_asks_for_speed():
    """Commands 6 (1/2)^k N per metre off: the first change, 3 N or 2 m/s2 of the model, in a period of 0.1 s is 20 per second."""
    plan = linear(np.diag([0.5, 0.5]), np.eye(2), np.array([[6.0, 0.0]]), np.array([0, 1]), PERIOD)
    one = slew(mass(start={"q": 1.0, "q'": 1.5}), 1.0, plan)
    assert one.numbers["needed"] == pytest.approx(20.0)
    assert one.evidence.startswith("the request changes by up to 20 m/s^3 after the start, the map")
    near = slew(mass(start={"q": 0.5, "q'": 1.5}), 1.0, plan)
    assert near.numbers["needed"] == pytest.approx(14.0, rel=1e-3)
    assert "after the start" not in near.evidence


def cubed(**settings: Any) -> fp.Problem:
    """With y'' = u^3 / m with 1 kg, taken for 2 kg, along 4 t^2 + t^3 / 3: 8 + 2 t per second squared, u* = 2 N at first."""
    plant = fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        parameters={"m": fp.Parameter(2.0, 1.0, "kg")},
        response=lambda q, v, u, p: {"y": u.u**3 / p.m},
        inverse=lambda q, v, r, p: {"u": ca.sign(r.y) * ca.fabs(p.m * r.y) ** (1 / 3)},
    )
    usual: dict[str, Any] = {"start": {"y": 0.0}, "period": PERIOD, "duration": PERIOD * CYCLES}
    return fp.Problem(plant, fp.Trajectory(lambda t: {"y": 4 * t**2 + t**3 / 3}), **(usual | settings))


def test_effects_of_an_input_are_those_at_the_first_command():
    """A newton more than 2 N is 27 - 8 of the plant; the model's slope is 3 x 4 / 2, so 3 N in a period are 180 per second."""
    jump = slew(cubed(disturbances={"u": fp.Step(at=1.0, size=1.0)}), 1.0)
    assert jump.numbers["jump"] == pytest.approx(19.0)
    plan = linear(np.diag([0.5, 0.5]), np.eye(2), np.array([[6.0, 0.0]]), np.array([0, 1]), PERIOD)
    assert slew(cubed(start={"y": 1.0}), 1.0, plan).numbers["needed"] == pytest.approx(180.0)


def test_at_rest_nothing_is_asked_for():
    still = fp.Trajectory(lambda t: {"q": 0 * t})
    one = slew(replace(mass(start={"q": 0.0}), reference=still), 1.0)
    assert one.verdict == "yes"
    assert one.evidence == "the request changes by up to 0 m/s^3, the map by 10 m/s^3"


# The commands


def commands(rows: Any, limits: tuple[float, float] | None) -> fp.Answer:
    """The answer for these commands, shape (draws, points)."""
    own = review_grid(mass(**({"limits": fp.Limits(inputs={"u": limits})} if limits else {})), 0.0, 0)
    made = replace(own)
    made.__dict__["commands"] = np.array(rows, dtype=float)[..., None]
    return commands_inside(made)


@pytest.mark.parametrize(
    ("rows", "limits", "verdict", "own", "widest"),
    [
        ([[-2.0, 4.0]], (-4.0, 8.0), "yes", 2 / 3, 2 / 3),
        ([[-2.0, 7.0], [-3.9, 8.0]], (-4.0, 8.0), "yes", 5 / 6, 1.0),
        ([[-2.0, 7.0], [-4.6, 0.0]], (-4.0, 8.0), "caution", 5 / 6, 1.1),
        ([[-2.0, 8.6], [0.0, 9.2]], (-4.0, 8.0), "no", 1.1, 1.2),
        ([[-4.6, 2.0]], (-4.0, 8.0), "no", 1.1, 1.1),
        ([[math.nan, 5.0]], (-4.0, 8.0), "yes", 0.5, 0.5),
        ([[-9.0, 3.0]], (-math.inf, 3.0), "yes", 0.0, 0.0),
        ([[-9.0, 3.1]], (-math.inf, 3.0), "no", 2.0, 2.0),
        ([[-3.0, 9.0]], (-3.0, math.inf), "yes", 0.0, 0.0),
        ([[-3.1, 9.0]], (-3.0, math.inf), "no", 2.0, 2.0),
    ],
)
def test_share_of_the_limits(rows, limits, verdict, own, widest):
    """Of the way from the middle to the limit; a one-sided limit is kept or not."""
    one = commands(rows, limits)
    assert one.verdict == verdict
    assert one.numbers == pytest.approx({"share_of_limits": own, "share_over_box": widest})
    assert one.evidence.endswith(
        f"; {100 * own:.3g} % of the way from the middle of the limits to one of them, {100 * widest:.3g} % over the box"
    )
    held = f"u {np.nanmin(rows):.3g} to {np.nanmax(rows):.3g} N"
    change = f"Slow the reference down or ask for less; limits that are a choice must hold {held}."
    assert one.change == ("" if verdict == "yes" else change)


def test_range_of_the_commands():
    """That of the plant's own parameters, at the points where there is a command."""
    assert (
        commands([[-1.25, 2.5, math.nan], [-9.0, 9.0, 9.0]], None).evidence
        == "needed: u -1.25 to 2.5 N; no input has limits"
    )
    none = commands([[math.nan, math.nan]], (-4.0, 8.0))
    assert (none.verdict, none.evidence) == ("unknown", "no finite command is known")


def test_a_plain_form_without_margins_is_told_of_a_form_that_has_them():
    """A lower gain of the plain form is later still, and its plan needs the gain that it has; the other form has the margins."""
    task = fp.load_problem("leaking_tanks")
    plain = task.controllers["RHC+FPI"]
    passing = plain.with_deformation(fp.ModelReferenced(plain.deformation))
    found = fp.review(task.problem, {"plain": plain, "passing": passing}, seed=0, mismatch=0.0).controllers
    late, good = (next(a for a in found[name] if a.question == MARGINS) for name in ("plain", "passing"))
    assert late.numbers["phase_margin"] < LEAST_PHASE
    assert late.change.startswith(
        "Use a form that passes the desired response at once (ModelReferenced, Increment), or "
    )
    assert (good.verdict, good.change) == (Verdict.YES, "")


@pytest.mark.parametrize(
    ("null", "said"),
    [
        (0.4, "it leaves a right model alone, so another form does not help"),
        (0.6, "or use a form that leaves a right model alone: this one changes more than is wrong"),
    ],
)
def test_a_form_that_leaves_a_right_model_alone_is_not_told_to_use_one(null, said):
    """Errors: 1 without adaptation, more with it; what it makes of a right model says whether the form is to blame."""
    answer = _no_gain("", {"without": 1.0, "with": 1.2, "null": null})
    assert answer.verdict == "no"
    assert said in answer.change


@pytest.mark.slow
def test_a_right_model_that_costs_more_than_the_wrong_one_is_a_no():
    """A map too narrow for its requests: 4.3 m on its own model, where the wrong model costs centimetres without adaptation."""
    task = fp.load_problem("two_mass")
    narrow, plain = (task.controllers[name] for name in ("RHC+FPI, stiff, small S", "RHC, stiff"))
    one = asked(task.problem, narrow, "right model alone")
    costs = fp.measure(task.problem, fp.simulate(task.problem, plain, seed=0, compiled=False)).rms_error["q1"]
    assert one.verdict == "no"
    assert one.numbers["with"] > 50 * costs


def test_at_rest_no_parameter_is_reached():
    """Nothing moves along a reference of zeros, so a response error shows none of them there."""
    task = fp.load_problem("crane_slots")
    one = asked(task.problem, task.controllers["RHC+FPI"], "reach the wrong parameters")
    assert one.verdict == "caution"
    assert one.evidence == "along the reference the response is the same for all values of M, m, l, b"
    assert one.change == "It corrects them off the reference: after a start or a disturbance."


def test_a_simulator_of_somebody_else_is_recommended_no_gain():
    """The loop of the model bears half of 4; the arm of MuJoCo, whose lag is not in the model, is a matter of the probe."""
    pytest.importorskip("mujoco", reason="it needs the extra fpirhc[outside]")
    task = fp.load_problem("mujoco_arm")
    one = asked(task.problem, task.controllers["RHC+FPI"], "gain admissible")
    assert one.verdict == "unknown"
    assert one.evidence.endswith(
        "no gain is recommended, because the model knows no lag and no latency of the plant outside"
    )
    assert one.change == "fpirhc probe measures them and recommends a gain."
    assert math.isnan(one.numbers["recommended"])


def test_a_form_is_not_changed_for_errors_of_the_start():
    """The first second speaks for the model-referenced form of van_der_pol; from 3 s on it is five times worse."""
    task = fp.load_problem("van_der_pol")
    one = asked(task.problem, task.controllers["RHC+FPI"], "form of the iteration")
    assert one.verdict == "yes"
    own, other = (
        float(words.split()[0]) for words in one.evidence.split("rms error of q is ")[1].split(" m as it is, ")
    )
    assert other > 2 * own
    assert "in at most 1000 cycles in which errors count" in one.evidence


def test_an_integral_finds_its_place_before_its_margins_are_asked():
    """A PID law behind 7.8 cycles: its loop as it is written by hand; none where the pump's least target is more than is needed."""
    task = fp.load_problem("anaesthesia_people")
    one = asked(task.problem, task.controllers["PID"], "enough margin")
    decay, slope = math.exp(-1 / 18), 50 * (1 - 50 / 92) * 1.57 / (4.53 * (92 / 50 - 1) ** (1 / 1.57))
    z = np.exp(1j * np.geomspace(1e-3, 1.0, 100_000))
    loop = slope * (0.04 + 0.0235 / 12 / (z - 1)) * (1 - decay) / (z - decay) * (0.2 * z**-7 + 0.8 * z**-8)
    turned, unity = np.argmax(np.unwrap(np.angle(loop)) < -np.pi), np.argmax(np.abs(loop) < 1)
    assert one.numbers["gain_margin"] == pytest.approx(1 / abs(loop[turned]), rel=2e-3)
    assert one.numbers["phase_margin"] == pytest.approx(180 + np.angle(loop[unity], deg=True), rel=1e-3)
    high = replace(task.problem, limits=fp.Limits(inputs={"target": (4.5, 12.0)}), input_before={"target": 4.5})
    one = asked(high, task.controllers["PID"], "enough margin")
    assert one.verdict == "unknown"
    assert "the command stands at a limit all along the reference" in one.evidence


def test_a_yes_advises_nothing_and_a_number_has_three_verdicts():
    """Below 1 it is a reason to stop, from what is wanted on it is fine; NaN, which nothing decides, is neither."""
    answers = {verdict: Answer("Is it?", verdict, "it is", "Change it.").change for verdict in Verdict}
    assert answers == {verdict: "" if verdict == Verdict.YES else "Change it." for verdict in Verdict}
    sizes = (0.99, 1.0, 1.99, 2.0, math.inf, math.nan)
    assert [graded(size, 2.0) for size in sizes] == ["no", "caution", "caution", "yes", "yes", "caution"]
