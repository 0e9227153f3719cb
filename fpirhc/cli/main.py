"""The command line: list, review, solve, run, compare, tune and check problems; begin a new one; examine the installation.

Exit codes: 0 finished; 1 some answer of `review` is no; 2 bad input (names, values, a problem file, an option); 3 a folder
or file cannot be written, or holds results of something else;
4 the run ended early because a signal was not finite (`run`; `compare` reports it) or a plan did not converge (`solve`);
5 and 6 a metric changed, or there is no usable baseline (`check`); 7 a check of the installation failed (`doctor`);
130 interrupted.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fpirhc.baselines.commands import add_commands
from fpirhc.cli import scenarios, tune
from fpirhc.cli.common import output_folder
from fpirhc.doctor.command import add_doctor
from fpirhc.scaffold.command import add_new
from fpirhc.summary import printable

if TYPE_CHECKING:
    from fpirhc.studies.comparison.compare import Comparison, Progress

OK, NOT_READY, BAD_INPUT, NOT_WRITABLE, ENDED_EARLY, INTERRUPTED = 0, 1, 2, 3, 4, 130

_EXAMPLES = """examples:
  fpirhc list                                   shipped problems
  fpirhc review two_mass --mismatch 20          what can be known before a run, exact parameters within 20 %
  fpirhc compare two_mass                       every controller of a problem, with a report
  fpirhc compare my_arm.py --controllers RHC RHC+FPI --out results/arm
  fpirhc compare two_mass --json                one JSON object on standard output
  fpirhc compare two_mass --optimisers all      the headline pair with every optimiser
  fpirhc compare two_mass --seeds 100 --mismatch 20          paired scenarios with other exact parameters
  fpirhc run two_mass "RHC+FPI" --out results   one run, saved as .npz and .png
  fpirhc solve cart_pole --optimisers fixed-point ipopt      the first horizon, open loop, with certificates
  fpirhc check                                  fresh results against the committed baselines
  fpirhc new my_arm                             a problem file and its test to start from
  fpirhc doctor                                 what is installed, and known traps

exit codes: 0 finished, 1 an answer of review is no, 2 bad input, 3 cannot write or results of something else are there,
4 the run ended early (run) or a plan did not converge (solve), 5 a metric changed (check), 6 no usable baseline (check),
7 a check of the installation failed (doctor), 130 interrupted
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    options = _parser().parse_args(arguments)
    from fpirhc.errors import FpirhcError, OutputError

    try:
        return int(options.command(options))
    except OutputError as error:
        return _complain(error, NOT_WRITABLE)
    except FpirhcError as error:
        return _complain(error, BAD_INPUT)
    except KeyboardInterrupt:
        return _complain("interrupted", INTERRUPTED)


def _complain(error: object, code: int) -> int:
    print(f"fpirhc: {printable(str(error))}", file=sys.stderr)
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="fpirhc",
        description="Adaptive receding-horizon control by fixed-point iteration.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    parser.set_defaults(command=_no_command)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    _add_review(commands)
    _add_compare(commands)
    _add_run(commands)
    _add_solve(commands)
    tune.add(commands)
    add_new(commands)
    add_doctor(commands)
    add_commands(commands)
    listing = commands.add_parser("list", help="list the shipped problems")
    listing.set_defaults(command=_list)
    return parser


def _add_review(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    command = commands.add_parser(
        "review",
        help="what can be known before a run: well posed, gains, limits, margins, convergence",
        epilog="exit codes: 0 no answer is no, 1 some answer is no, 2 bad input",
    )
    command.add_argument("problem", metavar="PROBLEM", help="name of a shipped problem, or path of a problem file")
    command.add_argument("--controllers", nargs="+", metavar="NAME", help="only these controllers (default: all)")
    command.add_argument(
        "--mismatch",
        type=float,
        default=0.0,
        metavar="P",
        help="margin around the exact parameters, percent (default: 0)",
    )
    command.add_argument("--seed", type=int, default=0, help="seed of the parameters that are drawn (default: 0)")
    command.add_argument("--json", action="store_true", help="print one JSON object instead of the text")
    command.set_defaults(command=_review)


def _add_compare(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    command = commands.add_parser(
        "compare",
        help="run several controllers on one problem, once or in many scenarios, and write a report",
        epilog=f"{_EXAMPLES}\n{scenarios.EXAMPLES}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_common(command)
    command.add_argument("--controllers", nargs="+", metavar="NAME", help="only these controllers (default: all)")
    _add_optimisers(command)
    command.add_argument("--json", action="store_true", help="print one JSON object instead of the table")
    command.add_argument(
        "--tuned", metavar="FILE", help="use the settings in a file that 'fpirhc tune' wrote, and say so"
    )
    scenarios.add_options(command)
    command.set_defaults(command=_compare)


def _add_run(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    command = commands.add_parser(
        "run",
        help="run one controller and save every signal",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_common(command)
    command.add_argument("controller", metavar="CONTROLLER", help="name of a controller in the problem file")
    command.set_defaults(command=_run)


def _add_solve(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    command = commands.add_parser(
        "solve",
        help="solve a problem's first horizon open loop, to a tolerance",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_problem(command)
    _add_optimisers(command)
    command.add_argument(
        "--tolerance", type=float, default=1e-6, help="of the stationarity, in the unit of the inputs (1e-6)"
    )
    command.set_defaults(command=_solve)


def _add_problem(command: argparse.ArgumentParser) -> None:
    command.add_argument("problem", metavar="PROBLEM", help="name of a shipped problem, or path of a problem file")
    command.add_argument("--out", metavar="FOLDER", help="where results are written (default: results/PROBLEM)")


def _add_optimisers(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--optimisers",
        nargs="+",
        metavar="NAME",
        help="fixed-point, reduced-gradient, ipopt, fatrop, qrqp, osqp, osqp-rti, or all",
    )


def _add_common(command: argparse.ArgumentParser) -> None:
    _add_problem(command)
    command.add_argument("--seed", type=int, default=0, help="seed of noise, and of scenarios (default: 0)")
    command.add_argument(
        "--no-compile", action="store_true", help="use CasADi's virtual machine even with a C compiler"
    )


def _no_command(options: argparse.Namespace) -> int:
    if options.version:
        from importlib.metadata import version

        print(f"fpirhc {version('fpirhc')}")
        return OK
    _parser().print_help()
    return OK


def _list(options: argparse.Namespace) -> int:  # noqa: ARG001
    from fpirhc.problem_files.problem_file import shipped_problems, title_of

    for name, path in shipped_problems().items():
        print(printable(f"{name:20s} {title_of(path)}"))
    return OK


def _review(options: argparse.Namespace) -> int:
    from fpirhc.problem_files.problem_file import load_problem
    from fpirhc.report.answers import review_to_json, show_review
    from fpirhc.review.review import review
    from fpirhc.studies.comparison.compare import select

    task = load_problem(options.problem)
    chosen = select(task, options.controllers)
    found = review(task.problem, chosen, mismatch=options.mismatch, seed=options.seed)
    if options.json:
        print(review_to_json(task.name, found))
    else:
        show_review(task.title, found)
    return OK if found.ready else NOT_READY


def _compare(options: argparse.Namespace) -> int:
    scenarios.check_options(options)
    return _compare_once(options) if options.seeds is None else scenarios.run(options)


def _compare_once(options: argparse.Namespace) -> int:
    from fpirhc.problem_files.problem_file import load_problem
    from fpirhc.report.html import write_report
    from fpirhc.report.terminal import announce_backend, progress_bars, show
    from fpirhc.studies.comparison.compare import compare
    from fpirhc.studies.tuning.tuned_file import noted, read_tuned, with_tuned

    task = load_problem(options.problem)
    tuned = read_tuned(options.tuned, task) if options.tuned else None
    task = with_tuned(task, tuned.values) if tuned else task
    chosen = options.controllers
    if options.optimisers:
        from fpirhc.studies.comparison.compare import select
        from fpirhc.studies.comparison.optimiser_choices import with_optimisers

        task, chosen = with_optimisers(task, options.optimisers, chosen and list(select(task, chosen))), None
    folder = _folder(options, task.name)
    with progress_bars() as progress:
        comparison = compare(
            task,
            seed=options.seed,
            controllers=chosen,
            compiled=not options.no_compile,
            command=_command(options),
            progress=progress,
        )
    comparison = noted(comparison, tuned.notes) if tuned else comparison
    report = folder / "report.html"
    write_report(comparison, report)
    announce_backend(comparison)
    if options.json:
        from fpirhc.report.as_json import to_json

        print(to_json(comparison))
    else:
        show(comparison, report)
    return _comparison_code(comparison)


def _solve(options: argparse.Namespace) -> int:
    from fpirhc.problem_files.problem_file import load_problem
    from fpirhc.report.figures import plan_figure, save_figure
    from fpirhc.report.terminal import show_plans
    from fpirhc.status import Status
    from fpirhc.studies.open_loop import solve_first

    task = load_problem(options.problem)
    folder = _folder(options, task.name)
    solved = solve_first(task, options.optimisers or ["fixed-point"], options.tolerance)
    picture = folder / "plan.png"
    save_figure(plan_figure(task.problem, solved), picture)
    show_plans(task.name, solved, picture)
    return OK if all(one.plan.status == Status.OK for one in solved) else ENDED_EARLY


def _comparison_code(comparison: Comparison) -> int:
    if any(why.startswith("interrupted") for why in comparison.skipped.values()):
        return INTERRUPTED
    if not comparison.entries:
        return BAD_INPUT
    return OK


def _run(options: argparse.Namespace) -> int:
    from fpirhc.problem_files.problem_file import load_problem
    from fpirhc.report.figures import save_figure
    from fpirhc.report.terminal import progress_bars, show_run
    from fpirhc.simulation.metrics import measure
    from fpirhc.simulation.simulate import simulate
    from fpirhc.studies.comparison.compare import select

    task = load_problem(options.problem)
    controller = select(task, [options.controller])[options.controller]
    folder = _folder(options, task.name)
    with progress_bars() as progress:
        run = simulate(
            task.problem,
            controller,
            seed=options.seed,
            name=options.controller,
            compiled=not options.no_compile,
            progress=_named(progress, options.controller),
        )
    stem = "".join(c if c.isalnum() else "_" for c in options.controller)
    run.save(folder / f"{stem}.npz")
    save_figure(run.plot(), folder / f"{stem}.png")
    show_run(run, measure(task.problem, run, task.metrics), folder / f"{stem}.npz")
    return OK if run.stop is None else ENDED_EARLY


def _named(progress: Progress, name: str):  # type: ignore[no-untyped-def]
    return lambda done, total: progress(name, done, total)


def _folder(options: argparse.Namespace, name: str) -> Path:
    return output_folder(Path(options.out) if options.out else Path("results") / name)


def _command(options: argparse.Namespace) -> str:
    """The command that reproduces this comparison."""
    import shlex

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
