"""A fixed-point iteration on the target of an inner controller: pairing, stability, limits, and what may stand inside."""

from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import tasks
from helpers.of_outputs import OPTIMISER, affine, hill, planned, sedated
from helpers.plants import simulated

import fpirhc as fp

STATIC = fp.FeedforwardOnly()
SETTLING, LAGGED = 20.0, 5.0  # the heat exchanger's, and that of `linear`


def rms(problem: fp.Problem, controller: Any) -> tuple[float, float]:
    """Rms error of the output and largest step of the command, without the transient."""
    run = fp.simulate(problem, controller, seed=1, compiled=False)
    assert run.stop is None
    measured = run.time >= problem.measure_from
    error, command = run["error"][measured], run["command"][measured]
    return float(np.sqrt(np.mean(error**2))), float(np.abs(np.diff(command, axis=0)).max())


def test_paired_through_the_model_every_gain_serves():
    """A map with slopes from .15 to 2.15 behind a lag and a dead time: up to twelve times better than without, and quiet."""
    without, _ = rms(tasks.heat_exchanger.problem, STATIC)
    for gain, share in ((0.05, 0.2), (0.1, 0.13), (0.2, 0.11), (0.5, 0.1), (0.9, 0.1)):
        error, step = rms(tasks.heat_exchanger.problem, fp.Cascade(STATIC, affine(gain), SETTLING))
        assert error < share * without, gain
        assert step < 0.01, gain


def test_the_shift_is_that_of_the_recursion_by_hand():
    """Logged outputs through the formulas in numpy: reference and shift in force, undeformed target, map."""
    run = fp.simulate(tasks.heat_exchanger.problem, fp.Cascade(STATIC, affine(0.4), SETTLING), seed=1, compiled=False)
    decay, gain = np.exp(-1 / 20), 0.4
    reference, shifts = run["reference.outlet"], [0.0] * 6
    shift, in_force = 0.0, 0.3 - reference[0]
    for k in range(400):
        target_in_force = reference[max(k - 5, 0)] + in_force
        if k:
            shift = shift - gain * (run["state.outlet"][k] - target_in_force + shift)
        assert run["shift.outlet"][k] == pytest.approx(shift, abs=1e-12)
        assert run["target.outlet"][k] == pytest.approx(reference[k] + shift, abs=1e-12)
        shifts = [shift, *shifts[:5]]
        in_force = decay * in_force + (1 - decay) * shifts[5]


def linear(slope: float, **changes: Any) -> fp.Problem:
    """Y' = (slope u - y) / 5 s with the model y' = (u - y) / 5 s, a set-point of one, cycles of 4 s."""
    plant = fp.Plant(
        coordinates={"y": "K"},
        inputs={"u": "1"},
        order=1,
        response=lambda q, u, p: {"y": (p.slope * u.u - q.y) / 5.0},
        parameters={"slope": fp.Parameter(approximate=1.0, exact=slope, unit="K")},
    )
    values = {
        "plant": plant,
        "reference": fp.Trajectory(lambda t: {"y": 1.0 + 0 * t}),
        "start": {"y": 0.0},
        "period": 4.0,
        "duration": 1600.0,
        "integrator": fp.RungeKutta4(8),
    }
    return fp.Problem(**{**values, **changes})


@pytest.mark.parametrize("gain", [0.3, 0.6, 1.0])
def test_the_limit_is_that_of_the_theory(gain):
    """Sampled: slope < 1 + (2 - a) (1 + rho) / (a (1 - rho)); 2 % below the shift settles, 2 % above it grows."""
    decay = np.exp(-4.0 / 5.0)
    limit = 1 + (2 - gain) * (1 + decay) / (gain * (1 - decay))
    for share, settles in ((0.98, True), (1.02, False)):
        run = fp.simulate(linear(share * limit), fp.Cascade(STATIC, affine(gain), LAGGED), seed=1, compiled=False)
        early, late = (np.abs(run["error.y"][k : k + 40]).max(initial=0.0) for k in (40, 360))
        late = np.inf if run.stop else late  # it ran away
        assert bool(late < early) is settles, (share, early, late)


def test_a_target_out_of_reach_does_not_wind_the_shift_up():
    """The reference is beyond the limit of the valve for 800 s; afterwards the output is as near as if it had never been."""

    def reference(t: Any) -> dict[str, Any]:
        return {"y": ca.if_else(ca.logic_and(t > 400, t < 1200), 3.0, 1.0)}

    limited = linear(0.7, limits=fp.Limits(inputs={"u": (0.0, 2.0)}), reference=fp.Trajectory(reference))
    run = fp.simulate(limited, fp.Cascade(STATIC, affine(0.5), LAGGED), seed=1, compiled=False)
    out = (run.time > 500) & (run.time < 1200)
    assert run["state.y"][out] == pytest.approx(1.4, abs=1e-3)
    assert np.abs(run["shift"]).max() < 2.0
    assert np.abs(run["error.y"][run.time > 1320]).max() < 1e-2


def test_without_adaptation_it_is_what_it_is_around():
    wrapped = fp.ExactModel(fp.Cascade(STATIC, affine(0.4), None)).with_deformation(fp.Identity())
    assert wrapped.controller is STATIC


BAD: dict[str, tuple[Any, str]] = {
    "wrong sign": (fp.Cascade(STATIC, fp.Affine(gain=0.5), LAGGED), "use the other sign"),
    "paired inside": (fp.Cascade(STATIC, fp.Paired(affine(0.5), cycles=3), LAGGED), "Paired pairs by itself"),
    "model-referenced inside": (fp.Cascade(STATIC, fp.ModelReferenced(affine(0.5)), LAGGED), "already compares"),
    "no scale": (fp.Cascade(STATIC, fp.Sigmoid(gain=-0.5), LAGGED), "scale"),
    "two lags": (fp.Cascade(STATIC, affine(0.5), lag=(5.0, 3.0)), "1 controlled coordinates"),
    "too late": (fp.Cascade(STATIC, affine(0.5), lag=5.0, dead_time=1e5), "more than 1000"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_work_is_refused(name):
    """Before a run, with the remedy."""
    controller, text = BAD[name]
    with pytest.raises(fp.FpirhcError, match=text):
        fp.simulate(linear(0.6), controller, seed=1)


def test_what_adds_up_without_feedback_is_refused_inside() -> None:
    with pytest.raises(fp.FpirhcError, match="FeedforwardOnly does not cover outputs"):
        simulated(sedated(hill(5.5)), fp.Cascade(STATIC, affine(0.3), lag=1.0))


# A cascade on outputs that are expressions of the state, and its way back from a limit


LAW = fp.ComputedTorque(fp.Exponential(rate=1.0))


@pytest.mark.parametrize("inner", ["computed torque", "receding horizon"])
def test_a_cascade_around_a_controller_of_an_output_takes_its_error_away(inner: str) -> None:
    """The depth of a patient with a wrong curve: a law and a plan leave errors that a shifted target lowers."""
    problem, controller = {
        "computed torque": (sedated(hill(5.5)), LAW),
        "receding horizon": (planned(), fp.RecedingHorizon(OPTIMISER)),
    }[inner]
    cascade = fp.Cascade(controller, affine(0.3), lag=1.0)
    errors = [fp.measure(problem, simulated(problem, c)).rms_error["depth"] for c in (controller, cascade)]
    assert errors[1] < 0.75 * errors[0]


def test_plans_along_a_target_are_none_along_the_reference():
    """Nobody who asks for the plans of the problem's horizon is shown them; around other wrappers they are the same."""
    plan = fp.RecedingHorizon(OPTIMISER)
    assert (fp.Cascade(plan, affine(0.5), None).planner, fp.Predicted(plan, inputs=0.0).planner) == (None, plan.planner)
