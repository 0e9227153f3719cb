"""The command `fpirhc doctor`."""

from __future__ import annotations

import argparse

_FAULTY = 7
_EXAMPLES = """examples:
  fpirhc doctor                          versions, solvers, compiler, cache, and known traps
  fpirhc doctor --json > doctor.json     one JSON object, to keep or to send
  fpirhc doctor && fpirhc compare two_mass

Each check is ok, warn (works, but look at it) or fail (results cannot be trusted), with what to do.
Exit codes: 0 no check failed, 5 at least one did.
"""


def add_doctor(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the command line."""
    command = commands.add_parser(
        "doctor",
        help="say what is installed and whether known traps are closed",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument("--json", action="store_true", help="print one JSON object instead of lines")
    command.set_defaults(command=_doctor)


def _doctor(options: argparse.Namespace) -> int:
    from fpirhc.doctor.examine import examine
    from fpirhc.doctor.finding import Outcome

    found = examine()
    print(found.json() if options.json else found.text())
    return _FAULTY if found.outcome == Outcome.FAIL else 0
