"""`fpirhc compare PROBLEM`: every controller on one problem, once or in many scenarios, and a report."""

from __future__ import annotations

import argparse
import shlex
from typing import TYPE_CHECKING

from fpirhc.cli import scenarios
from fpirhc.cli.exit_codes import ExitCode
from fpirhc.cli.options import add_controllers, add_json, add_no_compile, add_optimisers, add_out, add_problem, add_seed
from fpirhc.cli.output import RESULTS, results_folder
from fpirhc.cli.verb import Verb

if TYPE_CHECKING:
    from fpirhc.studies.comparison.comparison import Comparison


def _add(parser: argparse.ArgumentParser) -> None:
    add_problem(parser)
    add_controllers(parser)
    add_optimisers(parser)
    add_out(parser)
    add_seed(parser, "the noise, and of scenarios")
    add_no_compile(parser)
    add_json(parser, "the table")
    text = "use the settings in a file that 'fpirhc tune' wrote, and name them in the report"
    parser.add_argument("--tuned", metavar="FILE", help=text)
    scenarios.add_options(parser)


def _run(options: argparse.Namespace) -> ExitCode:
    scenarios.check_options(options)
    return _run_once(options) if options.scenarios is None else scenarios.run(options)


def _run_once(options: argparse.Namespace) -> ExitCode:
    from fpirhc.problem_files.problem_file import load_problem

    task = load_problem(options.problem)  # what is wrong with it is said before the rest is imported
    from fpirhc.report.html import write_report
    from fpirhc.report.page import write_page
    from fpirhc.report.terminal import announce_backend, progress_bars, show
    from fpirhc.studies.comparison.compare import compare, select
    from fpirhc.studies.comparison.optimiser_choices import with_optimisers
    from fpirhc.studies.tuning.tuned_file import noted, read_tuned, with_tuned
    from fpirhc.studies.view import to_json

    tuned = read_tuned(options.tuned, task) if options.tuned else None
    task = with_tuned(task, tuned.values) if tuned else task
    controllers = options.controllers
    if options.optimisers:
        named = list(select(task, controllers)) if controllers else None
        task, controllers = with_optimisers(task, options.optimisers, named), None
    folder = results_folder(options.out, task.name)
    with progress_bars() as progress:
        comparison = compare(
            task,
            seed=options.seed,
            controllers=controllers,
            compiled=not options.no_compile,
            command=_command(options),
            progress=progress,
        )
    comparison = noted(comparison, tuned.notes) if tuned else comparison
    report = folder / "report.html"
    write_report(comparison, report)
    view = comparison.view
    write_page(f"{to_json(view.facts)}\n", folder / RESULTS)
    announce_backend(entry.run for entry in comparison.entries)
    if options.json:
        print(to_json(view.facts))
    else:
        show(view, report)
    return _code(comparison)


def _code(comparison: Comparison) -> ExitCode:
    if any(why.startswith("interrupted") for why in comparison.skipped.values()):
        return ExitCode.INTERRUPTED
    return ExitCode.FINISHED if comparison.entries else ExitCode.BAD_INPUT


def _command(options: argparse.Namespace) -> str:
    """The command that reproduces this comparison."""
    words = ["fpirhc", "compare", options.problem, "--seed", str(options.seed)]
    if options.controllers:
        words += ["--controllers", *options.controllers]
    if options.optimisers:
        words += ["--optimisers", *options.optimisers]
    if options.tuned:
        words += ["--tuned", options.tuned]
    if options.no_compile:
        words.append("--no-compile")
    return shlex.join(words)


VERB = Verb(
    name="compare",
    summary="run several controllers on one problem, once or in many scenarios, and write a report",
    group="run",
    add=_add,
    run=_run,
    codes={
        ExitCode.FINISHED: "at least one controller ran; the report shows how each run ended",
        ExitCode.BAD_INPUT: f"{ExitCode.BAD_INPUT.meaning}; or no controller could run",
        ExitCode.NOT_WRITABLE: ExitCode.NOT_WRITABLE.meaning,
    },
    examples=(
        ("fpirhc compare two_mass", "every controller of a problem; report.html and results.json"),
        ("fpirhc compare my_arm.py --controllers RHC RHC+FPI --out results/arm", "two controllers, another folder"),
        ("fpirhc compare two_mass --json", "one JSON object on standard output"),
        ("fpirhc compare two_mass --optimisers all", "the headline pair with every optimiser"),
        *scenarios.EXAMPLES,
    ),
    notes=scenarios.NOTES,
)
