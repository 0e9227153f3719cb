"""The verdict on plants that are not shipped, by value: what a user reads there is what happened."""

from __future__ import annotations

from dataclasses import replace

import fpirhc as fp
from fpirhc.studies.comparison.compare import broken_limits, compare


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
