"""The quick lane: `--lane quick` leaves out the tests that `lanes.txt` lists; `--measure-lanes FILE` writes such a list.

A test that is not listed belongs to the quick lane, so that a new test runs in it until somebody measures. Times are those of
the processor, user and system, children included, and so do not depend on what else the machine does. A test that reads a fixture
of a module has the fixture's time too, whoever set it up: in the quick lane the first reader would have to.

Loops are compiled without optimising, which takes a third of the time and gives the same bits; tests of C are as users have it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest

os.environ.setdefault("FPIRHC_CFLAGS", "-O0")
AS_SHIPPED = (
    "export/",
    "symbolic/",
    "optimisers/test_kernels_in_c",
    "optimisers/test_loops_in_c",
    "optimisers/test_work_vector",
)
LANES = Path(__file__).with_name("lanes.txt")
LONGEST = 0.2  # s, of all parameters of a test together, in the quick lane
_seconds = pytest.StashKey[
    dict[str, tuple[float, float]]
]()  # s, of a test itself and of the shared fixtures that it reads
_shared = pytest.StashKey[dict[tuple[str, str], float]]()  # s, by node and name of a fixture that serves several tests
_left_out = pytest.StashKey[frozenset[str]]()
_loaded = pytest.StashKey[list[str]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options."""
    group = parser.getgroup("lanes", "lanes of tests")
    group.addoption("--lane", choices=("quick",), help="run the tests of this lane only")
    group.addoption("--measure-lanes", metavar="FILE", type=Path, help="write the tests that the quick lane leaves out")


def pytest_configure(config: pytest.Config) -> None:
    """Begin with no times, and read what the quick lane leaves out."""
    config.stash[_seconds], config.stash[_shared] = {}, {}
    lines = LANES.read_text(encoding="utf-8").splitlines() if config.getoption("--lane") == "quick" else []
    config.stash[_left_out] = frozenset(line.split()[1] for line in lines if line[:1].isdigit())


def pytest_report_header(config: pytest.Config) -> list[str]:
    """Say that there are more tests."""
    count = len(config.stash[_left_out])
    return [f"quick lane: {count} tests of {LANES.name} are left out"] if count else []


def pytest_pycollect_makeitem(collector: pytest.Module | pytest.Class, name: str) -> list[pytest.Item] | None:
    """Make nothing of a test that is left out, whose parameters are often many; None: as usual."""
    return [] if _without_folder(f"{collector.nodeid}::{name}") in collector.config.stash[_left_out] else None


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Generator[None, object, object]:
    """Note which problem files are loaded meanwhile."""
    before = {*sys.modules}
    result = yield
    session.config.stash[_loaded] = sorted(n for n in {*sys.modules} - before if n.startswith("fpirhc_problem_"))
    return result


@pytest.fixture(scope="session")
def loaded_while_collecting(request: pytest.FixtureRequest) -> list[str]:
    """Modules of the problem files that this process loaded before its first test."""
    return request.config.stash[_loaded]


@pytest.fixture(autouse=True)
def compiled_as_shipped(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the compiler's flags to the package where C itself is tried."""
    if _without_folder(request.node.nodeid).startswith(AS_SHIPPED):
        monkeypatch.delenv("FPIRHC_CFLAGS", raising=False)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Add up the processor time of every test over its parameters, fixtures included."""
    seconds, shared = item.config.stash[_seconds], item.config.stash[_shared]
    begin, others = _now(), sum(shared.values())
    result = yield
    own = _now() - begin - (sum(shared.values()) - others)
    names = getattr(item, "fixturenames", ())
    read = sum(s for (node, name), s in shared.items() if name in names and item.nodeid.startswith(node))
    before, fixtures = seconds.get(_name(item), (0.0, 0.0))
    seconds[_name(item)] = before + own, max(fixtures, read)
    return result


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: Any, request: pytest.FixtureRequest) -> Generator[None, object, object]:
    """Note the time of a fixture that serves several tests."""
    begin = _now()
    result = yield
    if fixturedef.scope != "function":
        request.config.stash[_shared][fixturedef.baseid, fixturedef.argname] = _now() - begin
    return result


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Write the list, the longest first."""
    path = session.config.getoption("--measure-lanes")
    if path is None:
        return
    long = sorted((-sum(s), name) for name, s in session.config.stash[_seconds].items() if sum(s) > LONGEST)
    head = (
        "# Tests that the quick lane leaves out, with the seconds of processor time that they took: see conftest.py.\n"
    )
    path.write_text(head + "".join(f"{-s:.1f} {name}\n" for s, name in long), encoding="utf-8")


def _now() -> float:
    return sum(os.times()[:4])


def _name(item: pytest.Item) -> str:
    """File and function, without parameters."""
    return _without_folder(item.nodeid.partition("[")[0])


def _without_folder(node: str) -> str:
    return node.removeprefix("tests/")
