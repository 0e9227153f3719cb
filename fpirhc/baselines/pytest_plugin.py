"""Baselines in the test suite of a user: the fixture `fpirhc_check` and the option `--fpirhc-accept REASON`.

    def test_arm(fpirhc_check):
        fpirhc_check("problems/arm.py", "RHC+FPI")

With the option the same tests measure anew. One process writes the files when all tests are done, also under pytest-xdist.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from fpirhc.baselines.judging import Judgement

_measured = pytest.StashKey[list[tuple[str, str]]]()
_messages = pytest.StashKey[list[str]]()
_OUTPUT = "fpirhc_accepted"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options."""
    group = parser.getgroup("fpirhc", "baselines of control problems")
    group.addoption("--fpirhc-accept", metavar="REASON", help="measure anew and write baselines, for this reason")
    group.addoption("--fpirhc-no-compile", action="store_true", help="run loops in CasADi's virtual machine")


def pytest_configure(config: pytest.Config) -> None:
    """Refuse an empty reason before any test runs."""
    config.stash[_measured] = []
    config.stash[_messages] = []
    reason = config.getoption("--fpirhc-accept")
    if reason is not None and not reason.strip():
        raise pytest.UsageError("--fpirhc-accept needs a reason: say why the new numbers are right")


@pytest.fixture
def fpirhc_check(request: pytest.FixtureRequest) -> Callable[..., Judgement | None]:
    """Function (problem, controller) that compares a controller with its baseline, or all controllers when none is named.

    `problem` is a shipped name, or a path relative to pytest's root folder. The test fails with the metrics that changed, and
    warns of metrics that are broken.
    """
    config = request.config

    def check(problem: str | Path, controller: str | None = None) -> Judgement | None:
        __tracebackhide__ = True
        from fpirhc.baselines.check import check_baseline
        from fpirhc.baselines.printing import clean, headline, remarks, sentence
        from fpirhc.problem_files.problem_file import load_problem

        path = config.rootpath / problem
        task = load_problem(str(path if path.is_file() else problem))
        names = None if controller is None else [controller]
        compiled = not config.getoption("--fpirhc-no-compile")
        if config.getoption("--fpirhc-accept") is not None:
            _measure(config, task, names, compiled)
            return None
        judgement = check_baseline(task, controllers=names, compiled=compiled)
        if not judgement.holds:
            changed = sorted(judgement.changed, key=lambda row: -row.size)
            causes = [f"stale: {clean(cause.text)}" for cause in judgement.causes]
            lines = [headline(judgement), *causes, *map(sentence, changed), *remarks(judgement)]
            pytest.fail("\n".join(lines), pytrace=False)
        for text in judgement.faults:
            warnings.warn(f"{clean(judgement.problem)}: {clean(text)}", stacklevel=2)
        return judgement

    return check


def _measure(config: pytest.Config, task: Any, names: list[str] | None, compiled: bool) -> None:
    """Measure with the seeds of the earlier baseline, and store the result as text for the process that writes."""
    from fpirhc.baselines.baseline import to_text
    from fpirhc.baselines.check import compose_baseline, measure_expected, seeds_of
    from fpirhc.studies.comparison.compare import select

    (seed, seeds), reason = seeds_of(task), config.getoption("--fpirhc-accept")
    expectations = measure_expected(task, list(select(task, names)), seed=seed, seeds=seeds, compiled=compiled)
    baseline = compose_baseline(task, expectations, reason, seed=seed, seeds=seeds, compiled=compiled)
    config.stash[_measured].append((str(task.path.resolve()), to_text(baseline)))


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Collect the measurements of a worker of pytest-xdist."""
    for path, text in getattr(node, "workeroutput", {}).get(_OUTPUT, []):
        node.config.stash[_measured].append((path, text))


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Hand over the measurements of this worker; the main process writes those of all workers."""
    config = session.config
    if hasattr(config, "workeroutput"):
        config.workeroutput[_OUTPUT] = config.stash[_measured]
        return
    measured = config.stash[_measured]
    if not measured:
        return
    from fpirhc.baselines.check import write_merged
    from fpirhc.errors import FpirhcError
    from fpirhc.problem_files.problem_file import load_problem

    texts: dict[str, list[str]] = {}
    for path, text in sorted(measured):
        texts.setdefault(path, []).append(text)
    for path, parts in texts.items():
        try:
            written = write_merged(load_problem(path), parts, config.rootpath)
            config.stash[_messages].append(f"wrote {written}")
        except FpirhcError as error:
            config.stash[_messages].append(str(error))
            session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Print which baselines were written."""
    for line in config.stash[_messages]:
        terminalreporter.write_line(f"fpirhc: {line}")
