"""`fpirhc list`: the shipped problems."""

from __future__ import annotations

import argparse

from fpirhc.cli.verb import ExitCode, Verb


def _add(parser: argparse.ArgumentParser) -> None:
    """No options."""


def _run(options: argparse.Namespace) -> ExitCode:  # noqa: ARG001
    from fpirhc.problem_files.shipped import missing, shipped_groups, title_of
    from fpirhc.summary import printable

    for group, paths in shipped_groups().items():
        print(f"{group}:")
        for name, path in paths.items():
            lack = missing(path)
            print(printable(f"  {name:22s} {title_of(path)}{f' ({lack})' if lack else ''}"))
    return ExitCode.FINISHED


VERB = Verb(
    name="list",
    summary="list the shipped problems",
    group="start",
    add=_add,
    run=_run,
    examples=(("fpirhc list", "names and titles of the shipped problems"),),
)
