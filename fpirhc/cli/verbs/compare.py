"""`fpirhc compare PROBLEM`: every controller on one problem, once or in many scenarios, and a report."""

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
    add_no_compile,
    add_optimisers,
    add_out,
    add_problem,
    add_processes,
    add_scenarios,
    add_seed,
    add_set,
    numbers,
    shard,
)
from fpirhc.cli.output import publish, reproducing, results_folder, resumable, table_writer
from fpirhc.cli.verb import ExitCode, Verb

if TYPE_CHECKING:
    from fpirhc.problem_files.problem_file import Task
    from fpirhc.studies.comparison.comparison import Comparison
    from fpirhc.studies.scenarios.scenario_comparison import ScenarioComparison

_LAB = "lab.html"  # beside the report
_EXAMPLES = (
    ("fpirhc compare two_mass --scenarios 100 --mismatch 20", "exact parameters within 20 % of the problem's"),
    (
        "fpirhc compare two_mass --scenarios 400 --mismatch 20 --processes 2",
        "continues after the 100 that are finished",
    ),
    (
        "fpirhc compare my_arm.py --scenarios 50 --mismatch 30 --controllers RHC RHC+FPI --baseline RHC --out results/arm",
        "two controllers, compared with the first",
    ),
    (
        "fpirhc compare two_mass --scenarios 10000 --mismatch 20 --cluster tcp://10.0.0.1:8786",
        "on the workers of a Dask cluster (pip install 'fpirhc[cluster]'); local: a cluster of this machine",
    ),
    ("fpirhc compare anaesthesia --cases all", "every case of the problem file; the worst one is named"),
    ("fpirhc compare anaesthesia --cases all --headline settling.bis", "by another number than the error"),
    ("fpirhc compare anaesthesia --cases elderly 'patient 0*' --processes 2", "cases by name, or by group"),
)
_NOTES = """
Scenario k of a seed is the same for every controller, whatever the number of scenarios and processes. Every exact parameter
is multiplied by a factor of its own, log-uniform between 1 - PERCENT/100 and 1 + PERCENT/100; a parameter with a spread in the
problem file is drawn from PERCENT/100 of it, 100 for all of it. Finished scenarios are kept in
scenarios.jsonl in the output folder; after an interruption or a crash the same command continues from them. A folder that
holds results of another problem, seed, mismatch or version is refused (exit code 3). With --format parquet all finished
scenarios of the folder are also files of 10 000 rows in its scenarios.parquet, written while they come. A problem is its
file, the modules beside it, and every formula.
Cases are scenarios with names: cases = fp.Cases({"heavy": {"exact.mass": 2.0}}) in the problem file, or fp.Cases.from_csv(FILE).
"""


def _add(parser: argparse.ArgumentParser) -> None:
    add_problem(parser)
    add_controllers(parser)
    add_optimisers(parser)
    add_out(parser)
    add_seed(parser, "the noise, and of scenarios")
    add_no_compile(parser)
    add_json(parser, "the table")
    text = "number that the verdict speaks of, such as in_band or rms_error.q1 (default: the problem's headline_metric, or errors)"
    parser.add_argument("--headline", metavar="NAME", help=text)
    text = "write the lab of the headline's pair beside the report, which gets a button to it; see 'fpirhc lab --help'"
    parser.add_argument("--lab", action="store_true", help=text)
    text = "use the settings in a file that 'fpirhc tune' wrote, and name them in the report"
    parser.add_argument("--tuned", metavar="FILE", help=text)
    add_set(parser, "; every controller that has it takes it")
    _add_scenarios(parser)


def _run(options: argparse.Namespace) -> ExitCode:
    _check(options)
    return _run_scenarios(options) if options.scenarios is not None or options.cases else _run_once(options)


def _run_once(options: argparse.Namespace) -> ExitCode:
    from fpirhc.problem_files.problem_file import load_problem, with_numbers_of_all

    task = load_problem(options.problem)  # what is wrong with it is said before the rest is imported
    from fpirhc.report.html import render
    from fpirhc.report.terminal import announce_backend, progress_bars
    from fpirhc.studies.comparison.compare import compare, select
    from fpirhc.studies.open_loop import with_optimisers
    from fpirhc.studies.tuned_file import check_apart, noted, read_tuned, with_tuned

    tuned = read_tuned(options.tuned, task) if options.tuned else None
    if tuned:
        check_apart(tuned.values, numbers(options.settings), Path(options.tuned))
        task = with_tuned(task, tuned.values)
    task = with_numbers_of_all(task, numbers(options.settings), options.controllers) if options.settings else task
    controllers = options.controllers
    if options.optimisers:
        named = list(select(task, controllers)) if controllers else None
        task, controllers = with_optimisers(task, options.optimisers, named), None
    folder = results_folder(options.out, task.name)
    if options.lab:
        from fpirhc.export.lab.lab import lab_of, write_lab

        pair = [name for name in task.headline or () if not controllers or name in controllers]
        write_lab(lab_of(task, options.problem, pair if len(pair) > 1 else (controllers or ())[:2]), folder / _LAB)
    with progress_bars(as_json=options.json) as progress:
        comparison = compare(
            task,
            seed=options.seed,
            controllers=controllers,
            headline=options.headline,
            compiled=not options.no_compile,
            command=reproducing(VERB, options),
            progress=progress,
        )
    comparison = noted(comparison, tuned.notes) if tuned else comparison
    announce_backend(entry.run for entry in comparison.entries)
    page = render(comparison, lab=_LAB if options.lab else "")
    publish(comparison.view, page, folder, as_json=options.json)
    return _code(comparison)


def _code(comparison: Comparison) -> ExitCode:
    if any(why.startswith("interrupted") for why in comparison.skipped.values()):
        return ExitCode.INTERRUPTED
    return ExitCode.FINISHED if comparison.entries else ExitCode.BAD_INPUT


def _add_scenarios(parser: argparse.ArgumentParser) -> None:
    """Add the options of scenarios to `compare`."""
    group = parser.add_argument_group("scenarios")
    add_scenarios(group, None, "run every controller in N paired scenarios")
    add_cases(group, "run every controller in these cases of the problem file")
    add_mismatch(group, None)
    add_processes(group)
    text = "run scenarios on the workers of a Dask cluster, tcp://HOST:PORT; local: of N processes here"
    group.add_argument("--cluster", metavar="ADDRESS", help=text)
    text = "controller that the others are compared with (default: the first)"
    group.add_argument("--baseline", metavar="NAME", help=text)
    text = "run every N-th scenario from the K-th on, here; 'fpirhc merge' joins the folders"
    group.add_argument("--shard", type=shard, metavar="K/N", help=text)
    add_format(group, "a row per scenario and controller", None)


def _check(options: argparse.Namespace) -> None:
    """Check that options of scenarios stand beside `--scenarios` or `--cases`, and not beside `--optimisers` or `--lab`."""
    from fpirhc.errors import InvalidValue

    changed = [n for n in ("scenarios", "cases", "tuned", "optimisers") if getattr(options, n)] + ["set"] * bool(
        options.settings
    )
    if options.lab and changed:
        raise InvalidValue(
            f"--lab has the controllers of the problem file in one run; leave --{changed[0]} out, or --lab"
        )
    if options.settings and (options.scenarios is not None or options.cases):
        way = "--cases" if options.cases else "--scenarios"
        raise InvalidValue(f"--set cannot be combined with {way}; write the number into the problem file")
    if options.scenarios is not None and options.cases:
        raise InvalidValue("--cases and --scenarios are two comparisons; give one of them")
    if options.cases and options.mismatch:
        raise InvalidValue(
            "--cases have the parameters that they state; leave --mismatch out, or compare --scenarios N"
        )
    if options.scenarios is None and not options.cases:
        named = [n for n in ("mismatch", "baseline", "shard", "cluster", "format") if getattr(options, n) is not None]
        named += ["processes"] if options.processes != 1 else []
        if named:
            raise InvalidValue(f"--{named[0]} needs --scenarios N, the number of scenarios")
    elif options.optimisers:
        way = "--cases" if options.cases else "--scenarios"
        raise InvalidValue(f"--optimisers cannot be combined with {way}; write the controllers into the problem file")


def _run_scenarios(options: argparse.Namespace) -> ExitCode:
    """Run the scenarios, write report.html, results.json, mismatch.png and scenarios.jsonl, and print the comparison."""
    from fpirhc.problem_files.problem_file import load_problem
    from fpirhc.report.figures import mismatch_figure, save_figure
    from fpirhc.report.html import render_scenarios

    task, write_csv = load_problem(options.problem), table_writer(options.format)
    drawn = f"scenarios_{options.mismatch or 0:g}percent"
    name = f"{'tuned_' if options.tuned else ''}{'cases' if options.cases else drawn}_seed{options.seed}"
    name += "_shard{}of{}".format(*options.shard) if options.shard else ""
    folder = results_folder(options.out, task.name, name)
    comparison = _compared(options, task, folder)
    if comparison.summaries:
        save_figure(mismatch_figure(comparison), folder / "mismatch.png")
    if options.format == "csv":
        write_csv(comparison.frames(), folder / "scenarios")
    publish(comparison.view, render_scenarios(comparison), folder, as_json=options.json)
    return ExitCode.FINISHED if comparison.summaries else ExitCode.BAD_INPUT


def _compared(options: argparse.Namespace, task: Task, folder: Path) -> ScenarioComparison:
    from fpirhc.report.terminal import progress_bars
    from fpirhc.studies.scenarios.scenario_study import LEDGER, compare_scenarios
    from fpirhc.studies.tuned_file import read_tuned

    tuned = read_tuned(options.tuned, task) if options.tuned else None
    with resumable(folder / LEDGER), progress_bars(as_json=options.json) as progress:
        return compare_scenarios(
            task,
            count=options.scenarios,
            percent=options.mismatch or 0.0,
            cases=options.cases,
            shard=options.shard or (1, 1),
            seed=options.seed,
            folder=folder,
            controllers=options.controllers,
            baseline=options.baseline,
            headline=options.headline,
            processes=options.processes,
            cluster=options.cluster,
            tuned=tuned.values if tuned else None,
            tuning=tuned.notes if tuned else None,
            compiled=not options.no_compile,
            parquet=options.format == "parquet",
            command=reproducing(VERB, options),
            progress=progress,
        )


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
        ("fpirhc compare two_mass --lab", "lab.html beside the report: the headline's pair runs while sliders move"),
        ("fpirhc compare two_mass --optimisers all", "the headline pair with every optimiser"),
        *_EXAMPLES,
    ),
    notes=_NOTES,
)
