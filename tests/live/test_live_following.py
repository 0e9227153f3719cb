"""Numbers that Python computes from live settings: stationary gains, solutions of Lyapunov's equation, exact steps of a model."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import pytest

import fpirhc as fp
from fpirhc.conformance.live import check_live
from fpirhc.conformance.loops import two_masses
from fpirhc.errors import InvalidValue
from fpirhc.problem_files.problem_file import load_problem
from fpirhc.simulation.simulate import simulator

INNER = fp.ComputedTorque(fp.Exponential(rate=8.0), fp.Sigmoid(gain=-0.5, scale=50.0))
MEASURED = dict.fromkeys(("a", "b", "a'", "b'"), 1e-3)
KALMAN = fp.Estimating(INNER, fp.DisturbanceKalman({"a": 1.0, "b": 1.0}, MEASURED, noise={"a": 0.1}))


@pytest.mark.parametrize("compiled", [False, True], ids=["VM", "C"])
def test_a_filter_has_the_stationary_gain_of_the_deviations_in_force(compiled):
    """Drift, noise of the measurement and of the response enter one Riccati equation, which Python solves at every change."""
    paths = ["estimator.drift.a", "estimator.measured.b'", "estimator.noise.a"]
    tried = check_live(two_masses(), KALMAN, paths=paths, cycles=30, compiled=compiled)
    assert all(one.factor for one in tried), tried


def test_a_gain_that_changes_during_a_run_changes_the_estimate():
    """Without the new gain the estimate would go on as before."""
    problem = replace(two_masses(), duration=0.5, measure_from=0.0)
    ready = simulator(problem, KALMAN, compiled=False, live=["estimator.drift.a"])
    plain, changed = ready.run(seed=0), ready.run(seed=0, changes={0.25: {"estimator.drift.a": 20.0}})
    half = plain.cycles // 2
    before, after = (
        abs(plain["estimate"] - changed["estimate"])[:half],
        abs(plain["estimate"] - changed["estimate"])[half:],
    )
    assert before.max() == 0.0
    assert after.max() > 1e-3 * abs(plain["estimate"]).max()
    with pytest.raises(InvalidValue, match="positive"):
        ready.run(seed=0, settings={"estimator.drift.a": -1.0})


def test_every_derived_number_says_what_an_old_one_does():
    """A device without Python needs to know; an empty text forbids the change there."""
    arm, pendulum, two = (load_problem(name) for name in ("planar_arm", "mrac_pendulum", "two_mass"))
    terminal = replace(cast(Any, two.problem.cost), terminal=fp.LQRTerminal())
    planned = replace(two.problem, cost=terminal)
    cases: list[tuple[Any, Any, list[str], set[bool]]] = [
        (planned, two.controllers["RHC"], ["cost.states.q1"], {True}),
        (two_masses(), KALMAN, ["estimator.drift.a"], {True}),
        (pendulum.problem, pendulum.controllers["Lyapunov MRAC"], ["rate"], {False}),
        (arm.problem, arm.controllers["AID"], ["tracking.rate"], {False}),
    ]
    for problem, controller, paths, safe in cases:
        stepper = fp.Stepper(problem, controller, compiled=False, live=paths)
        derived = {name for name in stepper._composite.settings.names if ".derived." in name}
        assert derived
        assert stepper.outdated().keys() == derived
        assert {bool(words) for words in stepper.outdated().values()} == safe
    plain = fp.Stepper(two.problem, two.controllers["CTC+FPI (eq 6)"], compiled=False, live=["deformation.gain"])
    assert plain.outdated() == {}
