"""`fpirhc probe PROBLEM`: what the response of a plant is made of, and the adaptation that suits it."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from fpirhc.cli.options import add_json, add_problem, add_seed
from fpirhc.cli.verb import ExitCode, Verb

if TYPE_CHECKING:
    from fpirhc.controllers.base import Controller
    from fpirhc.probing.probe import Probe


def _add(parser: argparse.ArgumentParser) -> None:
    add_problem(parser)
    text = "controller that keeps the plant safe, without its deformation (default: the first one)"
    parser.add_argument("--controller", metavar="NAME", help=text)
    parser.add_argument("--cycles", type=int, metavar="N", help="of the excitation (default: 300)")
    text = "of the excitation, in the unit of the response (default: by noise and desired response); 0 only listens"
    parser.add_argument("--amplitude", type=float, metavar="A", help=text)
    text = "CSV file of a run, in place of runs: time, inputs, and what is measured"
    parser.add_argument("--recording", type=Path, metavar="FILE", help=text)
    text = "largest rms step of a command per cycle (default: 1.5 times that of the controller alone, or 2 %% of the range)"
    parser.add_argument("--chatter", type=float, metavar="C", help=text)
    parser.add_argument("--no-trials", action="store_true", help="try no candidate on the plant")
    add_seed(parser, "the excitation and the runs")
    add_json(parser, "the text")


def _run(options: argparse.Namespace) -> ExitCode:
    from fpirhc.problem_files.problem_file import load_problem

    task = load_problem(options.problem)  # what is wrong with it is said before the rest is imported
    from fpirhc.probing.probe import probe
    from fpirhc.studies.comparison.compare import select

    name, controller = _probed(select(task, None if options.controller is None else [options.controller]))
    answer = probe(
        task.problem,
        controller,
        cycles=options.cycles,
        amplitude=options.amplitude,
        recording=options.recording,
        chatter=options.chatter,
        trials=not options.no_trials,
        seed=options.seed,
    )
    if options.json:
        from fpirhc.studies.view import to_json

        print(to_json(answer.plain))
    else:
        _show(f"{task.name}: probe with {name}", answer)
    return ExitCode.FINISHED if answer.deformation is not None else ExitCode.ANSWERED_NO


def _probed(controllers: Mapping[str, Controller]) -> tuple[str, Controller]:
    """The first controller whose deformation can be replaced, by its name."""
    from fpirhc.errors import NotSupported

    reasons = []
    for name, controller in controllers.items():
        try:
            controller.with_deformation(controller.deformation)
        except NotSupported as error:
            reasons.append(f"{name}: {error}")
            continue
        return name, controller
    raise NotSupported(
        f"probe needs a controller with a deformation: choose another one by --controller. {'; '.join(reasons)}"
    )


def _show(title: str, answer: Probe) -> None:
    from fpirhc.report.terminal import say, show_table
    from fpirhc.summary import Column, Table, written_out

    estimates = Table(title, [Column("estimate", left=True), Column("value (interval)")])
    for estimate, value in answer.facts:
        estimates.add([estimate, value])
    show_table(estimates)
    if answer.trials:
        tried = Table("trials on the plant", [Column("candidate", left=True), Column("error"), Column("worst")])
        for candidate, one in answer.trials.items():
            tried.add([candidate, written_out(one.error), written_out(one.worst)])
        show_table(tried)
        say("Errors are those with adaptation over those of the controller alone.")
    for note in answer.notes:
        say(f"note: {note}")
    say(f"chosen: {answer.why}" if answer.deformation is not None else f"no adaptation: {answer.why}", "bold")
    if answer.deformation is not None:
        print(f"\nfor the controller:\n\n{answer.lines}")


VERB = Verb(
    name="probe",
    summary="excite a plant that nobody knows, and find the adaptation that suits it",
    group="run",
    add=_add,
    run=_run,
    codes={
        ExitCode.ANSWERED_NO: "no adaptation is proposed; the reason is printed",
        ExitCode.BAD_INPUT: ExitCode.BAD_INPUT.meaning,
    },
    examples=(
        ("fpirhc probe my_arm.py", "excitation for 300 cycles, candidates, trials, and a line to paste"),
        ("fpirhc probe my_arm.py --cycles 500 --no-trials", "for a machine: nothing but the excitation is run"),
        ("fpirhc probe my_arm.py --recording run.csv", "from a record of a run"),
    ),
    notes="""
The plant runs under the controller without its deformation, and a small random sequence adds to its desired response. From the
model's response to the same commands follow gain, dead time, lag, noise and drift, with intervals. A gain of the wrong sign, or one
whose sign is not certain, is refused.
""",
)
