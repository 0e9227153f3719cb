"""`fpirhc doctor`: the installation."""

from __future__ import annotations

import argparse

from fpirhc.cli.options import add_json
from fpirhc.cli.verb import ExitCode, Verb


def _add(parser: argparse.ArgumentParser) -> None:
    add_json(parser, "lines")


def _run(options: argparse.Namespace) -> ExitCode:
    from fpirhc.doctor import Outcome, examine

    diagnosis = examine()
    print(diagnosis.json() if options.json else diagnosis.text())
    return ExitCode.FAULTY_INSTALLATION if diagnosis.outcome == Outcome.FAIL else ExitCode.FINISHED


VERB = Verb(
    name="doctor",
    summary="examine the installation: versions, solvers, compiler, cache",
    add=_add,
    run=_run,
    codes={ExitCode.FINISHED: "no check failed", ExitCode.FAULTY_INSTALLATION: ExitCode.FAULTY_INSTALLATION.meaning},
    examples=(
        ("fpirhc doctor", "what is installed and whether it works"),
        ("fpirhc doctor --json", "one JSON object, to keep or to send"),
    ),
    notes="Each check is ok, warn (fpirhc works, but look at it) or fail (results cannot be trusted), with what to do.",
)
