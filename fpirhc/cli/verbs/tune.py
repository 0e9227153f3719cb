"""`fpirhc tune PROBLEM`: better settings, found with the same budget and cost for every controller."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from fpirhc.cli.options import (
    add_cases,
    add_controllers,
    add_format,
    add_json,
    add_mismatch,
    add_out,
    add_problem,
    add_scenarios,
    add_seed,
    whole,
)
from fpirhc.cli.output import results_folder, resumable, table_writer
from fpirhc.cli.verb import ExitCode, Verb

if TYPE_CHECKING:
    from fpirhc.studies.tune import Tuning


def _add(parser: argparse.ArgumentParser) -> None:
    add_problem(parser)
    add_out(parser, "results/PROBLEM/tuning_...")
    add_controllers(parser, "all with a search space in the problem file")
    text = "trials of every controller (default: 50)"
    parser.add_argument("--trials", type=whole(1), default=50, metavar="N", help=text)
    text = "trials that are proposed at once and run side by side, 1 learns from every trial (default: 1)"
    parser.add_argument("--population", type=whole(1), default=1, metavar="N", help=text)
    add_seed(parser, "the proposals and scenarios")
    add_scenarios(parser, 1, "scenarios in every trial (default: 1)")
    add_mismatch(parser, dead_times="dead times stay as they are")
    add_cases(parser, "tune on these cases of the problem file in place of scenarios")
    text = "tune by this number of a run, such as settling.q1 (default: the problem's headline metric, or the relative error)"
    parser.add_argument("--metric", metavar="NAME", help=text)
    text = "compile every trial of settings that decide what the loop is made of; others share one compiled loop anyway"
    compiling = parser.add_mutually_exclusive_group()
    compiling.add_argument("--compile", action="store_const", const=True, dest="compiled", help=text)
    text = "compile no loop"
    compiling.add_argument("--no-compile", action="store_const", const=False, dest="compiled", help=text)
    add_json(parser, "the table: what tuning.json holds")
    add_format(parser, "a row per setting", None)


def _run(options: argparse.Namespace) -> ExitCode:
    from fpirhc.problem_files.problem_file import load_problem

    task = load_problem(options.problem)  # what is wrong with it is said before the rest is imported
    from fpirhc.report.terminal import progress_bars
    from fpirhc.studies.tune import LEDGER, tune
    from fpirhc.studies.tuned_file import write_tuned

    write_table = table_writer(options.format)
    drawn = f"{options.scenarios}x{options.mismatch:g}percent"
    name = f"tuning_{'cases' if options.cases else drawn}_seed{options.seed}"
    name += f"_by_{options.metric}" if options.metric else ""
    name += f"_population{options.population}" if options.population > 1 else ""
    folder = results_folder(options.out, task.name, name)
    with resumable(folder / LEDGER), progress_bars(as_json=options.json) as progress:
        tuning = tune(
            task,
            trials=options.trials,
            seed=options.seed,
            folder=folder,
            controllers=options.controllers,
            count=options.scenarios,
            percent=options.mismatch,
            cases=options.cases,
            metric=options.metric,
            compiled=options.compiled,
            population=options.population,
            progress=progress,
        )
    write_tuned(tuning.facts(), folder / "tuning.json")
    if options.format:
        write_table([tuning.to_dataframe()], folder / "tuning")
    if options.json:
        print((folder / "tuning.json").read_text(encoding="utf-8"), end="")
    else:
        _show(tuning, folder / "tuning.json")
    return ExitCode.FINISHED


def _show(tuning: Tuning, saved: Path) -> None:
    from fpirhc.report.terminal import say, show_harm, show_table
    from fpirhc.summary import Column, Table, number

    title = (
        f"{tuning.problem}: {tuning.trials} trials each, seed {tuning.seed}, {tuning.conditions}, cost: {tuning.metric}"
    )
    for entry in tuning.entries:
        show_harm(entry.harm)
    table = Table(title, [Column(head) for head in ("controller, setting", "before", "after", "failed")])
    for entry in tuning.entries:
        table.add([f"{entry.name}: cost", number(entry.cost_before), number(entry.cost), str(entry.failed)])
        for path, value in entry.settings.items():
            table.add([f"  {path}", number(entry.before[path]), number(value), ""])
    show_table(table)
    if tuning.untouched:
        say(f"not tuned: {', '.join(tuning.untouched)}")
    print(f"for the problem file, below its controllers:\n\n{tuning.python()}\n")
    say(f"saved: {saved}", wrap=False)


VERB = Verb(
    name="tune",
    summary="find better settings, with the same budget and cost for every controller",
    group="run",
    add=_add,
    run=_run,
    codes={
        ExitCode.BAD_INPUT: f"{ExitCode.BAD_INPUT.meaning}; or Optuna is missing",
        ExitCode.NOT_WRITABLE: ExitCode.NOT_WRITABLE.meaning,
        ExitCode.INTERRUPTED: "interrupted from the keyboard; the same command continues",
    },
    examples=(
        ("fpirhc tune two_mass", "50 trials of every controller that may be tuned"),
        (
            "fpirhc tune two_mass --trials 200 --scenarios 5 --mismatch 20",
            "each trial in 5 scenarios; continues after the finished trials",
        ),
        (
            "fpirhc compare two_mass --scenarios 100 --mismatch 20 --tuned results/two_mass/tuning_5x20percent_seed0/tuning.json",
            "the tuned settings in other scenarios",
        ),
    ),
    notes="""
A problem file lists the settings to tune, by dotted path:
  tuning = {"RHC+FPI": {"deformation.gain": fp.LogSpan(-1.5, -0.05), "deformation.scale": fp.LogSpan(5, 500)}}
The cost is the rms error divided by the reference's range, the mean over the scenarios; runs that fail cost 10 to 20.
The scenarios of tuning are never those of a comparison, and dead times are those of the problem in all of them; cases may have
others. Cases are those that you name, and the file says which:
compare on the others.
""",
)
