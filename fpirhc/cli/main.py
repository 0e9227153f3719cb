"""The command line: finds the command, reads its options, runs it, and returns its exit code."""

from __future__ import annotations

import argparse
import errno
import os
import sys
from collections.abc import Mapping, Sequence

from fpirhc.cli.output import closed_by_reader, crash, interrupted, of_a_problem_file, remove_unused, silence_output
from fpirhc.cli.verb import DEBUG, GROUPS, ExitCode, Known, Parser, aligned, known, shipped, table
from fpirhc.summary import printable


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code; `--help` ends with SystemExit(0), as argparse does."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    # Matrices of loops are small: threads of the linear algebra wait for one another. NumPy reads this when it is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        code = int(_run([word for word in words if word != DEBUG]))
        sys.stdout.flush()  # a reader that has gone shows here, and not at the end of the program
        return code
    except BaseException as error:
        if isinstance(error, SystemExit) and not (closed_by_reader(error) or of_a_problem_file(error)):
            raise
        if DEBUG in words:
            import traceback

            traceback.print_exc()
        return _ended_by(error)
    finally:
        remove_unused()


def _ended_by(error: BaseException) -> int:
    """Say in one line what ended the command, and return its exit code."""
    from fpirhc.errors import FpirhcError, OutputError

    if closed_by_reader(error):
        silence_output()
        return int(ExitCode.OUTPUT_CLOSED)
    if isinstance(error, OutputError):
        return _complain(error, ExitCode.NOT_WRITABLE)
    if isinstance(error, FpirhcError):
        return _complain(error, ExitCode.BAD_INPUT)
    if interrupted(error):
        return _complain("interrupted", ExitCode.INTERRUPTED)
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return _complain(f"the disk is full ({error.filename or 'output'}): {error.strerror}", ExitCode.NOT_WRITABLE)
    return _complain(*crash(error))


def _run(words: list[str]) -> ExitCode:
    if any("\0" in word for word in words):
        from fpirhc.errors import InvalidValue

        raise InvalidValue(
            "an argument has a null character, which no name of a file or a controller has; leave it out"
        )
    verbs = known()
    if not words or words[0].startswith("-"):
        return _about(words, verbs)
    name, *rest = words
    if name == "help":  # as git, pip and cargo have it
        return _run([*rest[:1], "--help"])
    if name not in verbs:
        from fpirhc.errors import InvalidName, nearest

        mend = f" Write fpirhc compare {name}." if name.endswith(".py") else ""
        raise InvalidName(f"the command '{name}' is unknown.{mend}{nearest(name, verbs)}")
    verb = verbs[name].load()
    return verb.run(verb.options(rest))


def _about(words: list[str], verbs: Mapping[str, Known]) -> ExitCode:
    """Answer `fpirhc`, `fpirhc --help` and `fpirhc --version`."""
    commands = "\n\n".join(filter(None, (_listed(title, group, verbs) for group, title in GROUPS.items())))
    codes = table({code: code.meaning for code in ExitCode})
    parser = Parser(
        prog="fpirhc",
        usage="fpirhc [--help] [--version] COMMAND ...",
        description=f"Adaptive receding-horizon control by fixed-point iteration.\n\n{commands}",
        epilog=f"examples:\n{aligned(tuple(verb.examples[0] for verb in shipped().values()))}\n\nexit codes:\n{codes}\n\n"
        "fpirhc COMMAND --help has the options of a command, more examples, and the exit codes that it can return.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    if parser.parse_args(words).version:
        from importlib.metadata import version

        print(f"fpirhc {version('fpirhc')}")
    else:
        parser.print_help()
    return ExitCode.FINISHED


def _listed(title: str, group: str, verbs: Mapping[str, Known]) -> str:
    """The commands of a group below its title; nothing where there are none."""
    lines = [f"  {one.name:10s} {one.summary}" for one in verbs.values() if one.group == group]
    return "\n".join([f"{title}:", *lines]) if lines else ""


def _complain(error: object, code: ExitCode) -> int:
    print(f"fpirhc: {printable(str(error))}", file=sys.stderr)
    return int(code)
