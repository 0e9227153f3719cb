"""`fpirhc accept PROBLEM --reason TEXT`: a new baseline."""

from __future__ import annotations

import argparse

from fpirhc.cli.options import add_baselines, add_no_compile, add_problem, add_processes, whole
from fpirhc.cli.verb import ExitCode, Verb


def _add(parser: argparse.ArgumentParser) -> None:
    add_problem(parser)
    text = "why the new numbers are right; kept in the baseline"
    parser.add_argument("--reason", required=True, metavar="TEXT", help=text)
    text = "seed of the run that is compared (default: that of the earlier baseline, or 0)"
    parser.add_argument("--seed", type=whole(0), metavar="K", help=text)
    text = "number of seeds for the bands (default: as many as before, or 8)"
    parser.add_argument("--seeds", type=whole(2), metavar="N", help=text)
    add_baselines(parser)
    add_processes(parser)
    add_no_compile(parser)


def _run(options: argparse.Namespace) -> ExitCode:
    from fpirhc.baselines.check import accept
    from fpirhc.baselines.printing import show_baseline
    from fpirhc.problem_files.problem_file import load_problem
    from fpirhc.report.terminal import progress_bars

    task = load_problem(options.problem)
    with progress_bars() as progress:
        baseline, path = accept(
            task,
            options.reason,
            seed=options.seed,
            seeds=options.seeds,
            baselines=options.baselines,
            compiled=not options.no_compile,
            processes=options.processes,
            progress=progress,
        )
    show_baseline(baseline, str(path), task.headline_metric or "")
    return ExitCode.FINISHED


VERB = Verb(
    name="accept",
    summary="measure a problem anew and write its baseline",
    group="keep",
    add=_add,
    run=_run,
    codes={ExitCode.NOT_WRITABLE: "the baseline cannot be written, or lies outside of the project"},
    examples=(
        ('fpirhc accept my_arm.py --reason "20 -> 30 stages"', "the new numbers are right, and why"),
        ('fpirhc accept my_arm.py --reason "new" --seeds 20', "bands from more seeds, where there is noise"),
    ),
    notes="""
The controllers run with other seeds where there is noise, in other ways of computing, and with start and parameters
changed by rounding errors; the band of each metric comes from its spread. Commit baselines/NAME.json with the change.
""",
)
