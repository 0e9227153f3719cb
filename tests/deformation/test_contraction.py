"""Contraction analysis: Jacobian, spectra, limits, verdicts, and the factor seen in a run."""

from __future__ import annotations

import math
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fpirhc import RFPT, Affine, Identity, Parameter, Plant, RFPTVector, Rotation, Sigmoid
from fpirhc.contraction.spectrum import (
    Spectrum,
    assess_gain,
    check_gain,
    identified_factor,
    linear_limit,
    predicted_factor,
    response_jacobian,
    spectrum_over_box,
    spectrum_over_run,
)
from fpirhc.contracts import Deformation
from fpirhc.errors import InvalidName, InvalidShape, InvalidValue, NotContractive

MAPS = (
    Affine(gain=-0.5),
    RFPT(offset=1e5, sign=-1, gain=5e-6),
    RFPTVector(offset=1e5, sign=-1, gain=5e-6),
    Sigmoid(gain=-0.5, scale=1e4),
    Rotation(fraction=0.4, radius=1e4),
)
GAINS = st.lists(st.floats(0.1, 10.0), min_size=1, max_size=4)


def name_of(deformation: Deformation) -> str:
    return type(deformation).__name__


def masses() -> Plant:
    """Two masses coupled by a damper and a spring; J = diag(believed mass / mass)."""

    def response(q, v, u, p):
        spring = p.k * (q.q2 - q.q1)
        return {"q1": (u.Q1 + spring - p.b * v.q1) / p.m1, "q2": (u.Q2 - spring - p.b * v.q2) / p.m2}

    return Plant(
        coordinates={"q1": "m", "q2": "m"},
        inputs={"Q1": "N", "Q2": "N"},
        parameters={
            "m1": Parameter(approximate=1.5, exact=1.0, unit="kg"),
            "m2": Parameter(approximate=2.6, exact=2.0, unit="kg"),
            "k": Parameter(approximate=90.0, exact=100.0, unit="N/m"),
            "b": Parameter(approximate=1.0, exact=0.5, unit="N s/m"),
        },
        response=response,
    )


def cubic() -> Plant:
    """A plant whose response is not affine in its input, so that its inverse is found by Newton's method."""
    return Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        parameters={"m": Parameter(approximate=1.5, exact=1.0, unit="kg")},
        response=lambda q, _, u, p: {"y": (u.u + 0.1 * u.u**3) / p.m - q.y},
    )


def simulate(
    deformation: Deformation, jacobian: np.ndarray, cycles: int, drift: float
) -> tuple[np.ndarray, np.ndarray]:
    """(deformed, realised) as a loop logs them: realised[k] answers deformed[k - 1], and the bias swings by `drift`."""
    n = len(jacobian)
    r, f, d = symbols = [ca.SX.sym(s, n) for s in ("r", "f", "d")]
    step = ca.Function("step", symbols, [deformation.step(r, f, d, {})[0]])
    desired = np.linspace(1.0, 2.0, n)
    deformed, realised = [desired], [np.zeros(n)]
    for k in range(cycles):
        bias = np.linspace(3.0, -2.0, n) + drift * np.sin(0.01 * k)
        realised.append(jacobian @ deformed[-1] + bias)
        deformed.append(np.asarray(step(deformed[-1], realised[-1], desired).full())[:, 0])
    return np.array(deformed), np.array(realised)


def test_jacobian_of_masses() -> None:
    """J = M^-1 times the believed M: springs and dampers, right or wrong, play no part."""
    plant = masses()
    jacobian = response_jacobian(plant)([1.0, 2.0, 3.0, 4.0], [5.0, 6.0], plant.exact, plant.approximate)
    assert jacobian.full() == pytest.approx(np.diag([1.5, 1.3]), rel=1e-12)


def test_jacobian_of_a_right_model_is_the_identity() -> None:
    """With equal parameters the plant does what it is asked, also when the inverse is found numerically."""
    for plant in (masses(), cubic()):
        n = len(plant.names)
        jacobian = response_jacobian(plant)(np.full(plant.state.size, 0.3), np.full(n, 0.7), plant.exact, plant.exact)
        assert jacobian.full() == pytest.approx(np.eye(n), abs=1e-7)


def test_jacobian_through_a_root_finder() -> None:
    """The derivative of a numerically found inverse is exact, by the implicit function theorem."""
    plant = cubic()
    function = response_jacobian(plant)
    jacobian = float(function([0.3, 0.0], 0.7, plant.exact, plant.approximate))
    assert jacobian == pytest.approx(1.5, rel=1e-6)


def test_spectrum_over_run() -> None:
    """Eigenvalues along a run; cycles that are not finite are left out, an all-bad run is refused."""
    plant = masses()
    states, deformed = np.zeros((5000, 4)), np.zeros((5000, 2))
    states[7] = np.nan
    spectrum = spectrum_over_run(plant, states, deformed)
    assert spectrum.smallest_real == pytest.approx(1.3)
    assert spectrum.largest_real == pytest.approx(1.5)
    assert spectrum.one_sign
    right = spectrum_over_run(plant, states, deformed, approximate=plant.exact)
    assert right.largest_real == pytest.approx(1.0)
    with pytest.raises(InvalidValue, match="no finite eigenvalue"):
        Spectrum(np.full((3, 2), np.nan))


def test_spectrum_over_box_reaches_the_corners() -> None:
    """The extremes of a box sit at its corners, so these are always sampled."""
    plant = masses()
    box = {"m1": (0.5, 3.0), "m2": (1.3, 2.6)}
    spectrum = spectrum_over_box(plant, box, np.zeros(4), np.zeros(2), samples=16, seed=3)
    assert spectrum.smallest_real == pytest.approx(0.5)
    assert spectrum.largest_real == pytest.approx(3.0)
    again = spectrum_over_box(plant, box, np.zeros(4), np.zeros(2), samples=16, seed=3)
    assert np.array_equal(spectrum.eigenvalues, again.eigenvalues)


def test_bad_arguments_raise() -> None:
    """Misspelt parameters, swapped ends and arrays of the wrong width are named."""
    plant, state, request = masses(), np.zeros(4), np.zeros(2)
    with pytest.raises(InvalidName, match="'m1'"):
        spectrum_over_box(plant, {"m_1": (1.0, 2.0)}, state, request, samples=4, seed=0)
    with pytest.raises(InvalidValue, match="lower <= upper"):
        spectrum_over_box(plant, {"m1": (2.0, 1.0)}, state, request, samples=4, seed=0)
    with pytest.raises(InvalidValue, match=r"samples: .* got 0"):
        spectrum_over_box(plant, {"m1": (1.0, 2.0)}, state, request, samples=0, seed=0)
    with pytest.raises(InvalidShape, match=r"\(cycles, 4\)"):
        spectrum_over_run(plant, np.zeros((3, 2)), np.zeros((3, 2)))
    with pytest.raises(InvalidShape, match="the same"):
        identified_factor(np.zeros((5, 2)), np.zeros((4, 2)), 0.5)


@settings(deadline=None, derandomize=True, max_examples=50)
@given(GAINS)
def test_linear_limit_is_where_the_factor_is_one(eigenvalues: list[float]) -> None:
    """Inside the limit the predicted factor is below 1, at it exactly 1; mirrored for negative eigenvalues."""
    spectrum = np.array([eigenvalues])
    lower, upper = linear_limit(spectrum)
    assert lower == 0.0
    assert upper == pytest.approx(2 / max(eigenvalues))
    assert predicted_factor(spectrum, upper) == pytest.approx(1.0)
    assert predicted_factor(spectrum, 0.5 * upper) < 1.0
    assert linear_limit(-spectrum) == pytest.approx((-upper, 0.0))


def test_known_limits_of_the_sigmoid() -> None:
    """J = diag(1.5, 1.3): |A_c| < 3.36 for small errors, < 2.82 for all, factor 0.7421 at -0.5."""
    report = check_gain(Sigmoid(gain=-0.5), Spectrum(np.array([[1.5, 1.3]])))
    assert report.predicted == pytest.approx(0.74212, abs=1e-5)
    assert report.own_linear_limit == pytest.approx((-3.3607, 0.0), abs=1e-3)
    assert report.own_sector_limit == pytest.approx((-2.8210, 0.0), abs=1e-3)
    assert report.within_sector
    assert "below 2.82 to converge from errors of any size" in report.text


def test_between_sector_and_linear_limit_is_a_warning() -> None:
    """Small errors converge there, so the gain is reported, not refused."""
    report = check_gain(Sigmoid(gain=-2.9), Spectrum(np.array([[1.5, 1.3]])))
    assert not report.within_sector
    assert report.contractive
    assert "oscillation" in report.text
    assert report.predicted < 1


@pytest.mark.parametrize("deformation", MAPS, ids=name_of)
def test_wrong_sign_says_which_is_right(deformation: Deformation) -> None:
    """A gain of the wrong sign diverges at once; the message gives sign and limits in the map's own gain."""
    wrong = deformation.with_effective_gain(-0.2)
    own = getattr(deformation, deformation.gain_name)
    sign = "negative" if own < 0 else "positive"
    with pytest.raises(NotContractive, match=rf"wrong sign.*use a {sign} {deformation.gain_name}, 0 < "):
        check_gain(wrong, Spectrum(np.array([[1.5, 1.3]])))
    with pytest.raises(NotContractive, match="wrong sign"):
        check_gain(deformation, Spectrum(np.array([[-1.5, -1.3]])))


def test_wrong_sign_in_words() -> None:
    with pytest.raises(NotContractive) as caught:
        check_gain(Sigmoid(gain=0.5), Spectrum(np.array([[1.5, 1.3]])))
    assert str(caught.value) == (
        "Sigmoid(gain=0.5) has the wrong sign, so every cycle enlarges the error; use a negative gain, "
        "0 < |gain| < 3.36, and below 2.82 to converge from errors of any size"
    )


@pytest.mark.parametrize("eigenvalues", [[1.0, -0.5], [1.0, 0.0], [0.3j, -0.3j]])
def test_both_signs_cannot_be_cured_by_a_gain(eigenvalues: list[complex]) -> None:
    """Real parts of both signs, or zero: say so and what to check, instead of advising a gain."""
    spectrum = Spectrum(np.array([eigenvalues]))
    assert not spectrum.one_sign
    for raises in (lambda: check_gain(Sigmoid(gain=-0.5), spectrum), lambda: linear_limit(spectrum.eigenvalues)):
        with pytest.raises(NotContractive, match=r"no gain makes the iteration converge.*Check that each input"):
            raises()
    report = assess_gain(Sigmoid(gain=-0.5), spectrum)
    assert not report.contractive


def test_too_large_and_no_gain() -> None:
    """Beyond the linear limit errors grow; a map that does not iterate is no candidate."""
    with pytest.raises(NotContractive, match=r"grow by the factor 1\.38 per cycle; use a negative gain"):
        check_gain(Sigmoid(gain=-4.0), Spectrum(np.array([[1.5, 1.3]])))
    with pytest.raises(NotContractive, match="does not iterate"):
        check_gain(Identity(), Spectrum(np.array([[1.5, 1.3]])))
    assert assess_gain(Identity(), Spectrum(np.array([[1.5, 1.3]]))).predicted == 1.0


@pytest.mark.parametrize("deformation", MAPS, ids=name_of)
@pytest.mark.parametrize("effective", [0.2, 0.5, 1.2])
def test_identified_factor_equals_prediction(deformation: Deformation, effective: float) -> None:
    """On a linear plant the factor identified from the log is the predicted one to 1e-3, for every map."""
    jacobian = np.array([[1.5, 0.2], [0.1, 1.3]])
    changed = deformation.with_effective_gain(effective)
    deformed, realised = simulate(changed, jacobian, 300, drift=0.0)
    predicted = predicted_factor(np.linalg.eigvals(jacobian), effective)
    assert identified_factor(deformed, realised, effective) == pytest.approx(predicted, abs=1e-3)


def test_identified_factor_with_drift() -> None:
    """A slowly moving fixed point, which the request follows for most of the run, spoils the estimate little."""
    jacobian = np.array([[1.5, 0.2], [0.1, 1.3]])
    deformed, realised = simulate(Affine(gain=-0.4), jacobian, 5000, drift=1.0)
    predicted = predicted_factor(np.linalg.eigvals(jacobian), 0.2)
    assert identified_factor(deformed, realised, 0.2) == pytest.approx(predicted, abs=0.02)


def test_identified_factor_needs_excitation() -> None:
    """A run at rest, one along a single direction, and one too short say NaN, not a number."""
    along = np.outer(0.7 ** np.arange(50), [1.0, 2.0])
    assert math.isnan(identified_factor(np.zeros((50, 2)), np.zeros((50, 2)), 0.5))
    assert math.isnan(identified_factor(along, along, 0.5))
    assert math.isnan(identified_factor(along[:3], along[:3], 0.5))
    assert math.isnan(identified_factor(along[:0], along[:0], 0.5))


def test_contraction_along_a_run_is_logged_per_cycle():
    """The signal is the predicted factor at each cycle's own state and request: constant on two_mass, 1 - a lambda_min."""
    import fpirhc as fp

    task: Any = fp.load_problem("two_mass")
    run = fp.simulate(task.problem, task.controllers["CTC+FPI (eq 6)"], seed=0)
    assert run["contraction"].shape == (run.cycles, 1)
    gain = task.controllers["CTC+FPI (eq 6)"].deformation.effective_gain()
    np.testing.assert_allclose(run["contraction"], 1 - gain * 1.3, rtol=1e-9)
    assert "contraction" not in fp.simulate(task.problem, task.controllers["CTC"], seed=0).layout
