"""The quick lane: `--lane quick` leaves out the tests that `lanes.txt` lists; `--measure-lanes FILE` writes such a list.

A test that is not listed belongs to the quick lane, so that a new test runs in it until somebody measures. Times are those of
the processor, user and system, children included, and so do not depend on what else the machine does.
"""

from __future__ import annotations

import os
from collections.abc import Generator
from pathlib import Path

import pytest

LANES = Path(__file__).with_name("lanes.txt")
LONGEST = 0.2  # s, of all parameters of a test together, in the quick lane
_seconds = pytest.StashKey[dict[str, float]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options."""
    group = parser.getgroup("lanes", "lanes of tests")
    group.addoption("--lane", choices=("quick",), help="run the tests of this lane only")
    group.addoption("--measure-lanes", metavar="FILE", type=Path, help="write the tests that the quick lane leaves out")


def pytest_configure(config: pytest.Config) -> None:
    """Begin with no times."""
    config.stash[_seconds] = {}


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect the listed tests in the quick lane."""
    if config.getoption("--lane") != "quick":
        return
    listed = {line.split()[1] for line in LANES.read_text(encoding="utf-8").splitlines() if line[:1].isdigit()}
    left_out = [item for item in items if _name(item) in listed]
    items[:] = [item for item in items if _name(item) not in listed]
    config.hook.pytest_deselected(items=left_out)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Add up the processor time of every test over its parameters, fixtures included."""
    begin = sum(os.times()[:4])
    result = yield
    seconds = item.config.stash[_seconds]
    seconds[_name(item)] = seconds.get(_name(item), 0.0) + sum(os.times()[:4]) - begin
    return result


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Write the list, the longest first."""
    path = session.config.getoption("--measure-lanes")
    if path is None:
        return
    long = sorted((-s, name) for name, s in session.config.stash[_seconds].items() if s > LONGEST)
    head = (
        "# Tests that the quick lane leaves out, with the seconds of processor time that they took: see conftest.py.\n"
    )
    path.write_text(head + "".join(f"{-s:.1f} {name}\n" for s, name in long), encoding="utf-8")


def _name(item: pytest.Item) -> str:
    """File and function, without parameters."""
    return item.nodeid.partition("[")[0].removeprefix("tests/")
