"""What measured quantities allow: the law of slow filters, its margins, and runs that reach what is promised."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from plants import chain, pendulum

import fpirhc as fp
from fpirhc.errors import InvalidProblem, InvalidValue
from fpirhc.studies.information import filter_gain_margin

DRIFT, PERIOD = 3.0, 1e-3  # m/s^2.5, s


def told(noise: dict[str, float], order: int = 2, **changes) -> fp.Problem:
    """A chain of integrators at rest, with these noises and a residual that drifts."""
    settings = {
        "plant": chain(order),
        "reference": fp.Trajectory(lambda t: {"y": 0 * t}),
        "start": {"y": 0.0},
        "period": PERIOD,
        "duration": 40.0,
        "measure_from": 5.0,
        "sensing": fp.Sensing({name: fp.Sensor(fp.Noise(s)) for name, s in noise.items()}),
        "disturbances": {"y": fp.ColouredNoise(DRIFT * np.sqrt(100.0 / 2), 100.0)},
    }
    return fp.Problem(**{**settings, **changes})


@pytest.mark.parametrize(("order", "constant"), [(1, 1.0), (2, 1.41421), (3, 2.0), (4, 2.61313)])
def test_error_of_slow_filters_has_a_closed_form(order, constant):
    """Var = c_n D^(2 - 1/n) (s^2 T)^(1 / 2n), here with omega T = 0.03; the Riccati equation in cycles agrees within 6 %."""
    noise = DRIFT * PERIOD**-0.5 * (PERIOD / 0.03) ** order
    measured = "y" + "'" * (4 - order + 1)
    [row] = [r for r in fp.compare_information(told({measured: noise}, 4), drift={"y": DRIFT}).rows if r.order == order]
    assert row.bandwidth * PERIOD == pytest.approx(0.03)
    assert row.formula**2 == pytest.approx(
        constant * DRIFT ** (2 - 1 / order) * (noise**2 * PERIOD) ** (0.5 / order), rel=1e-5
    )
    assert row.error == pytest.approx(row.formula, rel=0.06)


@pytest.mark.parametrize(("order", "margin"), [(1, np.inf), (2, np.inf), (3, 4.0), (4, 1 + np.sqrt(2)), (6, 2.0139)])
def test_margin_is_where_the_polynomial_has_a_root_on_the_axis(order, margin):
    """Butterworth's polynomial with its last coefficient times lambda: stable 1 % below, unstable 1 % above."""
    assert filter_gain_margin(order) == pytest.approx(margin, rel=1e-4)
    poles = np.exp(1j * np.pi * (2 * np.arange(order) + order + 1) / (2 * order))
    polynomial = np.real(np.poly(poles))
    for gain, stable in ((0.99 * margin, True), (1.01 * margin, False)) if np.isfinite(margin) else ((1e3, True),):
        roots = np.roots(np.append(polynomial[:-1], gain))
        assert (roots.real.max() < 0) == stable


@pytest.mark.parametrize("share", [0.25, 4.0])
def test_response_beats_velocity_where_the_law_says_so(share):
    """s_f^2 T^0.5 < 2 D s_v."""
    velocity = 1e-3
    response = np.sqrt(share * 2 * DRIFT * velocity / np.sqrt(PERIOD))
    noise = {"y": 1.0, "y'": velocity, "y''": response}
    best = fp.compare_information(told(noise), drift={"y": DRIFT}).best("y")
    assert best.measured == ("y''" if share < 1 else "y'")


@pytest.mark.parametrize("measured", ["y''", "y'"])
def test_runs_reach_what_is_promised(measured):
    """The deformation with the gain of the row, and the filter of offset-free control with these deviations."""
    noise = {"y''": 2.0, "y'": 2e-3}
    problem = told({measured: noise[measured]})
    row = next(r for r in fp.compare_information(problem, drift={"y": DRIFT}).rows if r.measured == measured)
    law = fp.ComputedTorque(fp.Exponential(rate=1.0))
    controllers = {
        "y''": law.with_deformation(fp.ModelReferenced(fp.Affine(gain=-2 * row.gain if measured == "y''" else -1.0))),
        "y'": fp.Estimating(law, fp.DisturbanceKalman({"y": DRIFT}, {"y'": noise["y'"], "y": 10.0})),
    }
    run = fp.simulate(problem, controllers[measured], seed=3)
    error = run["plant_realised.y"][5001:] - run["desired.y"][5000:-1]  # what is left of the residual
    assert np.sqrt(np.mean(error**2)) == pytest.approx(row.error, rel=0.1)


def test_drift_is_that_of_the_residual_along_the_reference():
    """A pendulum whose model is 40 % too heavy: the change of the residual per cycle, over the root of the cycle."""
    moving = fp.Trajectory(lambda t: {"angle": 0.5 * np.pi * t})
    problem = fp.Problem(pendulum(), moving, {"angle": 0.0}, 1e-3, 2.0)
    result = fp.compare_information(problem)
    angle = np.pi / 2 * np.arange(0, 2.0, 1e-3)
    torque = 9.81 * 0.6 * np.sin(angle) + 0.05 * np.pi
    believed = (torque - 0.05 * np.pi) / (1.4 * 0.25) - 9.81 / 0.5 * np.sin(angle)
    assert result.residual["angle"] == pytest.approx(np.sqrt(np.mean(believed**2)), rel=1e-3)
    assert result.drift["angle"] == pytest.approx(np.sqrt(np.mean(np.diff(believed) ** 2) / 1e-3), rel=1e-3)


def test_inner_states_move_while_the_outputs_follow_their_reference():
    """X' = a z + u, z' = x - 2 z along x = sin t: z = (2 sin t - cos t + exp(-2 t)) / 5, and the residual is (1 - 0.4) z."""
    plant = fp.Plant.of_states(
        states={"x": "m", "z": "m"},
        inputs={"u": "m/s"},
        parameters={"a": fp.Parameter(0.4, 1.0, "1/s")},
        rates=lambda x, u, p: {"x": p.a * x.z + u.u, "z": x.x - 2 * x.z},
        outputs={"y": fp.Output("m", lambda x, p: x.x)},
    )
    problem = fp.Problem(plant, fp.Trajectory(lambda t: {"y": ca.sin(t)}), {"x": 0.0, "z": 0.0}, 1e-3, 3.0)
    result, t = fp.compare_information(replace(problem, measure_from=1.0)), np.arange(1.0, 3.0, 1e-3)
    residual = 0.6 * (2 * np.sin(t) - np.cos(t) + np.exp(-2 * t)) / 5
    assert result.residual["y"] == pytest.approx(np.sqrt(np.mean(residual**2)), rel=2e-3)
    assert result.drift["y"] == pytest.approx(np.sqrt(np.mean(np.diff(residual) ** 2) / 1e-3), rel=2e-3)


def test_wrong_drifts_are_named():
    problem = told({"y''": 1.0})
    with pytest.raises(InvalidProblem, match="'Y' is unknown"):
        fp.compare_information(problem, drift={"Y": 1.0})
    with pytest.raises(InvalidProblem, match="positive number in units of y''"):
        fp.compare_information(problem, drift={"y": 0.0})
    with pytest.raises(InvalidProblem, match="does not drift"):
        fp.compare_information(problem)
    elsewhere = replace(problem, reality=fp.Reality(problem.plant))
    with pytest.raises(InvalidValue, match="no states of a reality; give the drift"):
        fp.compare_information(elsewhere)
    assert "y''" in str(fp.compare_information(replace(problem, period=2e-3), drift={"y": 1.0}))
