"""`fpirhc review PROBLEM`: questions that are answered before a run."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from fpirhc.cli.options import add_controllers, add_json, add_mismatch, add_problem, add_seed
from fpirhc.cli.verb import ExitCode, Verb

if TYPE_CHECKING:
    from fpirhc.controllers.base import Controller
    from fpirhc.review.question import Answer, Review
    from fpirhc.task.problem import Problem

_COLOURS = {"yes": "green", "caution": "yellow", "no": "red", "unknown": "magenta"}


def _add(parser: argparse.ArgumentParser) -> None:
    add_problem(parser)
    add_controllers(parser)
    add_mismatch(parser)
    text = "first probe the plant, and ask the plant as estimated: for a plant outside, whose equations nobody knows"
    parser.add_argument("--probe", action="store_true", help=text)
    add_seed(parser, "the exact parameters that are drawn")
    add_json(parser, "the text")


def _run(options: argparse.Namespace) -> ExitCode:
    from fpirhc.problem_files.problem_file import load_problem

    task = load_problem(options.problem)  # what is wrong with it is said before the rest is imported
    from fpirhc.review.review import review
    from fpirhc.studies.comparison.compare import select
    from fpirhc.studies.view import to_json

    controllers = select(task, options.controllers)
    problem = _probed(task.problem, controllers, options.seed) if options.probe else task.problem
    answers = review(problem, controllers, mismatch=options.mismatch, seed=options.seed)
    if options.json:
        print(to_json(_facts(task.name, answers)))
    else:
        _show(task.title, answers)
    return ExitCode.FINISHED if answers.ready else ExitCode.ANSWERED_NO


def _probed(problem: Problem, controllers: Mapping[str, Controller], seed: int) -> Problem:
    """The problem with the plant as a probe estimates it."""
    from fpirhc.errors import NotSupported
    from fpirhc.probing.probe import probe

    answer = probe(problem, next(iter(controllers.values())), trials=False, seed=seed)
    if answer.problem is None:
        raise NotSupported(f"review --probe: {answer.why}")
    return answer.problem


def _show(title: str, review: Review) -> None:
    """Print what to do about every no, then every answer under its controller, and the number of answers of each kind."""
    from fpirhc.report.terminal import say

    say(title, "bold")
    for about, answer in review.to_do:
        say(f"  no      {about}: {answer.question}", _COLOURS["no"], f" -> {answer.advice}", wrap=False)
    if review.to_do:
        say("\nproblem", "bold")
    _show_answers(review.problem)
    for name, answers in review.controllers.items():
        say(f"\n{name}", "bold")
        _show_answers(answers)
    counts = {v: sum(a.verdict == v for a in review.answers) for v in _COLOURS}
    say("\n" + ", ".join(f"{count} {name}" for name, count in counts.items()))


def _show_answers(answers: Iterable[Answer]) -> None:
    from fpirhc.report.terminal import say

    for one in answers:
        say(f"  {one.verdict:7s} ", _COLOURS[one.verdict], one.question, wrap=False)
        say(f"          {one.evidence}", wrap=False)
        if one.change:
            say(f"          -> {one.change}", wrap=False)


def _facts(name: str, review: Review) -> dict[str, Any]:
    return {
        "problem": name,
        "mismatch": review.mismatch,
        "ready": review.ready,
        "to_do": [{"about": about, "question": a.question, "what": a.advice} for about, a in review.to_do],
        "answers": [_answer(a) for a in review.problem],
        "controllers": {c: [_answer(a) for a in answers] for c, answers in review.controllers.items()},
    }


def _answer(answer: Answer) -> dict[str, Any]:
    return {
        "question": answer.question,
        "verdict": str(answer.verdict),
        "evidence": answer.evidence,
        "change": answer.change,
        "numbers": answer.numbers,
    }


VERB = Verb(
    name="review",
    summary="answer before a run: well posed, gains, limits, margins, convergence",
    group="start",
    add=_add,
    run=_run,
    codes={ExitCode.FINISHED: "no answer is no", ExitCode.ANSWERED_NO: "at least one answer is no"},
    examples=(
        ("fpirhc review two_mass --mismatch 20", "before a run, exact parameters within 20 %"),
        ("fpirhc review my_arm.py --controllers RHC+FPI", "one controller"),
        ("fpirhc review my_arm.py --probe", "a plant outside, as a probe of it estimates it"),
        ("fpirhc review two_mass --json", "one JSON object on standard output"),
    ),
    notes="""
An answer over the box holds for all exact parameters within PERCENT % of those in the problem file, and for all
between these and the approximate ones, with one share for all parameters.
""",
)
