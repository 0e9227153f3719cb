"""`fpirhc run PROBLEM CONTROLLER`: one run, saved with every signal."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING

from fpirhc.cli.exit_codes import ExitCode
from fpirhc.cli.options import add_no_compile, add_out, add_problem, add_seed
from fpirhc.cli.output import results_folder
from fpirhc.cli.verb import Verb

if TYPE_CHECKING:
    from fpirhc.studies.comparison.compare import Progress


def _add(parser: argparse.ArgumentParser) -> None:
    add_problem(parser)
    parser.add_argument("controller", metavar="CONTROLLER", help="name of a controller in the problem file")
    add_out(parser)
    add_seed(parser, "the noise")
    add_no_compile(parser)


def _run(options: argparse.Namespace) -> ExitCode:
    from fpirhc.problem_files.problem_file import load_problem
    from fpirhc.report.figures import save_figure
    from fpirhc.report.terminal import announce_backend, progress_bars, show_run
    from fpirhc.simulation.metrics import measure
    from fpirhc.simulation.simulate import simulate
    from fpirhc.studies.comparison.compare import select

    task, name = load_problem(options.problem), options.controller
    controller = select(task, [name])[name]
    folder = results_folder(options.out, task.name)
    with progress_bars() as progress:
        run = simulate(
            task.problem,
            controller,
            seed=options.seed,
            name=name,
            compiled=not options.no_compile,
            progress=_named(progress, name),
        )
    stem = "".join(c if c.isalnum() else "_" for c in name)
    run.save(folder / f"{stem}.npz")
    save_figure(run.plot(), folder / f"{stem}.png")
    announce_backend([run])
    show_run(run, measure(task.problem, run, task.metrics), folder / f"{stem}.npz")
    return ExitCode.FINISHED if run.stop is None else ExitCode.ENDED_EARLY


def _named(progress: Progress, name: str) -> Callable[[int, int], None]:
    return lambda done, total: progress(name, done, total)


VERB = Verb(
    name="run",
    summary="run one controller and save every signal",
    add=_add,
    run=_run,
    codes={
        ExitCode.NOT_WRITABLE: ExitCode.NOT_WRITABLE.meaning,
        ExitCode.ENDED_EARLY: "the run ended early because a signal was not finite",
    },
    examples=(
        ('fpirhc run two_mass "RHC+FPI"', "one run, saved as .npz and .png"),
        ('fpirhc run my_arm.py "RHC+FPI" --out results --seed 3', "another folder, other noise"),
    ),
)
