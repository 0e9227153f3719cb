"""`fpirhc list`: the shipped problems."""

from __future__ import annotations

import argparse

from fpirhc.cli.verb import ExitCode, Verb


def _add(parser: argparse.ArgumentParser) -> None:
    """No options."""


def _run(options: argparse.Namespace) -> ExitCode:  # noqa: ARG001
    from fpirhc.problem_files.shipped import shipped_problems, title_of
    from fpirhc.summary import printable

    for name, path in shipped_problems().items():
        print(printable(f"{name:20s} {title_of(path)}"))
    return ExitCode.FINISHED


VERB = Verb(
    name="list",
    summary="list the shipped problems",
    group="start",
    add=_add,
    run=_run,
    examples=(("fpirhc list", "names and titles of the shipped problems"),),
)
