"""`fpirhc completion SHELL`: a script with which a shell completes commands, options, problems and files."""

from __future__ import annotations

import argparse

from fpirhc.cli.completion import SHELLS, instructions
from fpirhc.cli.exit_codes import ExitCode
from fpirhc.cli.verb import Verb


def _add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", metavar="SHELL", choices=SHELLS, help=", ".join(SHELLS))


def _run(options: argparse.Namespace) -> ExitCode:
    from fpirhc.cli.completion import script

    print(script(options.shell))
    return ExitCode.FINISHED


VERB = Verb(
    name="completion",
    summary="print a script with which a shell completes this command line",
    add=_add,
    run=_run,
    codes={ExitCode.BAD_INPUT: f"{ExitCode.BAD_INPUT.meaning}; or shtab is missing"},
    examples=(("fpirhc completion bash", "for bash; also zsh, fish and tcsh"),),
    notes="Put the script where the shell looks for it:\n" + "\n".join(f"  {line}" for _, line in instructions()),
)
