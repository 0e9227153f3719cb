"""`fpirhc sweep PROBLEM --over PATH=LOW:HIGH:COUNT`: what every controller does over one setting, or over two."""

from __future__ import annotations

import argparse

from fpirhc.cli.options import add_controllers, add_format, add_problem, add_study
from fpirhc.cli.output import publish, results_folder, resumable, study_settings, table_writer
from fpirhc.cli.verb import ExitCode, Verb


def _add(parser: argparse.ArgumentParser) -> None:
    add_problem(parser)
    text = "a setting with its values, COUNT of them from LOW to HIGH, by equal factors with :log; once or twice"
    parser.add_argument("--over", action="append", required=True, metavar="PATH=LOW:HIGH:COUNT", help=text)
    add_controllers(parser)
    text = "any number of a run, such as settling.q1 or status.OK (default: the problem's headline metric, or the relative error)"
    parser.add_argument("--metric", metavar="NAME", help=text)
    add_study(parser, "sweep_PATH...", "noise, the same in every run")
    add_format(parser, "a row per run", "csv")


def _run(options: argparse.Namespace) -> ExitCode:
    from fpirhc.problem_files.problem_file import load_problem

    task = load_problem(options.problem)  # what is wrong with it is said before the rest is imported
    from fpirhc.report.figures import save_figure, sweep_figure
    from fpirhc.report.html import render_sweep
    from fpirhc.report.terminal import progress_bars
    from fpirhc.studies.sweep import LEDGER, Axis, sweep

    write_table = table_writer(options.format)
    axes = [Axis.parsed(text) for text in options.over]
    folder = results_folder(options.out, task.name, "_".join(["sweep", *(axis.path for axis in axes)]))
    with resumable(folder / LEDGER), progress_bars(as_json=options.json) as progress:
        result = sweep(task, axes, folder=folder, **study_settings(VERB, options, "metric"), progress=progress)
    write_table([result.to_dataframe()], folder / "sweep")
    save_figure(sweep_figure(result), folder / "sweep.png")
    publish(result.view, render_sweep(result), folder, as_json=options.json)
    return ExitCode.FINISHED


VERB = Verb(
    name="sweep",
    summary="draw a map of what every controller does over one setting, or over two",
    group="run",
    add=_add,
    run=_run,
    codes={
        ExitCode.NOT_WRITABLE: ExitCode.NOT_WRITABLE.meaning,
        ExitCode.INTERRUPTED: "interrupted from the keyboard; the same command continues",
    },
    examples=(
        ("fpirhc sweep two_mass --over deformation.gain=-3:-0.1:30", "errors over the gain, a line per controller"),
        (
            "fpirhc sweep two_mass --over deformation.gain=-3:-0.1:30 --over exact.m1=0.5:2:20:log --controllers RHC RHC+FPI",
            "two maps, and which of the two is better where",
        ),
        (
            'fpirhc sweep two_mass --over start.q1=1:3.4:13 --over "start.q1\'=-15:15:13" --controllers RHC+FPI',
            "from where it converges",
        ),
    ),
    notes="""
A path that begins with exact. (the parameter of what moves), approximate., known., start. or a field of the problem, such as
limits.inputs.Q1.1 or dead_time.inputs.Q1, is the problem's. Every other path is the controllers'; those without it are the same
along it. Settings that can be live are numbers of one compiled loop; for others every value has a loop of its own, and the
report says so. Finished runs are kept, and the same command goes on with them.
sweep.csv (with --format parquet sweep.parquet) has a row per run; units stand behind the names, or in
the attributes of a table in Parquet.
""",
)
