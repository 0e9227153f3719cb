"""Texts of the loops in C, compiled by themselves with sizes and constants of a test, so that their functions are called alone."""

from __future__ import annotations

import ctypes
import subprocess
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np

import fpirhc.optimisers
from fpirhc.symbolic.driver import OF_TYPE, WORDS
from fpirhc.symbolic.native import find_compiler

FOLDER = Path(fpirhc.optimisers.__file__).parent
_STAGES = ("evaluate", "pull", "linearise", "hessian", "end", "deformed", "bend", "curve", "plain")
_BEFORE = """
#include <math.h>
typedef double casadi_real;
typedef long long casadi_int;
"""


@cache
def library(
    texts: tuple[str, ...], constants: tuple[tuple[str, object], ...], own: str, written: str = ""
) -> ctypes.CDLL:
    """Load the texts with these definitions.

    Args:
        texts: names of the files, without suffix.
        constants: preprocessor definitions.
        own: C code behind them, with the functions that are called.
        written: names of the stage functions that `own` defines; all others say that they failed.
    """
    signature = "(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem)"
    stubs = [f"static int {n}{signature}" + (";" if n in written.split() else " { return 1; }") for n in _STAGES]
    definitions = [f"#define {name} {value}" for name, value in constants]
    parts = [(FOLDER / f"{name}.c").read_text(encoding="utf-8") for name in texts]
    folder = Path(mkdtemp())
    source, built = folder / "alone.c", folder / "alone.so"
    source.write_text("\n".join([_BEFORE, OF_TYPE, WORDS, *definitions, *stubs, *parts, own]), encoding="utf-8")
    compiler = find_compiler()
    assert compiler is not None
    command = [compiler, "-shared", "-fPIC", "-O1", "-w", "-ffp-contract=off", str(source), "-o", str(built), "-lm"]
    subprocess.run(command, check=True, capture_output=True)
    return ctypes.CDLL(str(built))


def call(alone: ctypes.CDLL, name: str, *arguments: np.ndarray | float | None) -> int:
    """Call a function with arrays of numbers, which it may change, and with numbers; whole ones are C's int."""
    given: list[object] = []
    for one in arguments:
        if isinstance(one, np.ndarray):
            given.append(one.ctypes.data_as(ctypes.c_void_p))
        else:
            given.append(ctypes.c_int(one) if isinstance(one, int) else one if one is None else ctypes.c_double(one))
    return int(getattr(alone, name)(*given))


def columns(matrix: np.ndarray) -> np.ndarray:
    """A copy of a matrix, column by column."""
    return np.array(matrix.T, order="C", copy=True).ravel()


def defined(**constants: object) -> tuple[tuple[str, object], ...]:
    """Preprocessor definitions; rows of numbers become initialisers."""
    rows = {n: "{" + ", ".join(map(repr, v)) + "}" if isinstance(v, list) else v for n, v in constants.items()}
    return tuple(rows.items())
