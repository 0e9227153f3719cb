"""`fpirhc solve PROBLEM`: the first horizon, open loop."""

from __future__ import annotations

import argparse

from fpirhc.cli.options import add_optimisers, add_out, add_problem, positive
from fpirhc.cli.output import results_folder
from fpirhc.cli.verb import ExitCode, Verb


def _add(parser: argparse.ArgumentParser) -> None:
    add_problem(parser)
    add_out(parser)
    add_optimisers(parser)
    text = "largest stationarity of a converged plan, in the unit of the inputs (default: 1e-6)"
    parser.add_argument("--tolerance", type=positive, default=1e-6, metavar="T", help=text)


def _run(options: argparse.Namespace) -> ExitCode:
    from fpirhc.problem_files.problem_file import load_problem

    task = load_problem(options.problem)  # what is wrong with it is said before the rest is imported
    from fpirhc.report.figures import plan_figure, save_figure
    from fpirhc.report.terminal import show_plans
    from fpirhc.status import Status
    from fpirhc.studies.open_loop import solve_first

    folder = results_folder(options.out, task.name)
    solved = solve_first(task, options.optimisers or ["fixed-point"], options.tolerance)
    picture = folder / "plan.png"
    save_figure(plan_figure(task.problem, solved), picture)
    show_plans(task.name, solved, picture)
    converged = all(one.plan.status == Status.OK for one in solved)
    return ExitCode.FINISHED if converged else ExitCode.ENDED_EARLY


VERB = Verb(
    name="solve",
    summary="solve a problem's first horizon open loop, to a tolerance",
    group="run",
    add=_add,
    run=_run,
    codes={
        ExitCode.FINISHED: "every plan converged",
        ExitCode.NOT_WRITABLE: ExitCode.NOT_WRITABLE.meaning,
        ExitCode.ENDED_EARLY: "at least one plan did not converge",
    },
    examples=(
        ("fpirhc solve cart_pole --optimisers fixed-point ipopt", "the first horizon, with certificates"),
        ("fpirhc solve my_arm.py --tolerance 1e-8", "the fixed-point optimiser, to a smaller tolerance"),
    ),
)
