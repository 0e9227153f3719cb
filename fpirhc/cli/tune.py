"""`fpirhc tune PROBLEM`: better settings, found with the same budget and cost for every controller."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from fpirhc.cli.common import output_folder

if TYPE_CHECKING:
    from fpirhc.studies.tuning.tune import Tuning

_EXAMPLES = """examples:
  fpirhc tune two_mass                                       50 trials of every controller that may be tuned
  fpirhc tune two_mass --trials 200 --seeds 5 --mismatch 20  each trial in 5 scenarios; goes on from the trials there are
  fpirhc compare two_mass --seeds 100 --mismatch 20 --tuned results/two_mass/tuning_5x20percent_seed0/tuning.json

A problem file says what may be tuned, by dotted path:
  tuning = {"RHC+FPI": {"deformation.gain": fp.LogSpan(-1.5, -0.05), "deformation.scale": fp.LogSpan(5, 500)}}
The cost is the rms error over the reference's range, the mean over the scenarios; runs that fail cost 10 to 20.
The scenarios of tuning are never those of a comparison.

exit codes: 0 finished, 2 bad input or Optuna is missing, 3 cannot write or results of something else are there,
130 interrupted (the same command goes on)
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the command line."""
    command = commands.add_parser(
        "tune",
        help="find better settings, with the same budget and cost for every controller",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument("problem", metavar="PROBLEM", help="name of a shipped problem, or path of a problem file")
    command.add_argument(
        "--out", metavar="FOLDER", help="where results are written (default: results/PROBLEM/tuning_...)"
    )
    command.add_argument(
        "--controllers", nargs="+", metavar="NAME", help="only these controllers (default: all that may be)"
    )
    command.add_argument("--trials", type=int, default=50, metavar="N", help="trials of every controller (default: 50)")
    command.add_argument("--seed", type=int, default=0, help="seed of proposals and scenarios (default: 0)")
    command.add_argument("--seeds", type=int, default=1, metavar="N", help="scenarios in every trial (default: 1)")
    command.add_argument(
        "--mismatch", type=float, default=0.0, metavar="P", help="draw exact parameters within P percent (default: 0)"
    )
    command.add_argument(
        "--metric",
        metavar="NAME",
        help="tune by this number of a run, such as settling.q1 (default: the relative error)",
    )
    command.add_argument(
        "--compile", action="store_true", help="compile every trial: pays where its runs last longer than the compiler"
    )
    command.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Tune, write tuning.json, print the table and the lines for the problem file."""
    from fpirhc.problem_files.problem_file import load_problem
    from fpirhc.report.terminal import progress_bars
    from fpirhc.studies.tuning.tune import LEDGER, tune
    from fpirhc.studies.tuning.tuned_file import write_tuned

    task = load_problem(options.problem)
    name = f"tuning_{options.seeds}x{options.mismatch:g}percent_seed{options.seed}"
    name += f"_by_{options.metric}" if options.metric else ""
    folder = output_folder(Path(options.out) if options.out else Path("results") / task.name / name)
    try:
        with progress_bars() as progress:
            found = tune(
                task,
                trials=options.trials,
                seed=options.seed,
                folder=folder,
                controllers=options.controllers,
                count=options.seeds,
                percent=options.mismatch,
                metric=options.metric,
                compiled=options.compile,
                progress=progress,
            )
    except KeyboardInterrupt:
        print(f"fpirhc: what is finished is kept in {folder / LEDGER}; the same command goes on", file=sys.stderr)
        raise
    write_tuned(found.facts(), folder / "tuning.json")
    _show(found, folder / "tuning.json")
    return 0


def _show(found: Tuning, saved: Path) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    console = Console()
    title = f"{found.problem}: {found.trials} trials each, seed {found.seed}, {found.conditions}, cost: {found.metric}"
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), title=title)
    table.add_column("controller, setting", no_wrap=True)
    for head in ("before", "after", "failed"):
        table.add_column(head, justify="right")
    for entry in found.entries:
        name = entry.name.replace("[", "\\[")
        table.add_row(f"{name}: cost", f"{entry.cost_before:.4g}", f"{entry.cost:.4g}", str(entry.failed))
        for path, value in entry.settings.items():
            table.add_row(f"  {path}", f"{entry.before[path]:.4g}", f"{value:.4g}", "")
    console.print(table)
    if found.untouched:
        console.print(f"not tuned: {', '.join(found.untouched)}", markup=False, highlight=False)
    print(f"for the problem file, below its controllers:\n\n{found.python()}\n")
    console.print(f"saved: {saved}", markup=False, highlight=False, soft_wrap=True)
