"""Every observer keeps the public laws, and every law catches an observer that breaks it."""

from __future__ import annotations

import pytest

from fpirhc.conformance import check_observer
from fpirhc.members import examples

BELIEFS = examples("observers")


@pytest.mark.parametrize("number", range(len(BELIEFS)), ids=[f"{type(b).__name__}-{k}" for k, b in enumerate(BELIEFS)])
def test_belief_laws(number: int) -> None:
    check_observer(BELIEFS[number], seed=4)
