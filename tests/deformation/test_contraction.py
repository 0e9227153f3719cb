"""Contraction as a run shows it: which gains are refused and with what advice, and the predicted and the measured factor."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.errors import NotContractive

MAPS = {
    "Affine": fp.Affine(gain=-0.5),
    "RFPT": fp.RFPT(offset=1e5, sign=-1, gain=5e-6),
    "RFPTVector": fp.RFPTVector(offset=1e5, sign=-1, gain=5e-6),
    "Sigmoid": fp.Sigmoid(gain=-0.5, scale=1e4),
    "Rotation": fp.Rotation(fraction=0.4, radius=1e4),
}


def masses(jacobian) -> fp.Problem:
    """Q'' = J u with a model that believes q'' = u: the response Jacobian is J, springs and dampers play no part."""
    size = len(jacobian)
    names, inputs = [f"q{k}" for k in range(size)], [f"u{k}" for k in range(size)]
    entries = {f"b{i}{j}": fp.Parameter(float(i == j), float(jacobian[i][j]), "1") for i, j in np.ndindex(size, size)}

    def response(q, v, u, p):
        own = {f"q{i}": sum(p[f"b{i}{j}"] * u[f"u{j}"] for j in range(size)) for i in range(size)}
        return {n: own[n] - 2.0 * q[n] - 0.3 * v[n] for n in names}

    plant = fp.Plant(dict.fromkeys(names, "m"), dict.fromkeys(inputs, "N"), entries, response)
    wave = fp.Trajectory(lambda t: {n: ca.sin((2 + k) * t) for k, n in enumerate(names)})
    return fp.Problem(plant, wave, dict.fromkeys(names, 0.0), period=2e-3, duration=2.0, measure_from=0.5)


def run(jacobian, deformation, **settings):
    controller = fp.ComputedTorque(fp.Exponential(rate=4.0), deformation)
    return fp.simulate(replace(masses(jacobian), **settings), controller, seed=0, compiled=False)


PAIR = [[1.5, 0.2], [0.1, 1.3]]


@pytest.mark.parametrize("map", MAPS.values(), ids=MAPS)
@pytest.mark.parametrize("gain", [0.2, 0.5, 1.2])
def test_the_measured_factor_is_the_predicted_one(map, gain):
    """Max |1 - a lambda| over the eigenvalues of J; from the run alone within a hundredth."""
    one = run(PAIR, map.with_effective_gain(gain))
    predicted = np.abs(1 - gain * np.linalg.eigvals(PAIR)).max()
    metrics = fp.measure(masses(PAIR), one)
    assert metrics["contraction.predicted"][""] == pytest.approx(predicted, rel=1e-6)
    assert metrics["contraction.measured"][""] == pytest.approx(predicted, abs=0.02)
    assert fp.measure(masses(PAIR), run(PAIR, fp.Identity(), duration=0.6))["contraction.predicted"] == {}


@pytest.mark.parametrize("map", MAPS.values(), ids=MAPS)
def test_a_gain_is_refused_exactly_beyond_its_limit(map):
    """A little below 2 / lambda it runs, a little above it is refused, and so is the other sign, with the right one named."""
    largest = 2 / np.linalg.eigvals(PAIR).real.max()
    run(PAIR, map.with_effective_gain(0.99 * largest), duration=0.6)
    with pytest.raises(NotContractive, match=r"is too large; use 0 < \|"):
        run(PAIR, map.with_effective_gain(1.01 * largest), duration=0.6)
    name = "fraction" if isinstance(map, fp.Rotation) else "gain"
    sign = "negative" if getattr(map, name) < 0 else "positive"
    with pytest.raises(NotContractive, match=rf"wrong sign.*use a {sign} {name}, 0 < "):
        run(PAIR, map.with_effective_gain(-0.2), duration=0.6)
    against = (-np.array(PAIR)).tolist()
    with pytest.raises(NotContractive, match=r"^\S+ .*differ in sign: .*; give the model the plant's sign"):
        run(against, map, duration=0.6)
    with pytest.raises(NotContractive, match="opposite to that of its model: mend the sign in the model"):
        run(PAIR, map, duration=0.6, reality=fp.Reality(masses(against).plant))


@pytest.mark.parametrize("jacobian", [[[1.0, 0.0], [0.0, -0.5]], [[0.0, 0.3], [-0.3, 0.0]]])
def test_both_signs_cannot_be_cured_by_a_gain(jacobian):
    """Real parts of both signs, or zero: say so and what to check, instead of advising a gain."""
    with pytest.raises(NotContractive, match=r"no gain makes the iteration converge.*Check that each input"):
        run(jacobian, MAPS["Affine"], duration=0.6)


# A gain matrix and coupled responses

GAINS = [[0.8, 0.3], [-0.5, 0.4]]


def test_the_inverse_of_the_gains_is_deadbeat():
    """With A_c = -2 and W the inverse of the gains an error is gone after one cycle; one number for both leaves more."""
    start = {"q0": 0.0, "q1": 0.0, "q0'": 2.0, "q1'": 3.0}  # on the reference
    settings = {"period": 1e-2, "duration": 3.0, "measure_from": 1.0, "start": start}

    def found(form):
        return fp.measure(replace(masses(GAINS), **settings), run(GAINS, form, **settings))

    inverse = tuple(map(tuple, np.linalg.inv(GAINS).round(3).tolist()))
    weighted, *others = (
        found(one) for one in (fp.Affine(-2.0, inverse), *(fp.Affine(g) for g in (-0.8, -1.6, -2.4, -2.8)))
    )
    errors = [np.linalg.norm([*one.rms_error.values()]) for one in (weighted, *others)]
    assert errors[0] < 0.75 * min(errors[1:])
    assert weighted["contraction.predicted"][""] < 2e-3
    assert weighted["contraction.measured"][""] < 0.1


def test_a_gain_that_converges_with_its_weights_alone_is_not_refused():
    """The limit is that of the eigenvalues of J W: a sign turned by the weights is right, and refused without them."""
    assert run(GAINS, fp.Affine(gain=0.5, weights=(-1.0, -1.0)), duration=0.6).stop is None
    with pytest.raises(NotContractive, match="wrong sign"):
        run(GAINS, fp.Affine(gain=0.5), duration=0.6)
    with pytest.raises(NotContractive, match=r"use 0 < \|gain\| < 0\.559, where"):
        run(GAINS, fp.Affine(gain=-0.9, weights=(1.0, 19.0)), duration=0.6)
