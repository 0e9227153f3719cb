"""`fpirhc robust PROBLEM`: the largest mismatch at which nearly all plants hold, and a search for one that fails."""

from __future__ import annotations

import argparse

from fpirhc.cli.options import add_controllers, add_fails, add_format, add_problem, add_study, share
from fpirhc.cli.output import publish, results_folder, resumable, study_settings, table_writer
from fpirhc.cli.verb import ExitCode, Verb

_SHARES = {
    "risk": "largest share of the plants of a box that may fail (default: 0.05)",
    "confidence": "with which that is said (default: 0.999)",
}


def _add(parser: argparse.ArgumentParser) -> None:
    add_problem(parser)
    add_controllers(parser)
    for name, text in _SHARES.items():
        parser.add_argument(f"--{name}", type=share, default=argparse.SUPPRESS, metavar="SHARE", help=text)
    add_fails(parser)
    add_study(parser, "robust", "the draws and the noise")
    add_format(parser, "a row per controller", None)


def _run(options: argparse.Namespace) -> ExitCode:
    from fpirhc.problem_files.problem_file import load_problem

    task = load_problem(options.problem)  # what is wrong with it is said before the rest is imported
    from fpirhc.report.html import render_charted
    from fpirhc.report.terminal import progress_bars
    from fpirhc.studies.robust import LEDGER, robust_boxes

    write_table = table_writer(options.format)
    folder = results_folder(options.out, task.name, "robust")
    with resumable(folder / LEDGER), progress_bars(as_json=options.json) as progress:
        result = robust_boxes(
            task, folder=folder, **study_settings(VERB, options, *_SHARES, "fails"), progress=progress
        )
    if options.format:
        write_table([result.to_dataframe()], folder / "robust")
    publish(result.view, render_charted(result.view), folder, as_json=options.json)
    (folder / LEDGER).unlink()  # an interrupted study goes on with it, and another one begins
    return ExitCode.FINISHED if result.boxes else ExitCode.BAD_INPUT


VERB = Verb(
    name="robust",
    summary="find the largest mismatch at which nearly every plant holds, and search it for one that fails",
    group="run",
    add=_add,
    run=_run,
    codes={
        ExitCode.BAD_INPUT: f"{ExitCode.BAD_INPUT.meaning}; or no controller could be tried",
        ExitCode.NOT_WRITABLE: ExitCode.NOT_WRITABLE.meaning,
        ExitCode.INTERRUPTED: "interrupted from the keyboard; the same command continues",
    },
    examples=(
        ("fpirhc robust two_mass --controllers CTC 'CTC+FPI (eq 6)'", "225 plants per box, at most 5 % of which fail"),
        ("fpirhc robust two_mass --controllers RHC+FPI --risk 0.01 --confidence 0.9999", "1374 plants per box"),
    ),
    notes="""
A run fails if it ends early, leaves a limit of a state by more than 2 % of its width, or has an rms error above --fails of the
reference's range. The box of P percent holds the plants that `compare --scenarios --mismatch P` draws: every exact parameter
is multiplied by a factor between 1 - P/100 and 1 + P/100, or lies in P percent of its own spread, and dead times are those of
the problem, or P percent shorter or longer, in whole cycles. Controllers know none of this.
Where none of the drawn plants fails, the share that does is at most --risk, with --confidence for all boxes of whole percents
at once. Drawn plants seldom are the worst ones: from the worst of them a search looks for a plant of the box that fails.
Finished boxes of an interrupted command are kept, and the same command goes on with them.
""",
)
