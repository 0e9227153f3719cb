"""`fpirhc compare PROBLEM --seeds N --mismatch P`: paired scenarios."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from fpirhc.cli.common import output_folder

EXAMPLES = """examples of scenarios:
  fpirhc compare two_mass --seeds 100 --mismatch 20                 exact parameters within 20 % of the problem's
  fpirhc compare two_mass --seeds 400 --mismatch 20 --processes 2   goes on from the 100 that are there
  fpirhc compare my_arm.py --seeds 50 --mismatch 30 --controllers RHC RHC+FPI --baseline RHC --out results/arm30

Scenario k of a seed is the same for every controller, and whatever the number of seeds and processes. Every exact
parameter is multiplied by a factor that is log-uniform between 1 - P and 1 + P. Finished scenarios are kept in
scenarios.jsonl in the output folder; after an interruption or a crash the same command goes on from there. A folder
that holds results of another problem, seed, mismatch or version is refused (exit code 3).
"""


def add_options(command: argparse.ArgumentParser) -> None:
    """Add the options of scenarios to `compare`."""
    group = command.add_argument_group("scenarios")
    group.add_argument("--seeds", type=int, metavar="N", help="run every controller in N paired scenarios")
    group.add_argument(
        "--mismatch", type=float, metavar="P", help="draw exact parameters within P percent (default: 0)"
    )
    group.add_argument("--processes", type=int, default=1, metavar="K", help="worker processes (default: 1)")
    group.add_argument(
        "--baseline", metavar="NAME", help="controller that the others are compared with (default: the first)"
    )


def check_options(options: argparse.Namespace) -> None:
    """Raise if options of scenarios are given without scenarios, or with what they cannot be combined with.

    Raises:
        InvalidValue: with what to give instead.
    """
    from fpirhc.errors import InvalidValue

    if options.seeds is None:
        given = [n for n in ("mismatch", "baseline") if getattr(options, n) is not None]
        given += ["processes"] if options.processes != 1 else []
        if given:
            raise InvalidValue(f"--{given[0]} needs --seeds N, the number of scenarios")
    elif options.optimisers:
        raise InvalidValue("--optimisers cannot be combined with --seeds; write the controllers into the problem file")


def run(options: argparse.Namespace) -> int:
    """Run the scenarios, write report.html, mismatch.png and scenarios.jsonl, and print what was found."""
    from fpirhc.problem_files.problem_file import load_problem
    from fpirhc.report.figures import save_figure
    from fpirhc.report.scenarios import mismatch_figure, show_scenarios, write_scenarios
    from fpirhc.report.terminal import progress_bars
    from fpirhc.studies.scenarios.scenario_study import LEDGER, compare_scenarios
    from fpirhc.studies.tuning.tuned_file import read_tuned

    task = load_problem(options.problem)
    tuned = read_tuned(options.tuned, task) if options.tuned else None
    percent = options.mismatch or 0.0
    kind = "tuned_scenarios" if tuned else "scenarios"
    default = Path("results") / task.name / f"{kind}_{percent:g}percent_seed{options.seed}"
    folder = output_folder(Path(options.out) if options.out else default)
    try:
        with progress_bars() as progress:
            found = compare_scenarios(
                task,
                count=options.seeds,
                percent=percent,
                seed=options.seed,
                folder=folder,
                controllers=options.controllers,
                baseline=options.baseline,
                processes=options.processes,
                tuned=tuned.values if tuned else None,
                tuning=tuned.notes if tuned else None,
                compiled=not options.no_compile,
                command=_command(options),
                progress=progress,
            )
    except KeyboardInterrupt:
        print(f"fpirhc: what is finished is kept in {folder / LEDGER}; the same command goes on", file=sys.stderr)
        raise
    write_scenarios(found, folder / "report.html")
    if found.summaries:
        save_figure(mismatch_figure(found), folder / "mismatch.png")
    if options.json:
        from fpirhc.report.scenarios import scenarios_json

        print(scenarios_json(found))
    else:
        show_scenarios(found, folder / "report.html")
    return 0 if found.summaries else 2


def _command(options: argparse.Namespace) -> str:
    """The command that reproduces these scenarios."""
    import shlex

    words = ["fpirhc", "compare", options.problem, "--seeds", str(options.seeds), "--seed", str(options.seed)]
    words += ["--mismatch", f"{options.mismatch or 0:g}"]
    for name in ("baseline", "tuned"):
        if getattr(options, name):
            words += [f"--{name}", getattr(options, name)]
    if options.controllers:
        words += ["--controllers", *options.controllers]
    if options.no_compile:
        words.append("--no-compile")
    return shlex.join(words)
