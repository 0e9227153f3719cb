"""Laws of the deformation maps: fixed point, gains, convergence and its limits."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from decimal import Decimal, getcontext
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fpirhc import RFPT, Affine, Identity, RFPTVector, Rotation, Sigmoid
from fpirhc.conformance import check_deformation
from fpirhc.contracts import Deformation
from fpirhc.errors import InvalidValue, NotSupported
from fpirhc.members import examples, member_classes

MAPS = examples("deformations")
ITERATING = tuple(m for m in MAPS if m.effective_gain() != 0)
INNER = (Sigmoid(gain=-0.5, scale=1.0), Affine(gain=-0.5), RFPTVector(offset=1e5, sign=-1, gain=5e-6))
ALL_WRAPPERS = tuple(w for inner in INNER for w in examples("deformations", inner) if w not in MAPS)
# The others answer from what was measured earlier, or from the model's response.
NEARLY_LINEAR = (
    Affine(gain=-0.5),
    RFPT(offset=1e5, sign=-1, gain=5e-6),
    RFPTVector(offset=1e5, sign=-1, gain=5e-6),
    Sigmoid(gain=-0.5, scale=1e4),
    Rotation(fraction=0.4, radius=1e4),
)


def name_of(deformation: Deformation) -> str:
    return repr(deformation).replace(" ", "")


def advance(deformation: Deformation, request: Any, response: Any, desired: Any) -> np.ndarray:
    """One step with numbers, through an SX Function."""
    n = np.size(request)
    r, f, d = symbols = [ca.SX.sym(s, n) for s in ("r", "f", "d")]
    function = ca.Function("map", symbols, [deformation.step(r, f, d, {})[0]])
    return np.asarray(function(request, response, desired).full())[:, 0]


def iterate(deformation: Deformation, jacobian: np.ndarray, start: np.ndarray, cycles: int) -> np.ndarray:
    """Requests r_0 ... r_cycles on the plant f(r) = J r with desired response 0, so with fixed point 0."""
    n = len(start)
    r = ca.SX.sym("r", n)
    one = ca.Function("one", [r], [deformation.step(r, ca.mtimes(ca.DM(jacobian), r), ca.SX.zeros(n), {})[0]])
    return np.vstack([start, np.asarray(one.mapaccum(cycles)(start).full()).T])


def rate(requests: np.ndarray, first: int, last: int) -> float:
    """Mean factor per cycle between two cycles."""
    sizes = np.linalg.norm(requests, axis=1)
    return float((sizes[last] / sizes[first]) ** (1 / (last - first)))


def test_every_map_has_examples() -> None:
    """A new file carries values for the laws, or they would go unchecked."""
    assert set(member_classes("deformations")) == {type(m) for m in (*MAPS, *ALL_WRAPPERS)}


@pytest.mark.parametrize("elements", [("q1",), ("q1", "q2", "q3")], ids=len)
@pytest.mark.parametrize("deformation", ITERATING, ids=name_of)
def test_conformance(deformation: Deformation, elements: tuple[str, ...]) -> None:
    """Every map keeps the public laws, for one coordinate and for several."""
    check_deformation(deformation, elements=elements, seed=1)


def test_identity_asks_for_what_is_desired() -> None:
    assert advance(Identity(), [1.0, 2.0], [np.nan, 7.0], [3.0, 4.0]).tolist() == [3.0, 4.0]
    with pytest.raises(NotSupported, match="Sigmoid"):
        Identity().with_effective_gain(0.5)


@dataclass(frozen=True)
class _Bare(Affine):
    """A map that divides by the norm of the error."""

    def step(self, request: Any, response: Any, desired: Any, memory: Any) -> Any:
        del memory
        error = response - desired
        unit = ca.if_else(ca.norm_2(error) > 1e-10, error / ca.norm_2(error), 0)
        return request + 0.5 * self.gain * ca.norm_2(error) * unit, {}


def test_a_map_without_a_gradient_is_found() -> None:
    """Its value is guarded against 0 / 0 and its derivative is not."""
    with pytest.raises(AssertionError, match=r"gradient|value"):
        check_deformation(_Bare(-0.5), seed=1)


def test_scale_must_be_chosen() -> None:
    """A sigmoid without scale has no step; the message says how to give it one."""
    open_scale = Sigmoid(gain=-0.5)
    with pytest.raises(InvalidValue, match=r"with_scale\(S\)"):
        open_scale.step(ca.SX.sym("r"), ca.SX.sym("f"), ca.SX.sym("d"), {})
    with pytest.raises(InvalidValue, match="scale"):
        open_scale.largest_step()
    assert open_scale.with_scale(3.0) == Sigmoid(gain=-0.5, scale=3.0)
    assert open_scale.effective_gain() == Sigmoid(gain=-0.5, scale=3.0).effective_gain()


# shift D, x*, zeta'(x*), largest step for A_c < 0 and for A_c > 0, steepest secant for A_c < 0
CONSTANTS = (
    (0.1, 0.098076, 0.485525, 0.6474, 0.4512, 0.496355),
    (0.2, 0.186129, 0.447431, 0.7354, 0.3632, 0.486488),
    (0.3, 0.259456, 0.396737, 0.8088, 0.2899, 0.472649),
    (0.5, 0.364681, 0.291509, 0.9140, 0.1846, 0.440438),
    (1.0, 0.486365, 0.116297, 1.0357, 0.0629, 0.365290),
)


@pytest.mark.parametrize("row", CONSTANTS, ids=lambda row: f"D={row[0]}")
def test_sigmoid_constants(row: tuple[float, ...]) -> None:
    """The closed forms give the tabulated fixed point, slope, bounds and secant."""
    shift, fixed_point, slope, down, up, secant = row
    sigmoid = Sigmoid(gain=-1.0, shift=shift, scale=1.0)
    assert sigmoid.fixed_point == pytest.approx(fixed_point, abs=1e-6)
    assert sigmoid.fixed_point == pytest.approx(math.atanh(0.5 * math.tanh(sigmoid.fixed_point + shift)), abs=1e-14)
    assert sigmoid.slope == pytest.approx(slope, abs=1e-6)
    assert sigmoid.largest_step() == pytest.approx(down, abs=1e-4)
    assert replace(sigmoid, gain=1.0).largest_step() == pytest.approx(up, abs=1e-4)
    assert sigmoid.steepest_secant == pytest.approx(secant, abs=1e-6)


@settings(deadline=None, derandomize=True, max_examples=50)
@given(
    st.floats(-3, 3),
    st.floats(-3, 3).filter(lambda gain: abs(gain) > 1e-3),
    st.lists(st.floats(1e-6, 100), min_size=1, max_size=20),
)
def test_steepest_secant_is_a_bound(shift: float, gain: float, sizes: list[float]) -> None:
    """Slope <= steepest secant <= 1/2 for any shift and sign, and no sampled secant is steeper."""
    sigmoid = Sigmoid(gain=gain, shift=shift, scale=1.0)
    assert sigmoid.slope <= sigmoid.steepest_secant * (1 + 1e-12) <= 0.5 * (1 + 1e-12)
    for size in sizes:
        step = abs(float(advance(sigmoid, 0.0, size, 0.0)[0]))
        assert step <= abs(sigmoid.secant_gain()) * size * (1 + 1e-9)
        assert step <= sigmoid.largest_step() * (1 + 1e-9)


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
def test_sigmoid_keeps_its_digits(gain: float, shift: float, size: float) -> None:
    """The step agrees with the printed formula in 60 digits at every size; directly it is 40 % wrong at 1e-15."""
    step = float(advance(Sigmoid(gain=gain, shift=shift, scale=1.0), 0.0, size, 0.0)[0])
    rounded_off = 1e-9 / math.hypot(size, 1e-9)  # the norm's floor changes the step where the error is near 1e-9
    assert step == pytest.approx(exact_sigmoid_step(gain, shift, size), rel=1e-13 + 1e-8 * rounded_off)


def test_huge_errors_saturate() -> None:
    """An error beyond the square root of the largest number gives a bounded step, not an overflow."""
    step = advance(Sigmoid(gain=-0.5, scale=1.0), [0.0, 0.0], [1e150, 0.0], [0.0, 0.0])
    assert np.linalg.norm(step) == pytest.approx(Sigmoid(gain=-0.5, scale=1.0).largest_step(), rel=1e-9)


@pytest.mark.parametrize("slope", [1.5, 1.9, 2.1])
def test_rfpt_factor(slope: float) -> None:
    """K_c A_c = 1: the factor per cycle is 1 + (K_c + r*) B_c A_c f', also where it is a divergence."""
    offset, desired = 1e5, 30.0
    fixed = desired / slope
    requests = [fixed + 1e-3]
    for _ in range(4):
        requests.append(float(advance(RFPT(offset, -1, 1e-5), requests[-1], slope * requests[-1], desired)[0]))
    errors = np.array(requests) - fixed
    assert errors[1:] / errors[:-1] == pytest.approx(1 - (offset + fixed) * 1e-5 * slope, abs=1e-4)


@pytest.mark.parametrize("slope", [0.5, 1.0, 1.5])
def test_false_fixed_point_repels(slope: float) -> None:
    """The second fixed point r = -K_c has G' = 1 + tanh(f' - d / K_c) > 1 for B_c = -1 and f' > 0 (1.76 for f' = 1)."""
    r = ca.SX.sym("r")
    deformed = RFPT(1e5, -1, 1e-5).step(r, slope * r, ca.SX(0), {})[0]
    value, derivative = ca.Function("g", [r], [deformed, ca.jacobian(deformed, r)])(-1e5)
    assert float(value) == -1e5
    assert float(derivative) == pytest.approx(1 + math.tanh(slope), rel=1e-12)


@pytest.mark.parametrize(
    ("jacobian", "gain"),
    [(np.diag([1.5, 1.3]), g) for g in (-0.5, -1.0, -2.0, -3.0)]
    + [(np.array([[0.95, -0.811], [0.811, 0.95]]), g) for g in (-0.5, -1.0, -2.0, -3.0)],
)
def test_sigmoid_rate_equals_prediction(jacobian: np.ndarray, gain: float) -> None:
    """Real and complex spectra: the measured factor is max|1 - a lambda|, near the fixed point."""
    sigmoid = Sigmoid(gain=gain, scale=1.0)
    predicted = np.abs(1 - sigmoid.effective_gain() * np.linalg.eigvals(jacobian)).max()
    slowest = np.eye(2)[np.argmax(np.abs(1 - sigmoid.effective_gain() * np.diag(jacobian)))]
    requests = iterate(sigmoid, jacobian, 1e-5 * slowest, 12)
    assert rate(requests, 4, 12) == pytest.approx(predicted, abs=1e-3)


@pytest.mark.parametrize("gain", [-2.0, -0.5, -0.1, 0.1, 0.5, 2.0])
def test_indefinite_jacobian_never_converges(gain: float) -> None:
    """Eigenvalues of both signs: no gain of either sign brings the error down."""
    requests = iterate(Sigmoid(gain=gain, scale=1.0), np.diag([1.0, -1.0]), np.array([1e-3, 1e-3]), 400)
    assert np.linalg.norm(requests[-1]) > 1.0


def test_equivalence_at_equal_gain() -> None:
    """All maps converge at the same rate when their effective gains are equal, whatever their formula."""
    jacobian = np.array([[1.5, 0.2], [0.1, 1.3]])
    rates = []
    for deformation in NEARLY_LINEAR:
        requests = iterate(deformation.with_effective_gain(0.3), jacobian, np.array([5.0, -3.0]), 30)
        rates.append(rate(requests, 10, 30))
    assert rates == pytest.approx([rates[0]] * len(rates), rel=0.01)


LIMIT_GAINS = (-4.2, -4.3, -4.9)  # unit plant: sector limit 4.2315, linear limit 5.0411


@pytest.mark.parametrize("gain", LIMIT_GAINS)
def test_sector_and_linear_limit(gain: float) -> None:
    """Between the sector and the linear limit large errors end in a bounded 2-cycle, small ones die out.

    Local analysis cannot see the 2-cycle. Below the sector limit errors of any size die out.
    """
    sigmoid, plant = Sigmoid(gain=gain, scale=1.0), np.eye(1)
    small = np.abs(iterate(sigmoid, plant, np.array([1e-3]), 3000)[-1, 0])
    large = iterate(sigmoid, plant, np.array([5.0]), 3000)[-2:, 0]
    assert small < 1e-6
    if sigmoid.secant_gain() < 2:
        assert np.abs(large).max() < 1e-6
    else:
        assert large[0] == pytest.approx(-large[1], rel=1e-6)
        assert 0.01 < np.abs(large[0]) < 1.0
    assert sigmoid.effective_gain() < 2


def test_beyond_the_linear_limit_oscillates_from_any_error() -> None:
    """Above the linear limit even a small error grows, into a bounded 2-cycle because the step saturates."""
    last = iterate(Sigmoid(gain=-5.2, scale=1.0), np.eye(1), np.array([1e-3]), 3000)[-2:, 0]
    assert last[0] == pytest.approx(-last[1], rel=1e-6)
    assert np.abs(last[0]) > 0.01


def test_rotation_outgrows_its_radius() -> None:
    """Vectors longer than the radius still give a finite request nearer to the desired response."""
    requests = iterate(Rotation(0.4, 1.0), np.diag([1.5, 1.3]), np.array([80.0, -50.0]), 60)
    assert np.linalg.norm(requests[-1]) < 1e-6
    assert np.all(np.isfinite(requests))


@pytest.mark.parametrize("deformation", ITERATING, ids=name_of)
def test_maps_serve_an_optimiser(deformation: Deformation) -> None:
    """step(request=U, response=gradient, desired=0) minimises a quadratic cost, by the same contraction."""
    hessian = np.diag([1.5, 1.3])
    changed = deformation.with_effective_gain(0.6)
    assert np.linalg.norm(iterate(changed, hessian, np.array([0.4, -0.2]), 200)[-1]) < 1e-6
