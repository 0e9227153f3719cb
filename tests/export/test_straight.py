"""Condensed scalar code computes what CasADi's own code does, bit by bit, and computes as little as a choice takes."""

from __future__ import annotations

import ctypes
import re
import subprocess
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from fpirhc.export.device import c_of
from fpirhc.symbolic.driver import every_finite
from fpirhc.symbolic.live import nan_where
from fpirhc.symbolic.native import find_compiler

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-ffp-contract=off", "-fPIC", "-shared")


def random_function(seed: int) -> ca.Function:
    """Scalar code of steps: sums, products, choices by flags that others share, checks, restored rows, numbers of a status."""
    random = np.random.default_rng(seed)
    rows = [ca.SX.sym("memory", 9), ca.SX.sym("sample", 4)]
    numbers, flags = (
        [*ca.vertsplit(rows[0]), *ca.vertsplit(rows[1]), ca.SX(0), ca.SX(1), ca.SX(2.5), ca.SX(-7)],
        list[ca.SX](),
    )

    def one(of):
        return of[random.integers(len(of))]

    good = every_finite(rows[0][2:8])
    flags += [good, ca.fabs(rows[1][0]) <= 1.5, rows[1][1] < rows[1][2]]
    numbers += ca.vertsplit(ca.if_else(good, rows[0][2:8], ca.DM([0, 0, 3, 0, -1, 0])))
    makers = [
        lambda: numbers.append(one(numbers) + one(numbers)),
        lambda: numbers.append(one(numbers) * one(numbers)),
        lambda: numbers.append(one(numbers) / one(numbers)),
        lambda: numbers.append(one(numbers) - one(numbers)),
        lambda: numbers.append(ca.fmin(one(numbers), ca.fmax(one(numbers), -1))),
        lambda: numbers.append(ca.if_else(one(flags), ca.exp(-(one(numbers) ** 2)), one(numbers))),
        lambda: numbers.append(ca.if_else(one(flags), one(numbers), one(numbers))),
        lambda: numbers.append(
            ca.if_else(one(flags), one(numbers), ca.if_else(one(flags), one(numbers), one(numbers)))
        ),
        lambda: numbers.append(one(numbers) + one(flags)),
        lambda: numbers.append(4 * (1 - one(flags))),
        lambda: numbers.append(ca.if_else(one(flags), 12, ca.if_else(one(flags), 5, ca.if_else(one(flags), 4, 0)))),
        lambda: numbers.append(ca.if_else(one(flags), 200, ca.if_else(one(flags), -130, one(flags) / one(flags)))),
        lambda: numbers.append(ca.floor(one(numbers)) - ca.fmod(one(numbers), one(numbers))),
        lambda: numbers.append(ca.atan2(one(numbers), one(numbers)) * one(numbers) ** one(numbers)),
        lambda: flags.append(ca.logic_and(one(numbers), one(numbers))),
        lambda: flags.append(one(numbers) <= random.integers(-140, 260)),
        lambda: flags.append(one(numbers) == random.integers(6)),
        lambda: flags.append(one(numbers) < one(numbers)),
        lambda: flags.append(one(numbers) <= 1.5),
        lambda: flags.append(ca.logic_and(one(flags), one(flags))),
        lambda: flags.append(ca.logic_or(one(flags), ca.logic_not(one(flags)))),
        lambda: flags.append(every_finite(ca.vertcat(*(one(numbers) for _ in range(4))))),
        lambda: numbers.append(one(numbers) + nan_where(one(flags))),
    ]
    for _ in range(90):
        one(makers)()
    kept = one(flags)
    following = ca.if_else(kept, ca.vertcat(*(one(numbers) for _ in range(9))), rows[0])
    trace = ca.vertcat(*(one(numbers) for _ in range(5)), one(flags), *ca.vertsplit(following)[:2])
    return ca.Function("f", rows, [ca.densify(following), ca.densify(trace)], {"cse": True})


def compiled(text: str, name: str, folder: Path) -> ctypes.CDLL:
    (folder / f"{name}.c").write_text(text)
    made = folder / f"{name}.so"
    command = [str(find_compiler()), *STRICT, str(folder / f"{name}.c"), "-o", str(made), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return ctypes.CDLL(str(made))


def results(library: ctypes.CDLL, values: list[np.ndarray], sizes: list[int]) -> list[np.ndarray]:
    row = ctypes.POINTER(ctypes.c_double)
    made = [np.zeros(size) for size in sizes]
    rows = [(row * len(part))(*(v.ctypes.data_as(row) for v in part)) for part in (values, made)]
    assert library.arm_raw(*rows, None, None, 0) == 0
    return made


@needs_compiler
@pytest.mark.parametrize("seed", [*range(12), 164])
def test_condensed_code_is_what_was_written(seed, tmp_path):
    """Random steps on numbers, zeros, infinities and NaN: the bits of CasADi's virtual machine, but for the sign of 0."""
    function = random_function(seed)
    (text,), _ = c_of(function, "arm")
    assert "a0" not in re.findall(r"\w+", text)
    library, random = compiled(text, "condensed", tmp_path), np.random.default_rng(seed)
    for k in range(60):
        values = [random.normal(size=function.size1_in(i)) * 10.0 ** random.integers(-2, 3) for i in range(2)]
        for part in values[: k % 3]:
            part[random.integers(len(part))] = random.choice([0.0, 1.0, 4.0, np.nan, np.inf, -np.inf, 1e305])
        wanted = [np.asarray(part.full()).ravel() for part in function.call([ca.DM(v) for v in values])]
        for here, there in zip(results(library, values, [9, len(wanted[1])]), wanted, strict=True):
            np.testing.assert_array_equal(here, there)


@needs_compiler
def test_whole_numbers_are_compared_with_every_other_number(tmp_path):
    """A byte holds 12, 2 or 4: equal to 2, not to 2.5, and less than what no byte holds."""
    x = ca.SX.sym("x", 2)
    whole = ca.if_else(x[0] < 0, 12, ca.if_else(x[1] < 0, 2, 4))
    answers: list[ca.SX] = []
    for n in (2, 2.5, -2.5, 4, 1e300, -1e300):
        answers += [whole == n, whole != n, whole < n, whole <= n, whole > n, whole >= n]
    function = ca.Function("f", [x], [ca.densify(ca.vertcat(*answers))])
    (text,), _ = c_of(function, "arm")
    library = compiled(text, "whole", tmp_path)
    for values in ([-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]):
        (found,) = results(library, [np.array(values)], [len(answers)])
        np.testing.assert_array_equal(found, function(values).full().ravel())


@needs_compiler
@pytest.mark.parametrize(
    "made",
    [
        lambda x, whole: ca.if_else(whole == 2, x, -7.0) - ca.if_else(whole == 2, -7.0, -7.5) - ca.SX(-7.0),
        lambda x, whole: ca.logic_and(x * (whole == 2), x),
        lambda x, whole: ca.vertcat(*(ca.if_else(ca.SX(n) <= whole, x, 2 * x) for n in (-129, -128, 127, 128, 40000))),
    ],
    ids=["choice", "truth", "bytes"],
)
def test_what_a_compiler_would_read_otherwise(made, tmp_path):
    """`x--7` is no difference, a byte never above 128, and a product a number before a truth."""
    x = ca.SX.sym("x", 2)
    whole = ca.if_else(x[0] < 0, 12, ca.if_else(x[1] < 0, 2, -3))
    function = ca.Function("f", [x], [ca.densify(made(x[0], whole))])
    (text,), _ = c_of(function, "arm")
    library = compiled(text, "read", tmp_path)
    for values in ([-1.0, 1.0], [1.0, -1.0], [1.0, 1.0], [0.0, -1.0], [np.nan, -1.0]):
        (found,) = results(library, [np.array(values)], [function.numel_out(0)])
        np.testing.assert_array_equal(found, function(values).full().ravel())


def body_of(function: ca.Function) -> str:
    (text,), sizes = c_of(function, "arm")
    assert sizes["w"] == 1
    return text[text.index("res0 =") :]


def test_a_choice_is_one_expression_and_what_one_side_needs_is_inside():
    x, y = ca.SX.sym("x"), ca.SX.sym("y", 2)
    chosen = ca.if_else(x < y[0], y[1], 3 * x)
    body = body_of(ca.Function("f", [x, y], [chosen, chosen + y[0]]))
    assert "res0[0] = ((arg0[0]<arg1[0])?arg1[1]:((casadi_real)3.*arg0[0]));" in body
    assert "res1[0] = (res0[0]+arg1[0]);" in body
    assert "? arg" not in body


def test_an_elementary_function_is_computed_where_a_choice_takes_it():
    """What one choice alone takes waits for its flag, and what another result takes too does not; NaN is no arcsine."""
    x, y = ca.SX.sym("x"), ca.SX.sym("y", 2)
    flag, shared = x < y[0], ca.log(y[1])
    chosen = ca.if_else(flag, ca.exp(x) + shared, ca.if_else(x > y[1], ca.cos(x), x))
    body = body_of(ca.Function("f", [x, y], [chosen, x + nan_where(flag), shared]))
    taken, _, other = body.partition("if (")[2].partition("else")
    assert "(exp(arg0[0])+res2[0]);" in taken
    assert "?cos(arg0[0]):arg0[0]);" in other
    assert "res2[0] = log(arg1[1]);" in body
    assert "asin" not in body
    assert "= NAN;" in taken


def test_results_that_follow_one_flag_stand_in_one_branch():
    """A memory that is kept is copied as a whole, and one that is restored is read through one pointer."""
    memory, x = ca.SX.sym("memory", 8), ca.SX.sym("x", 4)
    good = every_finite(memory)
    restored = ca.if_else(good, memory, ca.DM([0, 0, 0, 2, 0, 0, 0, 0]))
    new = ca.vertcat(ca.sin(restored[:4]) + x, ca.cos(restored[4:]) * x)
    body = body_of(ca.Function("f", [memory, x], [ca.if_else(x[0] < x[1], new, memory), restored[3] + restored[4]]))
    branch, _, other = body.partition("if (")[2].partition("else")
    assert "memcpy" not in branch
    assert "memcpy(res0+0, arg0+0, 8 * sizeof(casadi_real));" in other
    assert len(re.findall(r"\? arg0\+0 : casadi_f\d+_\d+\)", body)) == 1
    assert "EVERY(every_bounded(arg0+0, 8), " in body
