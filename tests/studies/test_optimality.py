"""The excess cost of sampled plans needs no compiler where few iterations solve them."""

from dataclasses import replace

import casadi as ca

import fpirhc as fp
from fpirhc.studies.comparison import optimality
from fpirhc.studies.comparison.optimality import Optimality, measure_optimality
from fpirhc.symbolic.native import Native, native


def test_a_compiler_is_started_where_the_virtual_machine_takes_longer(monkeypatch):
    """25 short plans take the virtual machine 30 ms and a compiler a second; both find the same excess."""
    task, compiled = fp.load_problem("two_mass"), []
    controller = task.controllers["RHC, absolute effort"]  # whose plans do not converge in the run: an excess is left
    problem = replace(task.problem, duration=0.4, measure_from=0.0)
    run = fp.simulate(problem, controller, seed=0, compiled=False)

    def counted(function: ca.Function) -> Native:
        compiled.append(function.name())
        return native(function)

    def measured() -> Optimality:
        optimality._SOLVERS._known.clear()
        excess = measure_optimality(problem, controller, run, compiled=True)
        assert excess is not None
        return excess

    monkeypatch.setattr(optimality, "native", counted)
    short = measured()
    assert not compiled
    monkeypatch.setattr(optimality, "_BREAK_EVEN", 20)
    longer = measured()
    assert len(compiled) == 1
    assert short.worst > 1e-9
    assert abs(longer.worst - short.worst) < 1e-3 * short.worst
