"""Own exp, log, pow, sin, cos, tanh and atanh: errors against numbers of 64 binary digits, and C99's special cases."""

from __future__ import annotations

import ctypes
import itertools
import math
import subprocess
from importlib import resources
from typing import Any

import numpy as np
import pytest

from fpirhc.symbolic.native import find_compiler

pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="no C compiler"),
    pytest.mark.skipif(np.finfo(np.longdouble).nmant < 60, reason="no numbers with more digits here"),
]
FINITE = (0.0, -0.0, 1.0, -1.0, 0.5, -0.5, 2.0, 3.0, -3.0, 2.5, 1e308, -1e308, 1e-308, 5e-324, 1e16, -1e16)
SPECIAL = [*FINITE, 2.0**53 + 2, -(2.0**52) - 1, math.inf, -math.inf, math.nan]


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("math")
    for name in ("math.c", "math.h"):
        text = resources.files("fpirhc.export.targets").joinpath(name).read_text(encoding="utf-8")
        made = folder / (f"m_{name}" if name == "math.h" else name)
        made.write_text(text.replace("@name@", "m").replace("@NAME@", "M"))
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-ffp-contract=off", "-shared", "-fPIC"]
    source, library = folder / "math.c", folder / "m.so"
    subprocess.run([str(find_compiler()), *strict, str(source), "-o", str(library), "-lm"], check=True)
    return ctypes.CDLL(str(library))


def called(own: Any, name: str, *arguments: np.ndarray) -> np.ndarray:
    function = getattr(own, f"m_{name}")
    function.restype, function.argtypes = ctypes.c_double, [ctypes.c_double] * len(arguments)
    return np.array([function(*row) for row in zip(*(a.tolist() for a in arguments), strict=True)])


def units_off(own: Any, name: str, *arguments: np.ndarray) -> float:
    """The largest error in units in the last place."""
    true = getattr(np, {"atanh": "arctanh", "pow": "power"}.get(name, name))
    wanted = true(*(a.astype(np.longdouble) for a in arguments))
    apart = np.abs(called(own, name, *arguments).astype(np.longdouble) - wanted)
    return float(np.max(apart / np.spacing(np.abs(wanted.astype(float))).astype(np.longdouble)))


N = 4000
R = np.random.default_rng(5)
POINTS = {
    "exp": (R.uniform(-745, 709.7, N), R.uniform(-1, 1, N), 10 ** R.uniform(-20, 0, N)),
    "log": (
        10 ** R.uniform(-308, 308, N),
        R.uniform(0.5, 2, N),
        1 + R.uniform(-1e-6, 1e-6, N),
        R.uniform(1e-320, 1e-308, N),
    ),
    "sin": (R.uniform(-10, 10, N), R.uniform(-1e6, 1e6, N), R.uniform(-1e12, 1e12, N), np.arange(1, N) * np.pi / 2),
    "cos": (R.uniform(-10, 10, N), R.uniform(-1e6, 1e6, N), R.uniform(-1e12, 1e12, N), np.arange(1, N) * np.pi / 2),
    "tanh": (R.uniform(-1, 1, N), R.uniform(-25, 25, N), 10 ** R.uniform(-20, 0, N)),
    "atanh": (R.uniform(-1, 1, N), 10 ** R.uniform(-20, 0, N), 1 - 10 ** R.uniform(-15, -1, N)),
}
POWERS = (
    (10 ** R.uniform(-3, 3, N), R.uniform(-50, 50, N)),
    (R.uniform(0.5, 2, N), R.uniform(-1000, 1000, N)),
    (1 + R.uniform(-1e-6, 1e-6, N), R.uniform(-1e8, 1e8, N)),
    (R.uniform(-5, 5, N), np.round(R.uniform(-20, 20, N))),
)


@pytest.mark.parametrize("name", POINTS)
def test_an_error_is_below_one_and_a_half_units(name, own):
    assert max(units_off(own, name, points) for points in POINTS[name]) < 1.5


@pytest.mark.parametrize("number", range(len(POWERS)))
def test_the_error_of_a_power_is_below_one_and_a_half_units(number, own):
    assert units_off(own, "pow", *POWERS[number]) < 1.5


@pytest.mark.parametrize("name", POINTS)
def test_special_numbers_are_those_of_c99(name, own):
    """Signed zeros, infinities, NaN and the ends of the range; large angles apart, whose last digits are not kept."""
    points = np.array([x for x in SPECIAL if name not in ("sin", "cos") or not 1e12 < abs(x) < math.inf])
    with np.errstate(all="ignore"):
        wanted = getattr(np, {"atanh": "arctanh"}.get(name, name))(points)
    for x, got, want in zip(points, called(own, name, points), wanted, strict=True):
        assert np.isclose(got, want, rtol=4e-16, atol=0, equal_nan=True), x
        assert math.isnan(want) or np.signbit(got) == np.signbit(want), x


def test_special_powers_are_those_of_c99(own):
    """Every pair, against the machine's own library."""
    library = ctypes.CDLL(None).pow
    library.restype, library.argtypes = ctypes.c_double, [ctypes.c_double] * 2
    pairs = np.array(list(itertools.product(SPECIAL, SPECIAL)))
    for (x, y), got in zip(pairs, called(own, "pow", pairs[:, 0], pairs[:, 1]), strict=True):
        want = library(x, y)
        assert np.isclose(got, want, rtol=4e-16, atol=0, equal_nan=True), (x, y, got, want)
        assert math.isnan(want) or np.signbit(got) == np.signbit(want), (x, y)
