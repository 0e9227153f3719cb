"""Loops are compiled without optimising: a third of the time, the same bits. Tests of C are as users have it; exports at night."""

import os
import signal

import pytest

os.environ.setdefault("FPIRHC_CFLAGS", "-O0")
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # a job in the background of a shell; tests interrupt processes
    signal.signal(signal.SIGINT, signal.default_int_handler)
LOOPS = ("matrices_of_many", "converging_loops_stop", "no_loop_leaves")
AS_SHIPPED = ("tests/symbolic/", *(f"tests/optimisers/test_loops_in_c.py::test_{name}" for name in LOOPS))


@pytest.fixture(autouse=True)
def compiled_as_shipped(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the compiler's flags to the package where C itself is tried."""
    if request.node.nodeid.startswith(AS_SHIPPED):
        monkeypatch.delenv("FPIRHC_CFLAGS", raising=False)
