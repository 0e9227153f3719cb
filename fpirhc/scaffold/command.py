"""The command `fpirhc new`."""

from __future__ import annotations

import argparse
from pathlib import Path

_EXAMPLES = """examples:
  fpirhc new my_arm                      my_arm.py, test_my_arm.py and baselines/my_arm.json in this folder
  fpirhc new my_arm --dir arms           the same in the folder arms, which is made where it is missing
  fpirhc compare my_arm.py               what to do next
  python -m pytest test_my_arm.py        what to do whenever my_arm.py was changed
  fpirhc bless my_arm.py --reason "..."  what to do when its new numbers are right

A file that exists already is never written to. Exit codes: 0 written, 2 a name that cannot be used, 3 cannot write.
"""


def add_new(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the command line."""
    command = commands.add_parser(
        "new",
        help="write a problem file, its test and its baseline to start from",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument("name", metavar="NAME", help="of the problem: letters, digits and underscores")
    command.add_argument("--dir", metavar="FOLDER", default=".", help="where the files are written (default: here)")
    command.set_defaults(command=_new)


def _new(options: argparse.Namespace) -> int:
    import shlex

    from fpirhc.scaffold.create import create_problem, first_baseline

    problem, test = create_problem(options.name, Path(options.dir))
    print(f"wrote {problem}\nwrote {test}")
    print("measuring the baseline: every controller, with several seeds and ways of computing", flush=True)
    print(f"wrote {first_baseline(problem)}")
    print("next:")
    print(f"  {shlex.join(['fpirhc', 'compare', str(problem)])}")
    print(f"  {shlex.join(['python', '-m', 'pytest', str(test)])}")
    print(f"  {shlex.join(['fpirhc', 'bless', str(problem), '--reason', '...'])}      when new numbers are right")
    return 0
