"""Every comparison says what its controllers measure and how often they act."""

from __future__ import annotations

from dataclasses import replace

import fpirhc as fp


def test_outputs_are_measured_beside_the_state():
    """Of a plant with outputs, these and their response are given; a controller without adaptation does not use the response."""
    task = fp.load_problem("anaesthesia")
    short = replace(task.problem, duration=20 * task.problem.period, measure_from=0.0)
    comparison = fp.compare(replace(task, problem=short), seed=0, controllers=["CTC", "CTC+FPI"], compiled=False)
    assert not comparison.skipped
    known = [comparison[name].information for name in ("CTC", "CTC+FPI")]
    assert all(known)
    uses = [one.uses for one in known if one]
    chains = short.plant.chains
    responses = {name + "'" * order for name, order in chains.items()}
    assert set(chains) <= set(uses[0])
    assert set(uses[1]) - set(uses[0]) == responses
