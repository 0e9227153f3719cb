"""Every fact of the maps by value, from the published formulas and not from the code's forms of them."""

import math
from decimal import Decimal, getcontext
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import brentq

import fpirhc as fp
from fpirhc.conformance import check_deformation, examples
from fpirhc.contracts import Deformation
from fpirhc.errors import InvalidValue, NotSupported


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


@pytest.mark.parametrize("weights", [(1.0, 1.0), (2.0, 0.5), ((1.0, 0.2), (-0.3, 2.0))])
def test_weights(weights):
    """r+ = r + A_c / 2 W (f - d), also where W is given by its diagonal."""
    matrix = np.array(weights) if isinstance(weights[0], tuple) else np.diag(weights)
    r, f, d = np.array([1.0, 2.0]), np.array([0.3, -0.7]), np.array([0.1, 0.5])
    one = fp.Affine(gain=-0.6, weights=weights)
    assert after(one, r, f, d) == pytest.approx(r - 0.3 * matrix @ (f - d), abs=1e-15)


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


# Laws

MAPS = examples("deformations", fp.Affine(gain=-0.5))
ITERATING = tuple(m for m in MAPS if m.effective_gain() != 0)


@pytest.mark.parametrize("elements", [("q1",), ("q1", "q2", "q3")], ids=len)
@pytest.mark.parametrize("deformation", ITERATING, ids=repr)
def test_conformance(deformation, elements):
    """Every map keeps the public laws, for one coordinate and for several."""
    check_deformation(deformation, elements=elements, seed=1)


def test_identity_asks_for_what_is_desired():
    assert after(fp.Identity(), [1.0, 2.0], [np.nan, 7.0], [3.0, 4.0]).tolist() == [3.0, 4.0]
    with pytest.raises(NotSupported, match="Sigmoid"):
        fp.Identity().with_effective_gain(0.5)


def test_scale_must_be_chosen():
    """A sigmoid without scale has no step; the message says how to give it one."""
    open_scale = fp.Sigmoid(gain=-0.5)
    with pytest.raises(InvalidValue, match=r"give Sigmoid\(scale=S\)"):
        open_scale.step(ca.SX.sym("r"), ca.SX.sym("f"), ca.SX.sym("d"), {})
    with pytest.raises(InvalidValue, match="scale"):
        open_scale.largest_step()
    assert open_scale.effective_gain() == fp.Sigmoid(gain=-0.5, scale=3.0).effective_gain()


def exact_sigmoid_step(gain: float, shift: float, size: float) -> float:
    """zeta(gain size + x*) - x* as printed, in 60 digits, so that cancellation does no harm."""
    getcontext().prec = 60

    def tanh(x: Decimal) -> Decimal:
        e = (2 * x).exp()
        return (e - 1) / (e + 1)

    def atanh(y: Decimal) -> Decimal:
        return ((1 + y) / (1 - y)).ln() / 2

    t = tanh(Decimal(shift))
    fixed = atanh(((1 + 8 * t * t).sqrt() - 1) / (4 * t))
    return float(atanh(tanh(Decimal(gain) * Decimal(size) + fixed + Decimal(shift)) / 2) - fixed)


@pytest.mark.parametrize("size", [10.0**k for k in range(-15, 4)])
@pytest.mark.parametrize(("gain", "shift"), [(-0.5, 0.3), (0.5, 0.3), (-3.0, 1.0), (-1.0, -0.2)])
def test_sigmoid_keeps_its_digits(gain, shift, size):
    """The step agrees with the printed formula in 60 digits at every size; directly it is 40 % wrong at 1e-15."""
    step = float(after(fp.Sigmoid(gain=gain, shift=shift, scale=1.0), 0.0, size, 0.0)[0])
    rounded_off = 1e-9 / math.hypot(size, 1e-9)  # the norm's floor changes the step where the error is near 1e-9
    assert step == pytest.approx(exact_sigmoid_step(gain, shift, size), rel=1e-13 + 1e-8 * rounded_off)


# Settings that no map has

RFPT = {"offset": 10.0, "sign": -1, "gain": 0.1}
AFFINE = fp.Affine(gain=-0.5)
MATRICES: tuple[Any, ...] = ((), (1.0, 0.0), (math.inf, 1.0), ((1.0, 2.0), (2.0, 4.0)), ((1.0, 2.0),))
NO_SIGNS = {"sign": 0}, {"sign": 2}, {"sign": -2}, {"offset": 0.0}, {"gain": 0.0}, {"gain": math.nan}
NO_CIRCLES = {"fraction": 0.0}, {"radius": 0.0}, {"radius": -1.0}, {"radius": math.inf}
WRONG: list[tuple[Any, dict[str, Any], str]] = [
    *((kind, RFPT | wrong, "expected") for kind in (fp.RFPT, fp.RFPTVector) for wrong in NO_SIGNS),
    *((fp.Rotation, {"fraction": 0.4, "radius": 1.0} | wrong, "expected") for wrong in NO_CIRCLES),
    *((fp.Sigmoid, {"gain": -1.0, "shift": shift}, "from -5 to 5") for shift in (-5.1, 5.1)),
    *((fp.Affine, {"gain": -0.5, "weights": one}, "a finite number other than zero") for one in MATRICES),
    (fp.Tuned, {"map": AFFINE, "largest_gain": 0.1}, "sector_limit gives one"),
    (fp.Tuned, {"map": AFFINE, "largest_gain": math.nan}, "expected a number, got nan"),
    (fp.Tuned, {"map": AFFINE, "largest_gain": math.inf}, "expected a bound beyond"),
    (fp.Tuned, {"map": fp.Identity(), "largest_gain": 1.0}, "expected a bound beyond"),
    *((fp.Haar, {"map": AFFINE, "noise": 1.0, "levels": n}, "a whole number from 1 to 8") for n in (0, 9)),
]


@pytest.mark.parametrize(("kind", "settings", "words"), WRONG)
def test_settings_that_no_map_has_are_refused(kind, settings, words):
    with pytest.raises(InvalidValue, match=words):
        kind(**settings)
