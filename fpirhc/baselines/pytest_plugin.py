"""Baselines in the test suite of a user: the fixture `fpirhc_check` and the option `--fpirhc-accept REASON`.

def test_arm(fpirhc_check):
    fpirhc_check("problems/arm.py", "RHC+FPI")
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option."""
    parser.getgroup("fpirhc").addoption(
        "--fpirhc-accept", metavar="REASON", help="measure anew and write baselines, for this reason"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Refuse an empty reason before anything runs."""
    if (reason := config.getoption("--fpirhc-accept")) is not None and not reason.strip():
        raise pytest.UsageError("--fpirhc-accept needs a reason: say why the new numbers are right")


@pytest.fixture
def fpirhc_check(request: pytest.FixtureRequest) -> Callable[..., None]:
    """Function (problem, controller) that compares a controller with its baseline, or all controllers when none is named."""

    def compare(problem: str | Path, controller: str | None = None) -> None:
        __tracebackhide__ = True
        from fpirhc.baselines.baseline import accept, check
        from fpirhc.problem_files.problem_file import load_problem

        path = request.config.rootpath / problem
        task = load_problem(str(path if path.is_file() else problem))
        reason = request.config.getoption("--fpirhc-accept")
        if reason is not None:
            accept(task, reason)
            return
        judgement = check(task, controllers=None if controller is None else [controller])
        if not judgement.holds:
            pytest.fail(judgement.text, pytrace=False)

    return compare
