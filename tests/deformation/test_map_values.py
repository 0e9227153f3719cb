"""Every fact of the maps by value, from the published formulas and not from the code's forms of them."""

import math

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import brentq

import fpirhc as fp
from fpirhc.contracts import Deformation
from fpirhc.errors import InvalidValue


def after(deformation: Deformation, request, response, desired) -> np.ndarray:
    """The next request."""
    return np.asarray(ca.evalf(deformation.step(ca.SX(request), ca.SX(response), ca.SX(desired), {})[0]).full()).ravel()


def zeta(x, shift):
    return np.arctanh(0.5 * np.tanh(x + shift))


def root(shift: float) -> float:
    """x* = zeta(x*)."""
    return float(brentq(lambda x: zeta(x, shift) - x, -5.0, 5.0, xtol=1e-15))


def test_affine():
    """r+ = r + A_c / 2 (f - d)."""
    one = fp.Affine(gain=-0.8)
    assert after(one, [1.0, 2.0], [3.0, 5.0], [2.0, 1.0]) == pytest.approx([1.0 - 0.4 * 1.0, 2.0 - 0.4 * 4.0])
    assert (one.effective_gain(), one.secant_gain()) == (0.4, 0.4)
    assert one.with_effective_gain(0.3) == fp.Affine(gain=-0.6)


def test_filtered():
    """g+ = p g + (1 - p) (f - d) and r+ = r + A_c / 2 g+."""
    error, r, f, d = np.array([4.0, -2.0]), [1.0, 2.0], [3.0, 5.0], [2.0, 1.0]
    memory = {"filter_error": ca.SX(error)}
    for _ in range(2):
        request, memory = fp.Filtered(fp.Affine(gain=-0.8), pole=0.7).step(ca.SX(r), ca.SX(f), ca.SX(d), memory)
        error = 0.7 * error + 0.3 * np.subtract(f, d)
        assert np.asarray(ca.evalf(request)).ravel() == pytest.approx(np.array(r) - 0.4 * error)


@pytest.mark.parametrize(("offset", "sign"), [(50.5, -1), (-50.5, 1), (50.5, 1)])
def test_robust_fixed_point_transformation(offset, sign):
    """r+ = (K_c + r) [1 + B_c tanh(A_c (f - d))] - K_c, and A = -K_c B_c A_c."""
    one = fp.RFPT(offset=offset, sign=sign, gain=0.01)
    r, f, d = np.array([1.0, 2.0]), np.array([3.0, 50.0]), np.array([2.0, 10.0])
    assert after(one, r, f, d) == pytest.approx((offset + r) * (1 + sign * np.tanh(0.01 * (f - d))) - offset, rel=1e-12)
    effective = -offset * sign * 0.01
    assert (one.effective_gain(), one.secant_gain()) == (effective, effective)
    other = one.with_effective_gain(0.2)
    assert (other.offset, other.sign) == (offset, sign)
    assert other.gain == pytest.approx(-0.2 / (offset * sign))
    assert other.effective_gain() == pytest.approx(0.2)


@pytest.mark.parametrize(("offset", "sign"), [(50.0, -1), (-50.0, 1)])
def test_robust_fixed_point_transformation_of_a_vector(offset, sign):
    """r+ = (1 + B) r + B K_c h / |h| with B = B_c tanh(A_c |h|); nothing moves where f = d."""
    one = fp.RFPTVector(offset=offset, sign=sign, gain=0.01)
    r, f, d = np.array([1.0, 2.0]), np.array([3.0, 50.0]), np.array([2.0, 10.0])
    size = np.linalg.norm(f - d)
    share = sign * np.tanh(0.01 * size)
    assert after(one, r, f, d) == pytest.approx((1 + share) * r + share * offset * (f - d) / size, rel=1e-6)
    assert after(one, r, d, d) == pytest.approx(r, abs=0)


@pytest.mark.parametrize("kind", [fp.RFPT, fp.RFPTVector])
def test_settings_of_the_robust_transformation(kind):
    """A sign is -1 or 1; offset and gain are not zero."""
    for wrong in ({"sign": 0}, {"sign": 2}, {"sign": -2}, {"offset": 0.0}, {"gain": 0.0}, {"gain": math.nan}):
        with pytest.raises(InvalidValue, match="expected"):
            kind(**{"offset": 10.0, "sign": -1, "gain": 0.1, **wrong})


@pytest.mark.parametrize(
    ("gain", "shift"), [(-0.5, 0.3), (0.5, 0.3), (0.5, -0.3), (-1.5, 0.0), (-0.7, 1.2), (-0.4, -0.8)]
)
def test_sigmoid(gain, shift):
    """r+ = r + S [zeta(A_c |h| / S + x*) - x*] h / |h|, x* found by bisection."""
    one, fixed, scale = fp.Sigmoid(gain=gain, shift=shift, scale=4.0), root(shift), 4.0
    slope = (zeta(fixed + 1e-6, shift) - zeta(fixed - 1e-6, shift)) / 2e-6
    assert one.fixed_point == pytest.approx(fixed, abs=1e-12)
    assert one.slope == pytest.approx(slope, rel=1e-8)
    for h in ([3.0, 4.0], [0.03, -0.04], [30.0, 0.0]):
        size = np.linalg.norm(h)
        move = scale * (zeta(gain * size / scale + fixed, shift) - fixed) * np.array(h) / size
        assert after(one, [1.0, 2.0], np.array(h) + 0.5, [0.5, 0.5]) == pytest.approx(
            [1.0 + move[0], 2.0 + move[1]], rel=1e-9
        )
    assert one.effective_gain() == pytest.approx(-gain * slope, rel=1e-8)
    side = np.sign(gain) * np.linspace(1e-3, 20.0, 200001)
    secants = (zeta(side + fixed, shift) - fixed) / side
    assert one.steepest_secant == pytest.approx(max(secants.max(), slope), rel=1e-6)
    assert one.secant_gain() == pytest.approx(-gain * one.steepest_secant)
    assert one.largest_step() == pytest.approx(scale * abs(zeta(np.sign(gain) * 20.0, shift) - fixed), rel=1e-9)
    assert one.with_effective_gain(0.25).effective_gain() == pytest.approx(0.25)


@pytest.mark.parametrize("shift", [-5.1, 5.1])
def test_a_shift_beyond_which_nothing_moves_is_refused(shift):
    assert fp.Sigmoid(gain=-1.0, shift=math.copysign(5.0, shift)).slope < 2e-4
    with pytest.raises(InvalidValue, match="from -5 to 5"):
        fp.Sigmoid(gain=-1.0, shift=shift)


@pytest.mark.parametrize("fraction", [0.4, 1.0, -0.7])
@pytest.mark.parametrize(("scale", "longest"), [(1.0, 0), (20.0, 0), (20.0, 1), (20.0, 2)])
def test_rotation(fraction, scale, longest):
    """The request, with its dummy component, is turned by a fraction of the angle from f to d in their plane; R outgrows them."""
    r, f, d = scale * np.roll([[3.0, 1.0], [1.0, -2.0], [2.0, 2.0]], longest, axis=0)
    radius = max(10.0, 2 * float(np.linalg.norm([r, f, d], axis=1).max()))
    request, start, end = (np.append(v, math.sqrt(radius**2 - v @ v)) for v in (r, f, d))
    first = start / radius
    second = end / radius - (end @ first / radius) * first
    second /= np.linalg.norm(second)
    angle = fraction * math.acos(end @ start / radius**2)
    x, y = request @ first, request @ second
    turned = request + (x * math.cos(angle) - y * math.sin(angle) - x) * first
    turned += (x * math.sin(angle) + y * math.cos(angle) - y) * second
    one = fp.Rotation(fraction=fraction, radius=10.0)
    assert after(one, r, f, d) == pytest.approx(turned[:2], rel=1e-9)
    assert after(one, r, d, d) == pytest.approx(r, rel=1e-12)


def test_facts_of_the_rotation():
    """The gain is the fraction; the longest arc over its chord of vectors up to R / 2 is 2 pi / (3 sqrt 3)."""
    one = fp.Rotation(fraction=0.4, radius=10.0)
    assert one.effective_gain() == 0.4
    assert one.secant_gain() == pytest.approx(0.4 * 2 * math.pi / (3 * math.sqrt(3)))
    for wrong in ({"fraction": 0.0}, {"radius": 0.0}, {"radius": -1.0}, {"radius": math.inf}):
        with pytest.raises(InvalidValue, match="expected"):
            fp.Rotation(**{"fraction": 0.4, "radius": 1.0, **wrong})
