"""The commands `check` and `bless`."""

from __future__ import annotations

import argparse
from pathlib import Path

HOLDS, BAD_INPUT, CHANGED, NO_BASELINE = 0, 2, 5, 6

_EXAMPLES = """examples:
  fpirhc check                              every problem of ./problems (or of this folder), against its baseline
  fpirhc check my_arm.py two_mass           these problems
  fpirhc check --junit check.xml --markdown check.md     for a pull request
  fpirhc bless my_arm.py --reason "horizon 20 -> 30 stages: 12 % less error, as intended"

A baseline is baselines/NAME.json beside the problem file; commit it. Without names, a problem in the folder that has no
baseline fails, unless baselines/unchecked.toml gives a reason: chain_of_masses = "takes a minute".

exit codes: 0 everything holds, 2 bad input (an option, a problem that cannot be loaded, nothing to check),
3 cannot write, 5 a metric changed, 6 a baseline is missing, stale, damaged, edited by hand or of a newer format,
130 interrupted. Of several problems the first of 2, 6, 5 that applies.
"""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `check` and `bless` to the command line."""
    check = _command(commands, "check", "compare fresh results with the committed baselines")
    check.add_argument("problems", nargs="*", metavar="PROBLEM", help="names or files (default: all of this folder)")
    check.add_argument("--junit", type=Path, metavar="FILE", help="also write JUnit XML")
    check.add_argument("--markdown", type=Path, metavar="FILE", help="also write Markdown, for a pull request")
    check.add_argument("--all", action="store_true", help="show every metric, not only what changed and the rms errors")
    _add_common(check)
    check.set_defaults(command=_check)
    bless = _command(commands, "bless", "measure a problem anew and write its baseline")
    bless.add_argument("problem", metavar="PROBLEM", help="name of a shipped problem, or path of a problem file")
    bless.add_argument(
        "--reason", required=True, metavar="TEXT", help="why the new numbers are right; kept in the file"
    )
    bless.add_argument("--seed", type=int, default=0, help="seed of the run that is compared (default: 0)")
    bless.add_argument("--seeds", type=int, default=8, help="seeds that the bands are made of (default: 8)")
    _add_common(bless)
    bless.set_defaults(command=_bless)


def _command(
    commands: argparse._SubParsersAction[argparse.ArgumentParser], name: str, text: str
) -> argparse.ArgumentParser:
    return commands.add_parser(name, help=text, epilog=_EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter)


def _add_common(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--baselines", type=Path, metavar="FOLDER", help="where baselines are (default: baselines beside the problem)"
    )
    command.add_argument("--processes", type=int, default=1, metavar="N", help="how many at once (default: 1)")
    command.add_argument(
        "--no-compile", action="store_true", help="use CasADi's virtual machine even with a C compiler"
    )


def _check(options: argparse.Namespace) -> int:
    from fpirhc.baselines import junit, markdown
    from fpirhc.baselines.check import check_file
    from fpirhc.baselines.places import problems_here, write_whole
    from fpirhc.baselines.terminal import show_judgements
    from fpirhc.baselines.words import check_replaceable
    from fpirhc.report.terminal import progress_bars

    for path, mark in ((options.junit, junit.MARK), (options.markdown, markdown.MARK)):
        if path:
            check_replaceable(path, mark)
    chosen, unchecked = (options.problems, {}) if options.problems else problems_here(Path(), options.baselines)
    judgements = []
    with progress_bars() as progress:
        for name in dict.fromkeys(map(str, chosen)):
            judgements.append(
                check_file(
                    name,
                    baselines=options.baselines,
                    compiled=not options.no_compile,
                    processes=options.processes,
                    progress=progress,
                )
            )
    show_judgements(judgements, list(unchecked.items()), options.all)
    if options.junit:
        write_whole(junit.to_junit(judgements), options.junit, "report")
    if options.markdown:
        write_whole(markdown.to_markdown(judgements, list(unchecked.items())), options.markdown, "report")
    if any(j.broken for j in judgements):
        return BAD_INPUT
    if any(j.unusable or not j.rows for j in judgements):
        return NO_BASELINE
    return HOLDS if all(j.holds for j in judgements) else CHANGED


def _bless(options: argparse.Namespace) -> int:
    from fpirhc.baselines.check import bless
    from fpirhc.baselines.terminal import show_baseline
    from fpirhc.problem_files.problem_file import load_problem
    from fpirhc.report.terminal import progress_bars

    task = load_problem(options.problem)
    with progress_bars() as progress:
        baseline, path = bless(
            task,
            options.reason,
            seed=options.seed,
            seeds=options.seeds,
            baselines=options.baselines,
            compiled=not options.no_compile,
            processes=options.processes,
            progress=progress,
        )
    show_baseline(baseline, str(path))
    return HOLDS
