"""Paired scenarios: the part of `fpirhc compare` for `--scenarios N`."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from fpirhc.cli.exit_codes import ExitCode
from fpirhc.cli.options import add_mismatch, add_processes, add_scenarios
from fpirhc.cli.output import RESULTS, results_folder, resumable

if TYPE_CHECKING:
    from fpirhc.problem_files.problem_file import Task
    from fpirhc.studies.scenarios.scenario_comparison import ScenarioComparison

EXAMPLES = (
    ("fpirhc compare two_mass --scenarios 100 --mismatch 20", "exact parameters within 20 % of the problem's"),
    (
        "fpirhc compare two_mass --scenarios 400 --mismatch 20 --processes 2",
        "continues after the 100 that are finished",
    ),
    (
        "fpirhc compare my_arm.py --scenarios 50 --mismatch 30 --controllers RHC RHC+FPI --baseline RHC --out results/arm",
        "two controllers, compared with the first",
    ),
)
NOTES = """
Scenario k of a seed is the same for every controller, whatever the number of scenarios and processes. Every exact parameter
is multiplied by a factor of its own, log-uniform between 1 - PERCENT/100 and 1 + PERCENT/100; a parameter with a spread in the
problem file is drawn from PERCENT/100 of it, 100 for all of it. Finished scenarios are kept in
scenarios.jsonl in the output folder; after an interruption or a crash the same command continues from them. A folder that
holds results of another problem, seed, mismatch or version is refused (exit code 3).
"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of scenarios to `compare`."""
    group = parser.add_argument_group("scenarios")
    add_scenarios(group, None, "run every controller in N paired scenarios")
    add_mismatch(group, None)
    add_processes(group)
    text = "controller that the others are compared with (default: the first)"
    group.add_argument("--baseline", metavar="NAME", help=text)


def check_options(options: argparse.Namespace) -> None:
    """Check that options of scenarios stand beside `--scenarios`, and not beside `--optimisers`.

    Raises:
        InvalidValue: options that cannot be combined; the message names the remedy.
    """
    from fpirhc.errors import InvalidValue

    if options.scenarios is None:
        named = [n for n in ("mismatch", "baseline") if getattr(options, n) is not None]
        named += ["processes"] if options.processes != 1 else []
        if named:
            raise InvalidValue(f"--{named[0]} needs --scenarios N, the number of scenarios")
    elif options.optimisers:
        raise InvalidValue(
            "--optimisers cannot be combined with --scenarios; write the controllers into the problem file"
        )


def run(options: argparse.Namespace) -> ExitCode:
    """Run the scenarios, write report.html, results.json, mismatch.png and scenarios.jsonl, and print the comparison."""
    from fpirhc.problem_files.problem_file import load_problem
    from fpirhc.report.figures import save_figure
    from fpirhc.report.page import write_page
    from fpirhc.report.scenarios import mismatch_figure, write_scenarios
    from fpirhc.report.terminal import show
    from fpirhc.studies.view import to_json

    task = load_problem(options.problem)
    kind = "tuned_scenarios" if options.tuned else "scenarios"
    name = f"{kind}_{options.mismatch or 0:g}percent_seed{options.seed}"
    folder = results_folder(options.out, task.name, name)
    comparison = _compared(options, task, folder)
    report = folder / "report.html"
    write_scenarios(comparison, report)
    view = comparison.view
    write_page(f"{to_json(view.facts)}\n", folder / RESULTS)
    if comparison.summaries:
        save_figure(mismatch_figure(comparison), folder / "mismatch.png")
    if options.json:
        print(to_json(view.facts))
    else:
        show(view, report)
    return ExitCode.FINISHED if comparison.summaries else ExitCode.BAD_INPUT


def _compared(options: argparse.Namespace, task: Task, folder: Path) -> ScenarioComparison:
    from fpirhc.report.terminal import progress_bars
    from fpirhc.studies.scenarios.scenario_study import LEDGER, compare_scenarios
    from fpirhc.studies.tuning.tuned_file import read_tuned

    tuned = read_tuned(options.tuned, task) if options.tuned else None
    with resumable(folder / LEDGER), progress_bars() as progress:
        return compare_scenarios(
            task,
            count=options.scenarios,
            percent=options.mismatch or 0.0,
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


def _command(options: argparse.Namespace) -> str:
    """The command that reproduces these scenarios."""
    words = ["fpirhc", "compare", options.problem, "--scenarios", str(options.scenarios), "--seed", str(options.seed)]
    words += ["--mismatch", f"{options.mismatch or 0:g}"]
    for name in ("baseline", "tuned"):
        if getattr(options, name):
            words += [f"--{name}", getattr(options, name)]
    if options.controllers:
        words += ["--controllers", *options.controllers]
    if options.no_compile:
        words.append("--no-compile")
    return shlex.join(words)
