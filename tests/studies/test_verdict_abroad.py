"""The verdict on plants that are not shipped, by value: what a user reads there is what happened."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import abroad
import pytest

import fpirhc as fp
from fpirhc import compare
from fpirhc.studies.comparison.compare import Comparison, broken_limits
from fpirhc.studies.comparison.verdict import Outcome


@pytest.fixture(scope="module")
def cstr() -> Comparison:
    return compared("cstr", "RHC", "RHC+FPI")


def compared(name: str, *controllers: str, variant: str = "problem", **changes: Any) -> Comparison:
    """The comparison of some of the file's controllers; the problem may be changed, such as its duration."""
    task = abroad.load(name, variant)
    if changes:
        task = replace(task, problem=replace(task.problem, **changes))
    return compare(task, seed=0, controllers=controllers or None)


def test_reactor_whose_only_weighted_output_is_lost(cstr):
    """C_b, the only weighted output, goes from 7e-6 to 0.39 mol/l: that is worse, though the jacket's error is smaller."""
    first, (plain, adaptive) = cstr.findings[0], cstr.entries
    assert plain.errors["C_b"] < 1e-5
    assert adaptive.errors["C_b"] == pytest.approx(0.39, rel=0.1)
    assert adaptive.errors["T_K"] < plain.errors["T_K"]
    assert first.outcome is Outcome.WORSE
    assert set(first.ratios) == {"C_b"}
    assert first.ratios["C_b"] > 1e4


def test_reactor_fails_the_null_test(cstr):
    """Its model is exact, so the null test is the run itself, and the verdict has its flag."""
    null = cstr["RHC+FPI"].null
    assert null.fails
    assert null.adapted["C_b"] == pytest.approx(cstr["RHC+FPI"].errors["C_b"], rel=1e-6)
    assert "right model" in cstr.verdict[0]


def test_tanks_get_better_in_both_levels_worst_first():
    """h1 four times better, h2 forty times; own errors are small beside the model's, so nothing is doubtful."""
    tanks = compared("quadruple_tank", "RHC", "RHC+FPI", "RHC exact model")
    first = tanks.findings[0]
    assert first.outcome is Outcome.BETTER
    assert list(first.ratios) == ["h1", "h2"]
    assert 1 / first.ratios["h1"] == pytest.approx(3.6, rel=0.2)
    assert 1 / first.ratios["h2"] == pytest.approx(37, rel=0.3)
    assert not any("no bound" in text or "right model" in text for text in tanks.verdict)


def test_servo_does_not_change():
    """The mismatch is where the controlled response does not feel it: 5 % is no clear difference."""
    servo = compared("flexible_servo", "RHC", "RHC+FPI", "RHC exact model")
    assert servo.outcome is Outcome.NO_DIFFERENCE
    assert servo["RHC exact model"].errors["load"] < 1e-4


def test_infusion_is_better():
    """Marsh's kinetics in a Schnider patient: RHC 0.28 mg/l, RHC+FPI 0.001 mg/l."""
    infusion = compared("drug_infusion", "RHC", "RHC+FPI", duration=60.0)
    assert infusion.outcome is Outcome.BETTER
    assert infusion.findings[0].ratios["C1"] < 0.02


def test_own_map_in_the_wrong_form_is_worse_and_in_the_right_form_better():
    """Paired, the loop diverges through the dead time; as an increment the same map halves the error."""
    cart = compared("own_map", "RHC", "RHC+FPI", "RHC+FPI, increment")
    outcomes = {f.pair[1]: f.outcome for f in cart.findings if f.pair}
    assert outcomes == {"RHC+FPI": Outcome.WORSE, "RHC+FPI, increment": Outcome.BETTER}
    assert cart["RHC+FPI"].null.fails


def test_an_exact_model_that_is_beaten_is_no_bound():
    """The tumour's exact model does not know the step of the dose and plans once in 20 cycles: adaptation has a smaller error."""
    task = fp.load_problem("tumour")
    found = compare(task, seed=0, controllers=["RHC", "RHC+FPI", "RHC exact model"])
    assert "RHC exact model is no bound here: RHC+FPI have smaller errors" in " ".join(found.verdict)


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
