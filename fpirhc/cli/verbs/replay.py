"""`fpirhc replay PROBLEM CONTROLLER FILE`: what a controller would have commanded over a recording."""

from __future__ import annotations

import argparse
from pathlib import Path

from fpirhc.cli.options import add_controller, add_json, add_problem
from fpirhc.cli.verb import ExitCode, Verb


def _add(parser: argparse.ArgumentParser) -> None:
    add_problem(parser)
    add_controller(parser)
    text = "CSV file: time, what the controller is given, and the inputs that were sent where they are known"
    parser.add_argument("recording", type=Path, metavar="FILE", help=text)
    parser.add_argument("--out", type=Path, metavar="FILE", help="CSV file for the commands")
    add_json(parser, "the text")


def _run(options: argparse.Namespace) -> ExitCode:
    from fpirhc.problem_files.problem_file import load_problem

    task = load_problem(options.problem)  # what is wrong with it is said before the rest is imported
    from fpirhc.errors import InvalidValue
    from fpirhc.probing.recording import replay
    from fpirhc.report.terminal import say, show_table
    from fpirhc.studies.comparison.compare import select
    from fpirhc.studies.view import to_json
    from fpirhc.summary import Column, Table, written_out

    if options.out is not None and options.out.resolve() == options.recording.resolve():
        raise InvalidValue(f"--out {options.out} is the recording itself, which would be lost; name another file")
    answer = replay(task.problem, select(task, [options.controller])[options.controller], options.recording)
    if options.out is not None:
        answer.write(options.out)
    if options.json:
        print(to_json({"differences": answer.differences(), "statuses": dict(answer.statuses)}))
        return ExitCode.FINISHED
    heads = ("rms difference", "largest", "at time")
    table = Table(f"{task.name}: {options.controller}, replayed", [Column("input", left=True), *map(Column, heads)])
    for name, (rms, largest, at) in answer.differences().items():
        table.add([name, written_out(rms), written_out(largest), written_out(at, 6)])
    if answer.recorded is not None:
        show_table(table)
    say(f"{len(answer.times)} cycles: " + ", ".join(f"{count} {status}" for status, count in answer.statuses.items()))
    return ExitCode.FINISHED


VERB = Verb(
    name="replay",
    summary="what a controller would have commanded over a recording",
    group="run",
    add=_add,
    run=_run,
    codes={code: code.meaning for code in (ExitCode.BAD_INPUT, ExitCode.NOT_WRITABLE)},
    examples=(
        ('fpirhc replay my_arm.py "RHC+FPI" run.csv', "differences from the commands that were sent, and statuses"),
        ('fpirhc replay my_arm.py "RHC+FPI" run.csv --out commands.csv', "with the commands as a table"),
    ),
    notes="""
The plant of the record moved under other commands, so this is no closed loop: it shows what a controller makes of real
measurements, before it is trusted with the machine. Where the record has the commands that were sent, the controller is
given these as the commands that acted.
""",
)
