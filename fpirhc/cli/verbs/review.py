"""`fpirhc review PROBLEM`: questions that are answered before a run."""

from __future__ import annotations

import argparse

from fpirhc.cli.options import add_controllers, add_json, add_mismatch, add_problem, add_seed
from fpirhc.cli.verb import ExitCode, Verb


def _add(parser: argparse.ArgumentParser) -> None:
    add_problem(parser)
    add_controllers(parser)
    add_mismatch(parser)
    add_seed(parser, "the exact parameters that are drawn")
    add_json(parser, "the text")


def _run(options: argparse.Namespace) -> ExitCode:
    from fpirhc.problem_files.problem_file import load_problem

    task = load_problem(options.problem)  # what is wrong with it is said before the rest is imported
    from fpirhc.report.answers import review_to_json, show_review
    from fpirhc.review.review import review
    from fpirhc.studies.comparison.compare import select

    controllers = select(task, options.controllers)
    answers = review(task.problem, controllers, mismatch=options.mismatch, seed=options.seed)
    if options.json:
        print(review_to_json(task.name, answers))
    else:
        show_review(task.title, answers)
    return ExitCode.FINISHED if answers.ready else ExitCode.ANSWERED_NO


VERB = Verb(
    name="review",
    summary="answer before a run: well posed, gains, limits, margins, convergence",
    group="start",
    add=_add,
    run=_run,
    codes={ExitCode.FINISHED: "every answer is yes or unknown", ExitCode.ANSWERED_NO: "at least one answer is no"},
    examples=(
        ("fpirhc review two_mass --mismatch 20", "before a run, exact parameters within 20 %"),
        ("fpirhc review my_arm.py --controllers RHC+FPI", "one controller"),
        ("fpirhc review two_mass --json", "one JSON object on standard output"),
    ),
    notes="""
An answer over the box holds for all exact parameters within PERCENT % of those in the problem file, and for all
between these and the approximate ones, with one share for all parameters.
""",
)
