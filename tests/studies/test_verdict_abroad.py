"""The verdict on plants that are not shipped, by value: what a user reads there is what happened."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import abroad
import pytest

import fpirhc as fp
from fpirhc.report.html import css_class, render
from fpirhc.report.terminal import STYLES
from fpirhc.review.questions.margins import SLOWER
from fpirhc.studies.comparison.changes import Outcome
from fpirhc.studies.comparison.compare import broken_limits, compare
from fpirhc.studies.comparison.comparison import Comparison
from fpirhc.studies.view import to_json


def compared(name: str, *controllers: str, variant: str = "problem", **changes) -> Comparison:
    """The comparison of some of the file's controllers; the problem may be changed, such as its duration."""
    task = abroad.load(name, variant)
    if changes:
        task = replace(task, problem=replace(task.problem, **changes))
    return compare(task, seed=0, controllers=controllers or None)


@pytest.fixture(scope="module")
def cstr() -> Comparison:
    return compared("cstr", "RHC", "RHC+FPI")


@pytest.mark.slow
def test_reactor_whose_only_weighted_output_is_lost(cstr):
    """C_b, the only weighted output, goes from 7e-6 to 0.39 mol/l: that is worse, though the jacket's error is smaller."""
    first = cstr.findings[0]
    assert cstr["RHC"].metrics.rms_error["C_b"] < 1e-5
    assert cstr["RHC+FPI"].metrics.rms_error["C_b"] == pytest.approx(0.39, rel=0.1)
    assert cstr["RHC+FPI"].metrics.rms_error["T_K"] < cstr["RHC"].metrics.rms_error["T_K"]
    assert first.outcome is Outcome.WORSE
    assert set(first.ratios) == {"C_b"}
    assert first.ratios["C_b"] > 1e4
    assert "RHC+FPI does not help: it raises the rms error of C_b from" in first.text
    assert "The cost does not weigh, so the verdict leaves out: T_K" in first.text


def test_reactor_fails_the_null_test(cstr):
    """Its model is exact, so the null test is the run itself."""
    assert cstr.null is not None
    assert cstr.null.harmful
    assert not cstr.null.passed
    assert cstr.null.after["C_b"] == pytest.approx(cstr["RHC+FPI"].metrics.rms_error["C_b"], rel=1e-6)
    assert "failed, RHC+FPI is worse than RHC although there is nothing to adapt (C_b" in cstr.null.text


def test_what_does_not_help_is_never_green(cstr):
    """One outcome decides the words, the terminal's colour, the page's class and the JSON."""
    assert STYLES[cstr.outcome] == "bold red"
    page = render(cstr)
    assert "class='headline outcome-worse'>RHC+FPI does not help" in page
    assert "outcome-better" not in page.partition("<section id='verdict'>")[2].partition("</section>")[0]
    facts = to_json(cstr.view.facts)
    assert '"outcome": "worse"' in facts
    assert '"harmful": true' in facts
    green = [outcome for outcome in Outcome if "green" in STYLES[outcome]]
    assert green == [Outcome.BETTER]
    assert len({css_class(outcome) for outcome in Outcome}) == len(Outcome)


def test_tanks_get_better_in_both_levels_worst_first():
    """h1 four times better, h2 forty times; the smaller gain comes first. Own errors are small beside the model's."""
    tanks = compared("quadruple_tank", "RHC", "RHC+FPI", "RHC exact model")
    first = tanks.findings[0]
    assert first.outcome is Outcome.BETTER
    assert list(first.ratios) == ["h1", "h2"]
    assert 1 / first.ratios["h1"] == pytest.approx(3.6, rel=0.2)
    assert 1 / first.ratios["h2"] == pytest.approx(37, rel=0.3)
    assert first.text.index("h1 from") < first.text.index("h2 from")
    assert not any("no bound" in text for text in tanks.verdict)
    assert tanks.null is not None
    assert not tanks.null.harmful
    assert "makes a small error of its own" in tanks.null.text


def test_servo_does_not_change():
    """The mismatch is where the controlled response does not feel it: 5 % is no clear difference, and it is not called a gain."""
    servo = compared("flexible_servo", "RHC", "RHC+FPI", "RHC exact model")
    assert servo.outcome is Outcome.NO_DIFFERENCE
    assert servo.findings[0].text.startswith(
        "RHC+FPI makes no clear difference: it changes the rms error of load from 0.0066"
    )
    assert STYLES[servo.outcome] == ""
    assert servo["RHC exact model"].metrics.rms_error["load"] < 1e-4


def test_infusion_is_better():
    """Marsh's kinetics in a Schnider patient: RHC 0.28 mg/l, RHC+FPI 0.001 mg/l; a plan every second cycle is said to be one."""
    infusion = compared("drug_infusion", "RHC", "RHC+FPI", "RHC offset-free", duration=60.0)
    assert infusion.outcome is Outcome.BETTER
    assert infusion.findings[0].ratios["C1"] < 0.02
    assert any(
        text.startswith("Rates: RHC+FPI corrects in every cycle, RHC offset-free only") for text in infusion.verdict
    )


def test_own_map_in_the_wrong_form_is_worse_and_the_right_form_is_named():
    """Paired, the loop diverges through the dead time; as an increment the same map halves the error, and is named."""
    cart = compared("own_map", "RHC", "RHC+FPI", "RHC+FPI, increment")
    outcomes = {f.pair[1]: f.outcome for f in cart.findings if f.pair}
    assert outcomes == {"RHC+FPI": Outcome.WORSE, "RHC+FPI, increment": Outcome.BETTER}
    assert any(text.startswith("RHC+FPI, increment is far better than this pair") for text in cart.verdict)
    assert cart.null is not None
    assert cart.null.harmful


@pytest.mark.slow
def test_a_filter_that_is_too_fast_for_a_wrong_model_is_named_by_review_and_verdict():
    """Tanks of 2.3 times their area: three times the error of RHC, and a loop with a pole of 1.35; with a third of the drift a
    seventeenth, and every pole inside.
    """
    task: Any = fp.load_problem("leaking_tanks")
    area = replace(task.problem.plant.parameters["A"], approximate=2.3 * 1.54e-3)
    plant = replace(task.problem.plant, parameters={**task.problem.plant.parameters, "A": area})
    problem, fast = replace(task.problem, plant=plant), task.controllers["RHC offset-free"]
    slow = replace(fast, estimator=replace(fast.estimator, drift={"h1": 3e-5, "h2": 3e-5}))
    rows = {"RHC": task.controllers["RHC"], "fast": fast, "slow": slow}
    comparison = compare(replace(task, problem=problem, controllers=rows, headline=None), seed=0, compiled=False)
    [worse] = [text for text in comparison.verdict if "does worse" in text]
    assert worse.startswith(
        "fast does worse than RHC, whose model does not change (0.022 m): it has an rms error of h2 of 0.0725 m (3.3 times"
    )
    answers = fp.review(problem, {"fast": fast, "slow": slow}, mismatch=0.0, seed=0).controllers
    margin = {name: next(a for a in group if "margin" in a.question) for name, group in answers.items()}
    assert margin["fast"].numbers["radius"] == pytest.approx(1.35, abs=0.02)
    assert margin["fast"].change == SLOWER
    assert margin["slow"].numbers["radius"] < 1


def test_an_exact_model_that_is_beaten_is_no_bound():
    """The tumour's exact model does not know the step of the dose and plans once in 20 cycles: adaptation has a smaller error."""
    task = fp.load_problem("tumour")
    found = compare(task, seed=0, controllers=["RHC", "RHC+FPI", "RHC exact model"])
    [text] = [t for t in found.verdict if "no bound" in t]
    assert text.startswith("RHC exact model is no bound here: it has an rms error of size of")
    assert "its model is without the disturbance of dose; it plans every 20 cycles" in text


def test_at_the_same_rate_and_with_the_same_information_it_is_parity():
    """Van der Pol-Duffing: ten corrections per plan give RHC+FPI half the error of offset-free control; one gives it 0.9.

    Both correct the response that the model expected by the one that was measured, so that only the rate differs.
    """
    task = fp.load_problem("van_der_pol_duffing")
    names, error = ("RHC+FPI", "RHC offset-free"), {}
    for period in (2e-3, 2e-2):
        problem = replace(task.problem, period=period)
        runs = [fp.simulate(problem, task.controllers[name], seed=0) for name in names]
        error[period] = [fp.measure(problem, run).rms_error["q"] for run in runs]
    fast, slow = (adaptive / learner for adaptive, learner in error.values())
    assert fast < 0.5
    assert 0.5 < slow < 2


@pytest.mark.slow
def test_a_process_behind_a_dead_time_and_a_lag_is_better_and_predicting_alone_is_not():
    """Half the error with a gain that is 40 % wrong; the null test leaves the lag's own error as it is."""
    process = compared("half_rule")
    errors = {one.name: one.metrics.rms_error["y"] for one in process.entries}
    assert errors == pytest.approx(
        {"RHC": 0.260, "RHC+FPI": 0.144, "RHC, not predicted": 0.235, "RHC+FPI, not predicted": 0.155}, rel=0.01
    )
    assert process.findings[0].text.startswith("RHC+FPI lowers the rms error of y from 0.26 to 0.144 (1.8 times less)")
    assert process.null is not None
    assert process.null.passed
    assert process.null.after["y"] == pytest.approx(process.null.before["y"], rel=1e-6)


def test_two_loops_that_swing_by_themselves_are_not_told_to_ask_for_less():
    """Both are unstable behind the dead time, in a limit cycle between limits that the reference needs to 60 %."""
    pair = compared("half_rule", "RHC, not predicted", "RHC+FPI, not predicted", variant="swinging")
    [text] = [finding.text for finding in pair.findings if "no clear difference" in finding.text]
    assert text.endswith(
        "both swing to and fro where the reference does not. Mend the loop without adaptation first; see its review."
    )
    assert "slow the reference down" not in text


def test_a_hard_limit_that_a_run_breaks_is_told():
    """The mass begins faster than its hard limit: the note says how fast; with a soft limit there is none, and none inside."""
    mass = fp.Plant({"q": "m"}, {"u": "N"}, {"m": fp.Parameter(1.0, 1.0, "kg")}, lambda q, v, u, p: {"q": u.u / p.m})

    def notes(limit: float, size: float = 1.0, **soft: float) -> tuple[str, ...]:
        problem = fp.Problem(
            plant=mass,
            reference=fp.Trajectory(lambda t: {"q": 0 * t}),
            start={"q": 0.0, "q'": -1.5 * size},
            period=0.05,
            duration=1.0,
            limits=fp.Limits(states={"q'": (-limit, limit)}, soft=soft),
            horizon=fp.Horizon(stages=10, step=0.05),
            cost=fp.Quadratic(states={"q": 1.0, "q'": 0.1}, effort={"u": 1e-2}),
        )
        plan = fp.RecedingHorizon(fp.FixedPoint(iterations=5, tolerance=1e-3))
        return broken_limits(problem, fp.simulate(problem, plan, seed=0, compiled=False))

    assert notes(1.0) == ("q' reaches -1.5 m/s, beyond its hard limit of -1 m/s",)
    assert notes(1e-8, 1e-8) == ("q' reaches -1.5e-08 m/s, beyond its hard limit of -1e-08 m/s",)
    assert notes(2.0) == notes(1.0, **{"q'": 10.0}) == ()
