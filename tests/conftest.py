"""Loops are compiled without optimising: a third of the time, the same bits. Tests of C are as users have it."""

from __future__ import annotations

import os

import pytest

os.environ.setdefault("FPIRHC_CFLAGS", "-O0")
AS_SHIPPED = (
    "tests/export/",
    "tests/symbolic/",
    "tests/optimisers/test_kernels_in_c",
    "tests/optimisers/test_loops_in_c",
)


@pytest.fixture(autouse=True)
def compiled_as_shipped(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the compiler's flags to the package where C itself is tried."""
    if request.node.nodeid.startswith(AS_SHIPPED):
        monkeypatch.delenv("FPIRHC_CFLAGS", raising=False)
