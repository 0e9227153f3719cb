"""Runs whose plans did not converge say that they depend on rounding."""

from __future__ import annotations

from dataclasses import replace

import fpirhc as fp


def runs(iterations):
    p = fp.load_problem("van_der_pol").problem
    p = replace(p, duration=0.4, measure_from=0.0)
    optimiser = fp.ReducedGradient(iterations=iterations, tolerance=1e-3)
    return fp.simulate(p, fp.RecedingHorizon(optimiser), seed=0, compiled=False)


def test_a_run_of_plans_that_did_not_converge_names_its_rounding_in_one_sentence():
    """A few steps of the plain gradient: the share of the cycles, the consequence and the remedy, in the value and its text."""
    run = runs(3)
    share = 100 * (run["status"] == fp.Status.NOT_CONVERGED).mean()
    assert share > 50
    assert run.depends_on_rounding.startswith(
        f"plans did not converge in {share:.3g} % of the cycles; such plans depend on rounding"
    )
    assert "compiled C, the virtual machine and another computer may give other runs" in run.depends_on_rounding
    assert run.depends_on_rounding in repr(run)


def test_a_run_of_converged_plans_says_nothing():
    p = fp.load_problem("van_der_pol").problem
    p = replace(p, duration=0.4, measure_from=0.0)
    run = fp.simulate(p, fp.RecedingHorizon(fp.FixedPoint(iterations=5, tolerance=1e-2)), seed=0, compiled=False)
    assert run.depends_on_rounding == ""
    assert "rounding" not in repr(run)
