"""`fpirhc new NAME`: the first files of a problem."""

from __future__ import annotations

import argparse
from pathlib import Path

from fpirhc.cli.verb import ExitCode, Verb


def _add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", metavar="NAME", help="of the problem: letters, digits and underscores")
    text = "folder for the files, created where it is missing (default: the current folder)"
    parser.add_argument("--dir", metavar="FOLDER", default=".", help=text)


def _run(options: argparse.Namespace) -> ExitCode:
    import shlex

    from fpirhc.baselines.baseline import check_inside
    from fpirhc.errors import OutputError
    from fpirhc.scaffold import create_problem, first_baseline, kept_when_whole

    folder = Path(options.dir)
    with kept_when_whole(folder) as files:
        problem, test = create_problem(options.name, folder)
        files += [problem, test]
        print("measuring the baseline: every controller, with several seeds and ways of computing", flush=True)
        baseline = first_baseline(problem)
    print(f"wrote {problem}\nwrote {test}\nwrote {baseline}")
    print("next:")
    try:
        check_inside(problem, Path())
    except OutputError:  # of another project than that of this folder, from which nothing is accepted there
        print(f"  {shlex.join(['cd', str(problem.parent)])}")
        problem, test = Path(problem.name), Path(test.name)
    print(f"  {shlex.join(['fpirhc', 'compare', str(problem)])}")
    print(f"  {shlex.join(['python', '-m', 'pytest', str(test)])}")
    print(f"  {shlex.join(['fpirhc', 'accept', str(problem), '--reason', '...'])}      when new numbers are right")
    return ExitCode.FINISHED


VERB = Verb(
    name="new",
    summary="write a problem file, its test and its baseline to start from",
    group="start",
    add=_add,
    run=_run,
    codes={ExitCode.NOT_WRITABLE: "a file exists already, or the folder cannot be written"},
    examples=(
        ("fpirhc new my_arm", "my_arm.py, test_my_arm.py and baselines/my_arm.json"),
        ("fpirhc new my_arm --dir arms", "the same files in the folder arms"),
        ("fpirhc compare my_arm.py", "the next step"),
        ('fpirhc accept my_arm.py --reason "..."', "when its new numbers are right"),
    ),
    notes="""
A file that exists already is never written to, and no file stays of a command that is interrupted.
After a change of my_arm.py run: python -m pytest test_my_arm.py
""",
)
