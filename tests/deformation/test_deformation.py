"""Laws of the deformation maps: fixed point, gains, convergence and its limits."""

import math
from decimal import Decimal, getcontext
from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.conformance import check_deformation, examples
from fpirhc.contracts import Deformation
from fpirhc.errors import InvalidValue, NotSupported

MAPS = examples("deformations", fp.Affine(gain=-0.5))
ITERATING = tuple(m for m in MAPS if m.effective_gain() != 0)


def name_of(deformation: Deformation) -> str:
    return repr(deformation).replace(" ", "")


def advance(deformation: Deformation, request: Any, response: Any, desired: Any) -> np.ndarray:
    """One step with numbers, through an SX Function."""
    n = np.size(request)
    r, f, d = symbols = [ca.SX.sym(s, n) for s in ("r", "f", "d")]
    function = ca.Function("map", symbols, [deformation.step(r, f, d, {})[0]])
    return np.asarray(function(request, response, desired).full())[:, 0]


@pytest.mark.parametrize("elements", [("q1",), ("q1", "q2", "q3")], ids=len)
@pytest.mark.parametrize("deformation", ITERATING, ids=name_of)
def test_conformance(deformation: Deformation, elements: tuple[str, ...]) -> None:
    """Every map keeps the public laws, for one coordinate and for several."""
    check_deformation(deformation, elements=elements, seed=1)


def test_identity_asks_for_what_is_desired() -> None:
    assert advance(fp.Identity(), [1.0, 2.0], [np.nan, 7.0], [3.0, 4.0]).tolist() == [3.0, 4.0]
    with pytest.raises(NotSupported, match="Sigmoid"):
        fp.Identity().with_effective_gain(0.5)


def test_scale_must_be_chosen() -> None:
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
def test_sigmoid_keeps_its_digits(gain: float, shift: float, size: float) -> None:
    """The step agrees with the printed formula in 60 digits at every size; directly it is 40 % wrong at 1e-15."""
    step = float(advance(fp.Sigmoid(gain=gain, shift=shift, scale=1.0), 0.0, size, 0.0)[0])
    rounded_off = 1e-9 / math.hypot(size, 1e-9)  # the norm's floor changes the step where the error is near 1e-9
    assert step == pytest.approx(exact_sigmoid_step(gain, shift, size), rel=1e-13 + 1e-8 * rounded_off)
