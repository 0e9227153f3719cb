"""The command line: finds the command, reads its options, runs it, and returns its exit code."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence

from fpirhc.cli.discovery import Known, former_names, known, shipped
from fpirhc.cli.exit_codes import ExitCode, table
from fpirhc.cli.verb import aligned
from fpirhc.summary import printable


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code; wrong options end with SystemExit(2), as argparse does."""
    from fpirhc.errors import FpirhcError, OutputError

    try:
        return int(_run(list(sys.argv[1:] if arguments is None else arguments)))
    except OutputError as error:
        return _complain(error, ExitCode.NOT_WRITABLE)
    except FpirhcError as error:
        return _complain(error, ExitCode.BAD_INPUT)
    except KeyboardInterrupt:
        return _complain("interrupted", ExitCode.INTERRUPTED)
    except Exception:  # noqa: BLE001 -- without this, Python's own exit code 1 would read as the answer no
        import traceback

        traceback.print_exc()
        return _complain("this is an error inside fpirhc, or in a problem file's own code", ExitCode.CRASHED)


def _run(words: list[str]) -> ExitCode:
    verbs = known()
    if not words or words[0].startswith("-"):
        return _about(words, verbs)
    name, *rest = words
    if name in former_names():
        new = former_names()[name]
        print(f"fpirhc: the command '{name}' is now '{new}'; the next version removes the old name", file=sys.stderr)
        name = new
    if name not in verbs:
        from fpirhc.errors import InvalidName, nearest

        raise InvalidName(f"the command '{name}' is unknown.{nearest(name, verbs)}")
    verb = verbs[name].load()
    return verb.run(verb.parser().parse_args(rest))


def _about(words: list[str], verbs: Mapping[str, Known]) -> ExitCode:
    """Answer `fpirhc`, `fpirhc --help` and `fpirhc --version`."""
    commands = "\n".join(f"  {one.name:10s} {one.summary}" for one in verbs.values())
    codes = table({code: code.meaning for code in ExitCode})
    parser = argparse.ArgumentParser(
        prog="fpirhc",
        usage="fpirhc [--help] [--version] COMMAND ...",
        description=f"Adaptive receding-horizon control by fixed-point iteration.\n\ncommands:\n{commands}",
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


def _complain(error: object, code: ExitCode) -> int:
    print(f"fpirhc: {printable(str(error))}", file=sys.stderr)
    return int(code)
