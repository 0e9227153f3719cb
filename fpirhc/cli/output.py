"""What commands write and print: results of a study, and what is said of a command that is interrupted or breaks."""

from __future__ import annotations

import argparse
import importlib.util
import os
import shlex
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from fpirhc.cli.verb import ExitCode, Verb

if TYPE_CHECKING:
    from pandas import DataFrame

    from fpirhc.studies.view import View

_MADE: list[Path] = []  # folders that this command has made, the innermost first
RESULTS = "results.json"  # what --json prints, beside every report


def results_folder(wanted: str | None, *default: str) -> Path:
    """Return the folder for results, created before anything runs. `wanted`: path of the folder; None: `results/DEFAULT...`."""
    return output_folder(Path(wanted) if wanted else Path("results", *default))


def output_folder(folder: Path) -> Path:
    """Create a folder for results before anything runs, so that a wrong path fails at once."""
    from fpirhc.errors import not_writable
    from fpirhc.whole_file import missing_folders

    try:
        _MADE.extend(missing_folders(folder))
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".fpirhc-probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise not_writable(folder, error, "--out") from None
    return folder


def remove_unused() -> None:
    """Remove the folders for results that this command has made and written nothing to."""
    from fpirhc.whole_file import remove_empty

    remove_empty(_MADE)
    _MADE.clear()


def publish(view: View, page: str, folder: Path, *, as_json: bool) -> None:
    """Write the page of a study and its JSON object, and print the object, or the verdict and the tables."""
    from fpirhc.report.terminal import show
    from fpirhc.studies.view import to_json
    from fpirhc.whole_file import write_whole

    report, facts = folder / "report.html", to_json(view.facts)
    write_whole(page, report, "report")
    write_whole(f"{facts}\n", folder / RESULTS, "report")
    if as_json:
        print(facts)
    else:
        show(view, report)


def table_writer(form: str | None) -> Callable[[Iterable[DataFrame], Path], None]:
    """Return a function that writes a table in parts to a path whose suffix becomes that of the form, or nothing without one.

    Units, `attrs["units"]` by column, stand behind the names of a CSV file: 'rms_error.q1 [m]'. A Parquet file, of one part, has
    attributes.
    """
    from fpirhc.errors import NotInstalled
    from fpirhc.whole_file import whole_file

    if form == "parquet" and importlib.util.find_spec("pyarrow") is None:
        raise NotInstalled("--format parquet needs pyarrow, which is not installed: pip install 'fpirhc[parquet]'")

    def write(parts: Iterable[DataFrame], path: Path) -> None:
        if form is not None:
            with whole_file(path.with_suffix(f".{form}"), "table") as file:
                {"csv": _write_csv, "parquet": _write_parquet}[form](parts, file)

    return write


def _write_csv(parts: Iterable[DataFrame], file: IO[bytes]) -> None:
    for k, part in enumerate(parts):
        named = part.rename(columns={name: f"{name} [{unit}]" for name, unit in part.attrs["units"].items()})
        file.write(named.to_csv(index=False, header=k == 0).encode())


def _write_parquet(parts: Iterable[DataFrame], file: IO[bytes]) -> None:
    (whole,) = parts  # a study of many scenarios has a folder of them
    whole.to_parquet(file, index=False)


_NO_NUMBERS = {
    "out",
    "json",
    "format",
    "processes",
    "cluster",
    "debug",
    "help",
}  # options that change no number of a study


def reproducing(verb: Verb, options: argparse.Namespace) -> str:
    """Return the command line that reproduces a study: its seed, and every option that is not as it is by default."""
    words = ["fpirhc", verb.name]
    for action in sorted(verb.parser()._actions, key=lambda one: (bool(one.option_strings), one.dest != "seed")):
        value = getattr(options, action.dest, None)
        if action.help is argparse.SUPPRESS or action.dest in _NO_NUMBERS or value is None:
            continue
        if not action.option_strings:
            words.append(value)
        elif action.dest == "seed" or value != action.default:
            words += _as_given(action, value)
    return shlex.join(words)


def study_settings(verb: Verb, options: argparse.Namespace, *own: str) -> dict[str, Any]:
    """Return what every study is given of a command line, and those of its own options that stand there, by name."""
    stated = {name: getattr(options, name) for name in own if hasattr(options, name)}
    common = {"controllers": options.controllers, "seed": options.seed, "compiled": not options.no_compile}
    return {**common, "command": reproducing(verb, options), **stated}


def _as_given(action: argparse.Action, value: Any) -> list[str]:
    """The words of an option; what may be given again is given once for each of its values."""
    option = action.option_strings[-1]
    if value is True:
        return [option]
    if isinstance(value, tuple):
        return [option, "/".join(map(str, value))]
    texts = [
        f"{one:.15g}" if isinstance(one, float) else str(one) for one in (value if isinstance(value, list) else [value])
    ]
    if isinstance(action, argparse._AppendAction):
        return [word for text in texts for word in (option, text)]
    return [option, *texts]


@contextmanager
def resumable(ledger: Path) -> Iterator[None]:
    """Print, after an interruption from the keyboard, where the finished results are."""
    try:
        yield
    except BaseException as error:
        if not interrupted(error):
            raise
        print(f"fpirhc: finished results are kept in {ledger}; the same command continues from them", file=sys.stderr)
        raise


REPORT = "please report it on the project's issue page, with the command line and what --debug prints"


def crash(error: BaseException) -> tuple[str, ExitCode]:
    """Return one line about an error that the library does not raise on purpose, and the exit code.

    An error of a problem file's own code is bad input; every other one is an error inside fpirhc.
    """
    from fpirhc.fields.user_code import explained, place_in_users_code

    if of_a_problem_file(error):
        return f"{place_in_users_code(error)}: {explained(error)}", ExitCode.BAD_INPUT
    if isinstance(error, MemoryError):
        return "the memory does not suffice; use fewer cycles, stages or processes", ExitCode.CRASHED
    place = traceback.extract_tb(error.__traceback__)[-1]
    name = f"{type(error).__name__} in {os.path.basename(place.filename)}, line {place.lineno}"
    text = " ".join(str(error).split())
    return f"an error inside fpirhc: {name}: {text[:_LONGEST]}; {REPORT}", ExitCode.CRASHED


def of_a_problem_file(error: BaseException) -> bool:
    """Whether the error arose in code of a problem file, or in a library that this code called."""
    problem = False
    for frame, _ in traceback.walk_tb(error.__traceback__):
        name = frame.f_globals.get("__name__", "")
        if name.startswith("fpirhc_problem_"):
            problem = True
        elif name.partition(".")[0] == "fpirhc":
            problem = False
    return problem


def interrupted(error: BaseException) -> bool:
    """Whether an error is an interruption from the keyboard; a solver that is interrupted passes it on inside a SystemError."""
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, KeyboardInterrupt) or "KeyboardInterrupt" in str(seen):
            return True
        seen = seen.__cause__ or seen.__context__
    return False


def closed_by_reader(error: BaseException) -> bool:
    """Whether the reader of the output has closed it, as `head` does; rich ends the program with 1 then."""
    return isinstance(error, BrokenPipeError) or isinstance(error.__context__, BrokenPipeError)


def silence_output() -> None:
    """Send what is still in the output's buffer nowhere: writing it at the end of the program would fail once more."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):  # an output without a file, such as that of a test
        return


_LONGEST = 300  # characters of an error's own text
