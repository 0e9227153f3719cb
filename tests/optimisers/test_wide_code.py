"""Compiled loops for one machine and for every machine of its architecture: the same numbers."""

from __future__ import annotations

import runpy

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.horizon.transcription import transcribe
from fpirhc.symbolic import native as module
from fpirhc.symbolic.native import find_compiler, native


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
