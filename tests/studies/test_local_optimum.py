"""Plans that count as solved in a local optimum, found in a run: IPOPT, from the middle of the limits, decides who is right."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import pytest

import fpirhc as fp

EXACT = "RHC exact model"


def emptied(task):
    """The tanks, to be emptied at 60 s and filled again at 90 s: an empty tank flows out as before, whatever the pump adds."""

    def levels(t):
        level = 0.12 * (1 - 1 / (1 + ca.exp(-2 * (t - 60))) + 1 / (1 + ca.exp(-2 * (t - 90))))
        return {"h1": (4.0 / 5.5) ** 2 * level, "h2": level}

    problem = replace(task.problem, reference=fp.Trajectory(levels), duration=120.0, measure_from=0.0, disturbances={})
    return replace(task, problem=problem)


@pytest.fixture(scope="module")
def task():
    return emptied(fp.load_problem("leaking_tanks"))


def test_the_verdict_says_so_of_a_run_whose_status_is_ok(task):
    """The tank stays empty: the sentence has the count, the first time, and what to do; a run that fills it again has none."""
    compared = fp.compare(task, seed=0, controllers=["RHC+FPI", EXACT], compiled=False)
    known = compared[EXACT].optimality
    assert known is not None
    stuck = known.stuck
    [text] = [t for t in compared.verdict if "local optimum" in t]
    assert text.startswith(f"{EXACT}: its plans stay in a local optimum: {len(stuck)} of the ")
    assert f"the first at t = {stuck[0]:g} s" in text
    assert "Limits(states=...)" in text
    assert compared[EXACT].run["state.h2"][-1] < -0.1
    assert compared[EXACT].metrics.statuses["OK"] > 0.7 * compared[EXACT].run.cycles
