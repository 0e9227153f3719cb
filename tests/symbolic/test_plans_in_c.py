"""Plans in C: a plan compiled alone is that of the virtual machine, and touches no number that is not its own.

CasADi lays out the memory for the work of a graph. The loops in C that stand in its place need more, and overran it without a word:
a whole loop has a large work, so only a plan that was compiled alone was wrong.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from helpers.loops_in_c import coupled

import fpirhc as fp
from fpirhc.optimisers import base
from fpirhc.symbolic.driver import compiled_plans
from fpirhc.symbolic.native import find_compiler, native
from fpirhc.symbolic.program import generate

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="this machine has no C compiler")

LIMITED = fp.Limits(inputs={"Ma": (-2.0, 2.5), "Mb": (-150.0, 120.0)}, states={"a": (-0.5, 0.6), "a'": (-np.inf, 1.2)})
LIMITS = {"plain": fp.Limits(inputs={"Ma": (-2.0, 2.5), "Mb": (-150.0, 120.0)}), "limits of states": LIMITED}
OPTIMISER = fp.FixedPoint(iterations=4, tolerance=1e-7, most_iterations=20)


@dataclass(frozen=True, eq=False)
class Alone:
    """A Function whose body is loops in C, the graph that the virtual machine runs, and arguments for both."""

    function: ca.Function
    graph: ca.Function
    calls: list[tuple[np.ndarray, ...]]

    def expected(self) -> Iterator[tuple[tuple[np.ndarray, ...], list[np.ndarray]]]:
        """Arguments of the Function, and what the graph gives for them."""
        for arguments in self.calls:
            yield arguments, [value.full() for value in self.graph(*arguments[: self.graph.n_in()])]


@pytest.fixture(params=product(LIMITS, ("step", "converging", "library")), ids="-".join)
def alone(request, monkeypatch) -> Alone:
    """The optimiser's own Functions, and the library that loops of the virtual machine call."""
    limits, kind = request.param
    ocp, data = coupled.__wrapped__(LIMITS[limits], 3)  # a new one: libraries of a known one are kept
    graph = function = OPTIMISER.step(ocp) if kind == "library" else getattr(OPTIMISER, kind)(ocp)
    last: tuple[np.ndarray, ...] = ()
    if kind == "library":
        taken: list[ca.Function] = []
        monkeypatch.setattr(base, "native", lambda f: taken.append(f) or SimpleNamespace(compiled=False))
        with compiled_plans():
            OPTIMISER.step(ocp)
        # What is added says whether the plan converges, and with limits of states how many iterations it may take.
        [function], last = taken, (np.array(20.0 if ocp.bounds_states else 0.0),)
    random, memory, calls = np.random.default_rng(0), np.zeros(graph.size1_in(4)), []
    for size in (0.1, 0.4, 0.7, 1.5):
        calls.append((size * random.normal(size=3), data, ocp.input_lower, ocp.input_upper, memory, *last))
        memory = graph(*calls[-1][:5])[2].full().ravel()
    return Alone(function, graph, calls)


def same(plan: list[np.ndarray], expected: list[np.ndarray]) -> None:
    """The plan, its cost, residual, iterations and status, and what is remembered, to rounding."""
    for one, other, allowed in zip(plan, expected, (1e-7, 1e-7, 1e-5), strict=True):
        np.testing.assert_allclose(one, other, rtol=allowed, atol=allowed)


def test_a_plan_compiled_alone_is_that_of_the_virtual_machine(alone):
    compiled = native(alone.function, required=True)
    assert compiled.compiled, compiled.reason
    for arguments, expected in alone.expected():
        same([value.full() for value in compiled.function(*arguments)], expected)


_MAIN = """
#include <stdio.h>
#include <stdlib.h>
typedef long long whole;
int fpirhc_native(const double** arg, double** res, whole* iw, double* w, int mem);
int fpirhc_native_work(whole* sz_arg, whole* sz_res, whole* sz_iw, whole* sz_w);
int main(void) {{
  static const int given[] = {{{given}}}, made[] = {{{made}}};
  whole rows, answers, wholes, numbers;
  int calls = {calls}, k, i;
  fpirhc_native_work(&rows, &answers, &wholes, &numbers);
  const double** arg = malloc(rows * sizeof *arg);
  double **res = malloc(answers * sizeof *res), *w = malloc(numbers * sizeof *w);
  whole* iw = malloc(wholes * sizeof *iw);
  while (calls--) {{
    double* read[{n_in}];
    for (k = 0; k < {n_in}; ++k) {{
      read[k] = malloc(given[k] * sizeof(double));
      if (fread(read[k], sizeof(double), given[k], stdin) != (size_t)given[k]) return 3;
      arg[k] = read[k];
    }}
    for (k = 0; k < {n_out}; ++k) res[k] = malloc(made[k] * sizeof(double));
    double* mine[{n_out}];
    for (k = 0; k < {n_out}; ++k) mine[k] = res[k];
    if (fpirhc_native(arg, res, iw, w, 0)) return 4;
    for (k = 0; k < {n_out}; ++k)
      for (i = 0; i < made[k]; ++i) printf("%a\\n", mine[k][i]);
    for (k = 0; k < {n_in}; ++k) free(read[k]);
    for (k = 0; k < {n_out}; ++k) free(mine[k]);
  }}
  free(arg), free(res), free(w), free(iw);
  return 0;
}}
"""


def test_a_plan_compiled_alone_stays_inside_its_arrays(alone, tmp_path):
    """Every array has the size that the generated code asks for; the sanitizer ends the process at the first number outside."""
    f = alone.function
    given, made = (
        ", ".join(map(str, map(f.nnz_in, range(f.n_in())))),
        ", ".join(map(str, map(f.nnz_out, range(f.n_out())))),
    )
    main = _MAIN.format(given=given, made=made, calls=len(alone.calls), n_in=f.n_in(), n_out=f.n_out())
    files = []
    for k, text in enumerate([main, *generate(f)]):
        files.append(tmp_path / f"part{k}.c")
        files[k].write_text(text)
    program, flags = tmp_path / "program", ["-O0", "-ffp-contract=off", "-fsanitize=address"]
    subprocess.run([str(find_compiler()), *flags, *map(str, files), "-o", str(program), "-lm"], check=True)
    numbers = np.concatenate([np.asarray(v, dtype=float).ravel(order="F") for call in alone.calls for v in call])
    done = subprocess.run([str(program)], input=numbers.tobytes(), capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()[:2000]
    answers = iter(map(float.fromhex, done.stdout.decode().split()))
    for _, expected in alone.expected():
        same([np.array([next(answers) for _ in range(v.size)]).reshape(v.shape, order="F") for v in expected], expected)
