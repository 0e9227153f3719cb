"""The cause in a verdict is the cause in a review: one function decides, both print it."""

from __future__ import annotations

import fpirhc as fp


def test_it_is_a_cause_on_every_pair_that_it_spoils():
    task = fp.load_problem("leaking_tanks")
    adaptive = next(n for n, c in task.controllers.items() if c.deformation.adapts)
    comparison = fp.compare(task, seed=0, controllers=["RHC", adaptive], compiled=False)
    words = " The controlled response does not depend on leak, which the model has wrong and adaptation cannot correct."
    assert words in comparison.verdict[0]
