"""`fpirhc limits PROBLEM`: the mismatch, latency, noise, lost samples and period at which each controller fails."""

from __future__ import annotations

import argparse

from fpirhc.cli.options import add_controllers, add_fails, add_format, add_problem, add_study
from fpirhc.cli.output import publish, results_folder, resumable, study_settings, table_writer
from fpirhc.cli.verb import ExitCode, Verb


def _add(parser: argparse.ArgumentParser) -> None:
    add_problem(parser)
    add_controllers(parser)
    text = "what grows: mismatch, latency, noise, lost, period, or names of parameters (default: these five)"
    parser.add_argument("--over", nargs="+", metavar="NAME", help=text)
    add_fails(parser)
    add_study(parser, "limits", "noise and lost samples")
    add_format(parser, "a row per controller and quantity", None)


def _run(options: argparse.Namespace) -> ExitCode:
    from fpirhc.problem_files.problem_file import load_problem

    task = load_problem(options.problem)  # what is wrong with it is said before the rest is imported
    from fpirhc.report.figures import limits_figure, save_figure
    from fpirhc.report.html import render_limits
    from fpirhc.report.terminal import progress_bars
    from fpirhc.studies.operating_limits import LEDGER, operating_limits

    write_table = table_writer(options.format)
    folder = results_folder(options.out, task.name, "limits")
    with resumable(folder / LEDGER), progress_bars(as_json=options.json) as progress:
        result = operating_limits(
            task, folder=folder, **study_settings(VERB, options, "over", "fails"), progress=progress
        )
    if result.limits:
        save_figure(limits_figure(result), folder / "limits.png")
    if options.format:
        write_table([result.to_dataframe()], folder / "limits")
    publish(result.view, render_limits(result), folder, as_json=options.json)
    (folder / LEDGER).unlink()  # an interrupted study goes on with it, and another one begins
    return ExitCode.FINISHED if result.limits else ExitCode.BAD_INPUT


VERB = Verb(
    name="limits",
    summary="find the mismatch, latency, noise, lost samples and period at which each controller fails",
    group="run",
    add=_add,
    run=_run,
    codes={
        ExitCode.BAD_INPUT: f"{ExitCode.BAD_INPUT.meaning}; or nothing could be tried",
        ExitCode.NOT_WRITABLE: ExitCode.NOT_WRITABLE.meaning,
        ExitCode.INTERRUPTED: "interrupted from the keyboard; the same command continues",
    },
    examples=(
        ("fpirhc limits two_mass", "all five, for every controller"),
        ("fpirhc limits two_mass --controllers RHC RHC+FPI --over latency noise", "two controllers, two quantities"),
        (
            "fpirhc limits two_mass --over m1 k2 --fails 0.2",
            "factors of two exact parameters, up and down, by a stricter limit",
        ),
    ),
    notes="""
A run fails if it ends early, leaves a limit of a state by more than 2 % of its width, or has an rms error above SHARE of the
reference's range. Each quantity grows from the problem as it stands until a run fails; a bisection then goes on to 5 %, or to
one cycle of latency.
  mismatch  exact = approximate (exact / approximate)^f for all parameters; f = 1 is the problem's own
  latency   commands arrive later; only what reads the problem's dead time (learners, observers) knows
  noise     deviation on every measured quantity, as a share of its range along the reference
  lost      probability that a measured quantity has no sample in a cycle
  period    of the control cycle; settings stay, and stages of the horizon keep their length where whole cycles allow
Finished runs of an interrupted command are kept, and the same command goes on with them.
""",
)
