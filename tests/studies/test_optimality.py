"""What a comparison builds and compiles: every controller once, plans once for all that share them, and no more than is needed."""

from collections import Counter
from dataclasses import replace

import fpirhc as fp
from fpirhc.controllers.receding_horizon import RecedingHorizon
from fpirhc.controllers.wrappers.exact_model import ExactModel
from fpirhc.optimisers.plain import plain_graph

# What a comparison builds: every controller once, and the plans of a horizon once for all controllers that share it


def test_a_comparison_composes_every_controller_once(monkeypatch):
    """Loop, step by hand, timing and price have the same composition; the prediction adds those of the loops that it asks.

    The Functions of plans are built once too: one that a cycle calls, one for the first plan, and one for sampled plans.
    """
    composed: Counter[int] = Counter()
    planned: Counter[str] = Counter()
    blocks, graph = RecedingHorizon.blocks, plain_graph

    def counted_blocks(self, problem):
        composed[id(problem.plant)] += 1
        return blocks(self, problem)

    def counted_graph(ocp, settings, name):
        planned[name] += 1
        return graph(ocp, settings, name)

    monkeypatch.setattr(RecedingHorizon, "blocks", counted_blocks)
    monkeypatch.setattr("fpirhc.optimisers.plain.plain_graph", counted_graph)
    task = fp.load_problem("two_mass")
    task = replace(task, problem=replace(task.problem, duration=0.4, measure_from=0.0))
    names = ["RHC", "RHC+FPI", "RHC exact model"]
    assert isinstance(task.controllers[names[-1]], ExactModel)
    result = fp.compare(task, seed=0, controllers=names, compiled=False)
    assert [e.name for e in result.entries] == names
    assert all(e.price or not e.adaptive for e in result.entries)
    assert sorted(composed.values()) == [1, 1, 4], "the controllers, and two loops that are asked"
    assert set(planned.values()) == {1}
