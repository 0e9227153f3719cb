"""`fpirhc check [PROBLEM ...]`: fresh results against the committed baselines."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fpirhc.cli.options import add_baselines, add_no_compile, add_processes, percent
from fpirhc.cli.verb import ExitCode, Verb

if TYPE_CHECKING:
    from fpirhc.baselines.judging import Judgement


def _add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("problems", nargs="*", metavar="PROBLEM", help="names or files (default: all of this folder)")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="also write Markdown, for a pull request")
    text = "show every metric, not only those that changed and the headline metric (the rms errors, without one)"
    parser.add_argument("--all", action="store_true", help=text)
    text = "changes smaller than this share of the old value hold, such as 0.1%%; counts and outcomes are never ignored"
    parser.add_argument("--ignore-below", type=percent, default=0.0, metavar="PERCENT", help=text)
    add_baselines(parser)
    add_processes(parser)
    add_no_compile(parser)


def _run(options: argparse.Namespace) -> ExitCode:
    from fpirhc.baselines.baseline import problems_here
    from fpirhc.baselines.judging import ignoring
    from fpirhc.baselines.printing import MARK, check_replaceable, show_check, to_markdown
    from fpirhc.whole_file import write_whole

    if options.markdown:
        check_replaceable(options.markdown, MARK)
    problems, unchecked = (options.problems, {}) if options.problems else problems_here(Path(), options.baselines)
    measured = _judgements(options, list(dict.fromkeys(map(str, problems))))
    judgements = [ignoring(judgement, options.ignore_below / 100) for judgement in measured]
    show_check(judgements, unchecked, options.all)
    if options.markdown:
        write_whole(to_markdown(judgements, unchecked), options.markdown, "report")
    return _code(judgements)


def _judgements(options: argparse.Namespace, problems: Sequence[str]) -> list[Judgement]:
    from fpirhc.baselines.check import check_file
    from fpirhc.report.terminal import progress_bars

    with progress_bars() as progress:
        return [
            check_file(
                problem,
                baselines=options.baselines,
                compiled=not options.no_compile,
                processes=options.processes,
                progress=progress,
            )
            for problem in problems
        ]


def _code(judgements: Sequence[Judgement]) -> ExitCode:
    """The first of 2, 6, 5 that applies to one of the problems."""
    if any(j.broken for j in judgements):
        return ExitCode.BAD_INPUT
    if any(j.unusable or not j.rows for j in judgements):
        return ExitCode.NO_BASELINE
    return ExitCode.FINISHED if all(j.holds for j in judgements) else ExitCode.CHANGED


VERB = Verb(
    name="check",
    summary="compare fresh results with the committed baselines",
    group="keep",
    add=_add,
    run=_run,
    codes={
        ExitCode.FINISHED: "every metric holds",
        ExitCode.BAD_INPUT: "bad input: an option, a problem that cannot be loaded, or nothing to check",
        ExitCode.NOT_WRITABLE: ExitCode.NOT_WRITABLE.meaning,
        ExitCode.CHANGED: ExitCode.CHANGED.meaning,
        ExitCode.NO_BASELINE: ExitCode.NO_BASELINE.meaning,
    },
    examples=(
        ("fpirhc check", "every problem of ./problems, or of this folder"),
        ("fpirhc check my_arm.py two_mass", "these problems"),
        ("fpirhc check --ignore-below 0.1%", "another machine or library, whose last digits differ"),
        ("fpirhc check --markdown check.md", "for a pull request"),
    ),
    notes="""
A baseline is baselines/NAME.json beside the problem file; commit it. Without names, a problem in the folder that has
no baseline fails, unless baselines/unchecked.toml gives a reason, such as: chain_of_masses = "takes a minute".
Changes are sorted by size. A setting that changed stands first, with what changed along with it below; a change below
0.1 % is called neither better nor worse.
JUnit XML comes from pytest, in whose tests `fpirhc_check` is a fixture: pytest --junitxml check.xml.
Of several problems, the exit code is the first of 2, 6 and 5 that applies to one of them.
""",
)
