"""Generated code: its work vector holds what is used, and a library for every machine has the numbers of one for this machine."""

from __future__ import annotations

import ctypes
import re
import runpy
import subprocess
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.horizon.transcription import transcribe
from fpirhc.symbolic import native as module
from fpirhc.symbolic.driver import compiled_plans
from fpirhc.symbolic.native import find_compiler, native
from fpirhc.symbolic.program import generate

REAL = ctypes.POINTER(ctypes.c_double)
GUARD = -1.2345e-77


def stepping(name, states):
    """The problem with these limits, its stepper, the texts of its C, and the size of its work vector."""
    task = fp.load_problem(name)
    problem = replace(task.problem, limits=replace(task.problem.limits, states=states))
    stepper = fp.Stepper(problem, task.controllers["RHC+FPI"])
    texts = generate(stepper.function)
    (size,) = set(map(int, re.findall(r"sz_w\) \*sz_w = (\d+)", texts[0])))
    return problem, stepper, texts, size


@pytest.mark.skipif(find_compiler() is None, reason="this machine has no C compiler")
@pytest.mark.parametrize(
    ("name", "states"),
    [
        pytest.param("two_mass", {}, id="plain", marks=pytest.mark.slow),
        pytest.param("two_mass", {"q1": (1.85, 2.35)}, id="state limits"),
    ],
)
def test_a_step_behind_its_gate_touches_no_more_than_it_says(name, states, tmp_path):
    """In no branch of the gate is something written behind the end, or overwritten."""
    (problem, stepper, texts, size), files = stepping(name, states), []
    for k, text in enumerate(texts):
        files.append(tmp_path / f"part{k}.c")
        files[-1].write_text(text)
    library = tmp_path / "step.so"
    flags = ["-O1", "-ffp-contract=off", "-fPIC", "-shared"]
    subprocess.run([str(find_compiler()), *flags, "-o", str(library), *map(str, files), "-lm"], check=True)
    step, f = ctypes.CDLL(str(library)).fpirhc_native, stepper.function
    values = [stepper.start(), *stepper.reads.unpack(stepper.reads.start()).values()]
    results = [np.zeros(f.numel_out(k)) for k in range(f.n_out())]
    pointers = [(REAL * 400)(*(v.ctypes.data_as(REAL) for v in arrays)) for arrays in (values, results)]
    integers = np.zeros(max(f.sz_iw(), 1), dtype=np.int64)
    for k in range(25):
        work = np.full(size + 2000, GUARD)
        values[1][:] = k * problem.period
        values[2][:] = problem.start_state * (np.nan if k in (7, 8) else 1.0)
        if k == 12:
            values[0][-20] = np.nan  # of the controller: it begins anew
        command, memory = stepper.step(values[1][0], values[2], values[3], values[0])
        step(*pointers, integers.ctypes.data_as(ctypes.c_void_p), work.ctypes.data_as(REAL), 0)
        assert (work[size:] == GUARD).all()
        np.testing.assert_array_equal(results[0], memory)
        np.testing.assert_array_equal(results[2], command)
        values[0][:] = results[0]


def test_the_first_plan_of_a_run_is_not_compiled(monkeypatch):
    """It is solved once: a compiler would take longer than the virtual machine. The plans of the run are compiled."""
    sought: list[str] = []

    def native(function):
        sought.append(function.name())
        return SimpleNamespace(compiled=False)

    monkeypatch.setattr("fpirhc.optimisers.base.native", native)
    task = fp.load_problem("van_der_pol")
    problem = replace(task.problem, duration=10 * task.problem.period, measure_from=0.0)
    with compiled_plans():
        fp.simulate(problem, task.controllers["RHC"], seed=0, compiled=False)
    assert sought
    assert not [name for name in sought if "converging" in name]


# Compiled loops for one machine and for every machine of its architecture: the same numbers


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="this machine has no C compiler")
def test_a_library_for_every_machine_has_the_numbers_of_one_for_this_machine(tmp_path, monkeypatch):
    """A chain of four masses has enough states for Jacobians with all directions side by side, which are apart from the loops."""
    p = runpy.run_path(str(fp.load_problem("chain_of_masses").path))["chain"](4)
    horizon = fp.Horizon(stages=3, step=0.2, discretisation=fp.RungeKutta4(1))
    ocp = transcribe(p.plant, p.reference, horizon, p.cost, p.limits)
    optimiser = fp.FixedPoint(iterations=3, tolerance=1e-6)
    step = optimiser.step(ocp)
    arguments = (1.01 * p.start_state, ocp.nodes[2], ocp.input_lower, ocp.input_upper, optimiser.memory(ocp).start())
    found: list[list[np.ndarray]] = []
    for flags in ((), ("-DALWAYS_WIDE",)):
        if flags and module._machine_flags() != flags:
            continue  # this machine has no wide registers
        monkeypatch.setenv("FPIRHC_CACHE", str(tmp_path / f"cache{len(found)}"))
        monkeypatch.setattr(module, "_loaded", {})
        with monkeypatch.context() as one:
            one.setattr(module, "_machine_flags", lambda flags=flags: flags)
            found.append([value.full() for value in native(step, required=True).function(*arguments)])
    for other in found[1:]:
        for mine, yours in zip(found[0], other, strict=True):
            np.testing.assert_array_equal(mine, yours)
    assert np.abs(found[0][0]).max() > 0
    for value, graph in zip(found[0], step(*arguments), strict=True):
        np.testing.assert_allclose(value, graph.full(), rtol=1e-9, atol=1e-9)
