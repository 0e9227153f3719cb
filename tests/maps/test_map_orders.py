"""Relative orders above one in the steps of a map: what is measured, what the model must predict, and when a pair is complete."""

from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.errors import FpirhcError

T = 10.0  # s, one step


def chain(order: int, wrong: float = 1.0) -> fp.Plant:
    """x1+ = x2, ..., xr+ = a x1 + xr^2 / 10 + b u, controlled at x1; the model's a and b are `wrong` times the plant's."""
    names = [f"x{k}" for k in range(1, order + 1)]

    def shifted(x: Any, u: Any, p: Any) -> dict[str, Any]:
        last = p.a * x.x1 + 0.1 * x[names[-1]] ** 2 + p.b * u.u
        return {**{n: x[m] for n, m in pairwise(names)}, names[-1]: last}

    return fp.Plant.discrete(
        states=dict.fromkeys(names, "m"),
        inputs={"u": "N"},
        parameters={"a": fp.Parameter(0.4 * wrong, 0.4, "1"), "b": fp.Parameter(2.0 * wrong, 2.0, "1")},
        next=shifted,
        step=T,
        outputs={"y": fp.Output("m", lambda x, p: x.x1)},
    )


def task(plant: fp.Plant, **changes: Any) -> fp.Problem:
    """The output follows a slow wave."""
    arguments: dict[str, Any] = {
        "plant": plant,
        "reference": fp.Trajectory(lambda t: {"y": ca.sin(3e-3 * t)}),
        "start": {name: 0.1 * k for k, name in enumerate(plant.names, 1)},
        "period": T,
        "duration": 3000.0,
        "measure_from": 1500.0,
    }
    return fp.Problem(**{**arguments, **changes})


def error_of(problem: fp.Problem, controller: Any) -> np.ndarray:
    """Errors of a run in the virtual machine."""
    run = fp.simulate(problem, controller, seed=0, compiled=False)
    assert run["status"].max() == 0
    return np.asarray(run["true_error"][:, 0])


@pytest.mark.parametrize("order", [1, 2, 3])
def test_with_the_exact_model_it_is_deadbeat_in_r_steps(order: int) -> None:
    for law in (fp.Exponential(rate=1 / T, integral=False), fp.ShiftPolynomial(0.0, step=T, integral=False)):
        error = error_of(task(chain(order), duration=200.0, measure_from=0.0), fp.ComputedTorque(law))
        assert np.abs(error[order:]).max() < 1e-14
        assert np.abs(error[order - 1]) > 1e-3


@pytest.mark.parametrize("poles", [(0.5, 0.2, -0.3), (0.6 + 0.2j, 0.6 - 0.2j, 0.0)])
def test_the_poles_of_the_run_are_those_of_the_polynomial(poles: tuple[complex, ...]) -> None:
    """The errors of the run satisfy (z - z_1) (z - z_2) (z - z_3) e = 0, which is a recursion."""
    law = fp.ShiftPolynomial(poles, step=T, bumpless=False)
    error = error_of(task(chain(2), duration=300.0, measure_from=0.0), fp.ComputedTorque(law))
    a = np.real(np.poly(poles))
    windows = np.lib.stride_tricks.sliding_window_view(error, 4)
    assert np.abs(windows @ a[::-1]).max() < 1e-14
    assert np.abs(error).max() > 0.05


@pytest.mark.parametrize("order", [1, 2, 3])
def test_with_the_exact_model_no_deformation_arises(order: int) -> None:
    controller = fp.ComputedTorque(fp.Exponential(rate=0.04), fp.ModelReferenced(fp.Affine(gain=-1.0)))
    run = fp.simulate(task(chain(order), duration=600.0, measure_from=0.0), controller, seed=0, compiled=False)
    assert np.abs(run["deformed"] - run["desired"]).max() < 1e-16


def test_a_pair_is_complete_before_it_is_used() -> None:
    """The first r requests are the desired responses: no response to a request of this run is measured before cycle r."""
    run = fp.simulate(
        task(chain(3, 1.3), duration=300.0, measure_from=0.0),
        fp.ComputedTorque(fp.Exponential(rate=0.04), fp.ModelReferenced(fp.Affine(gain=-1.0))),
        seed=0,
        compiled=False,
    )
    apart = np.abs(run["deformed"] - run["desired"])[:, 0]
    assert apart[:3].max() == 0
    assert apart[3:6].max() > 0


def by_hand(cycles: int) -> np.ndarray:
    """Outputs of computed torque for order two with a wrong model, in shifts: no divided difference appears."""
    (a, b), (am, bm), z = (0.4, 2.0), (0.52, 2.6), 0.6
    x, outputs, expected = np.array([0.1, 0.2]), [], 0.0
    reference = np.sin(3e-3 * T * np.arange(cycles + 2))
    for k in range(cycles):
        # The next output: the model's x2, with the error of the last prediction of this output.
        ahead = x[1] + (x[0] - expected if k else 0.0)
        expected = x[1]
        wanted = reference[k + 2] + 2 * z * (ahead - reference[k + 1]) - z**2 * (x[0] - reference[k])
        # The divided difference that is asked for is that of the predicted output; the model makes it from its own.
        u = (wanted - ahead + x[1] + (x[1] - ahead) - am * x[0] - 0.1 * x[1] ** 2) / bm
        outputs.append(x[0])
        x = np.array([x[1], a * x[0] + 0.1 * x[1] ** 2 + b * u])
    return np.array(outputs)


def test_order_two_is_the_loop_by_hand_in_shifts() -> None:
    problem = task(chain(2, 1.3), duration=400.0, measure_from=0.0)
    law = fp.ShiftPolynomial(0.6, step=T * (1 + 1e-15), integral=False)  # rounding is no other cycle
    run = fp.simulate(problem, fp.ComputedTorque(law), seed=0, compiled=False)
    assert np.abs(run["plant_output.y"] - by_hand(40)).max() < 1e-13


BAD = {
    "rate": (
        lambda: fp.Exponential(rate=0.2),
        r"has the pole z = -1 and does not decay; use a rate below 0.2 1/s \(0.1 is deadbeat\)",
    ),
    "step": (lambda: fp.ShiftPolynomial(0.5, step=1.0), r"the control cycle is 10 s, .* write step=10"),
    "number": (
        lambda: fp.ShiftPolynomial((0.5, 0.2), step=T),
        r"2 poles are given, .* relative order 2 has 3 modes with the sum",
    ),
    "outside": (lambda: fp.ShiftPolynomial(1.0, step=T), r"1 is not inside the unit circle"),
    "conjugate": (lambda: fp.ShiftPolynomial((0.5 + 0.1j,), step=T), "with its conjugate"),
    "fractional": (lambda: fp.Fractional(rate=0.2, order=0.8), r"has the pole z = -1 and does not decay"),
}


@pytest.mark.parametrize("what", BAD)
def test_poles_that_do_not_fit_are_refused(what: str) -> None:
    make, message = BAD[what]
    with pytest.raises(FpirhcError, match=message):
        fp.simulate(task(chain(2)), fp.ComputedTorque(make()), seed=0, compiled=False)


def test_a_filter_of_late_responses_is_the_recursion_by_hand() -> None:
    """The response of order 2 is that of two cycles ago, to the state and the command of then; the disturbance is found."""
    filtering = fp.DisturbanceKalman({"x2": 0.02}, {"x1": 1e-2, "x2": 1e-2, "y''": 1e-4})
    plant = chain(2)
    problem = task(plant, duration=600.0, measure_from=0.0, disturbances={"x2": fp.Step(0.0, 0.005)})
    run = fp.simulate(
        problem, fp.Estimating(fp.ComputedTorque(fp.Exponential(rate=0.3 / T)), filtering), seed=0, compiled=False
    )
    modelled = fp.Estimating(fp.ComputedTorque(fp.Exponential(rate=0.3 / T)), filtering).inner_problem(problem)
    gain = filtering.gain(modelled)

    def after(x: np.ndarray, u: float, w: float) -> np.ndarray:
        return np.array([x[1], 0.4 * x[0] + 0.1 * x[1] ** 2 + 2.0 * u + T * w])

    def response(x: np.ndarray, u: float, w: float) -> float:
        later = after(x, u, w)
        return float((after(later, u, w)[0] - 2 * later[0] + x[0]) / T**2)

    state, disturbance, estimates = run["state"][0], 0.0, [0.0, 0.0]
    for k in range(2, run.cycles):
        x, u = run["state"][k - 2], float(run["command"][k - 2, 0])
        missing = np.append(x - state, run["realised"][k, 0] - response(state, u, disturbance))
        step = gain @ missing
        state, disturbance = state + step[:2], disturbance + float(step[2])
        estimates.append(disturbance)
        state = after(state, u, disturbance)
    np.testing.assert_allclose(run["estimate"][:, 0], estimates, atol=1e-12)
    assert run["estimate"][-1, 0] == pytest.approx(0.005, rel=1e-3)
