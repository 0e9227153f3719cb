"""The frame of the command line: how its words are read, and the options that several commands have."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

_ABOUT = """Adaptive receding-horizon control by fixed-point iteration.

\b
To begin:
  fpirhc new my_plant          writes my_plant.py: put in your equations
  fpirhc review my_plant.py    asks whether adaptation can work there
  fpirhc compare my_plant.py   runs its controllers and writes a report
  fpirhc compare two_mass      does so for a shipped problem; fpirhc list has all

\b
Exit codes:
  0  finished                      1  the answer is no: of review, of probe, or of compare, where
                                      no controller follows or finishes; its verdict changes no code
  2  bad input                     3  a file or folder cannot be written
  4  the run of fpirhc run ended early, or a plan of compare --plans did not converge
  5  a metric changed (check)      6  a baseline is missing or unusable (check)
  7  a faulty installation (doctor)
  70 an error inside fpirhc        130 interrupted from the keyboard
  141 the reader of the output closed it"""
_HELP = {"help_option_names": ["-h", "--help"]}
app = typer.Typer(help=_ABOUT, context_settings=_HELP, pretty_exceptions_enable=False, rich_markup_mode=None)
MADE: list[Path] = []  # folders that this command has made, the innermost first


class Command(TyperCommand):
    """A command with examples below its options. Several values may follow one option that may be given again: `-c A B`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        options = {name: p for p in self.params if p.param_type_name == "option" for name in p.opts}
        places = sum(p.param_type_name == "argument" and p.required for p in self.params)
        # The option that may have more values, and whether its first one comes next.
        words, last, value = list[str](), "", False
        for word in args:
            name = word.partition("=")[0]
            if value:
                value = False
            elif name in options:
                last = name if getattr(options[name], "multiple", False) else ""
                value = name == word and not getattr(options[name], "is_flag", False)
            elif places > 0:
                places -= not word.startswith("-")
            elif last and not word.startswith("-"):
                words.append(last)
            words.append(word)
        return super().parse_args(ctx, words)

    def get_help(self, ctx: Any) -> str:
        text = re.sub(r"\{(\w+)\}| <(?:str|list\[str\])>", r"\1", super().get_help(ctx))
        return text.replace("x>=", "at least ").replace("<=x<=", " to ")

    def format_epilog(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002
        formatter.write(f"\nExamples:\n{self.epilog}\n")


def command(*examples: str, name: str | None = None) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return what makes a command of a function; `examples` stand below its options."""
    return app.command(name, cls=Command, epilog="\n".join(f"  fpirhc {one}" for one in examples))


def percent(text: str) -> float:
    """Return the number of a percentage, or of a default, which is a number."""
    value = -1.0
    with suppress(ValueError):
        value = float(str(text).strip().removesuffix("%"))
    if not 0 <= value < float("inf"):
        raise typer.BadParameter(f"expected percent of at least 0, such as 20%, got '{text}'")
    return value


def given(metavar: str | None, text: str, *names: str, **more: Any) -> Any:
    """Return an option, with a value unless `metavar` is None; its name is that of its place unless `names` are given."""
    return typer.Option(*names, metavar=metavar, help=text, **more)


Problem = Annotated[str, typer.Argument(metavar="PROBLEM", help="name of a shipped problem, or path of a file")]
Controller = Annotated[str, typer.Argument(metavar="CONTROLLER", help="name of a controller of the problem")]
Controllers = Annotated[list[str] | None, given("NAME ...", "only these controllers", "--controllers", "-c")]
Out = Annotated[Path | None, given("FOLDER", "folder of the results [default: in results/PROBLEM]")]
Seed = Annotated[int, given("N", "seed of noise and of what is drawn", min=0)]
Mismatch = Annotated[
    float, given("PERCENT", "draw exact parameters and dead times within this much of the file's", parser=percent)
]
_REPLACED = "replace numbers: deformation.gain=-1.2, exact.m1=1.4, start.q1=2"
Set = Annotated[list[str] | None, given("PATH=NUMBER ...", _REPLACED, "--set")]
Json = Annotated[bool, given(None, "print one JSON object", "--json")]
Verbose = Annotated[bool, given(None, "print every column and every remark", "--verbose", "-v")]
NoCompile = Annotated[bool, given(None, "no compiling: loops run in CasADi's virtual machine, slower", "--no-compile")]
Processes = Annotated[int, given("N", "number of processes", min=1)]
Count = given("N", "number of plants that are drawn at random", min=1)
Cases = Annotated[list[str] | None, given("NAME ...", "named cases of the file: names, groups, or all")]
Baselines = Annotated[Path | None, given("FOLDER", "folder of the baselines [default: baselines, beside the problem]")]


def numbers(settings: Sequence[str]) -> dict[str, Any]:
    """Return the numbers of --set by path."""
    values: dict[str, Any] = {}
    for text in settings:
        path, _, value = text.partition("=")
        parts: tuple[float, ...] = ()
        with suppress(ValueError):
            parts = tuple(map(float, value.split(",")))
        if not path.strip() or not parts:
            mend = "expected PATH=NUMBER, such as deformation.gain=-1.2, or PATH=LOWER,UPPER for an interval"
            raise typer.BadParameter(f"--set {text}: {mend}")
        values[path.strip()] = parts if len(parts) > 1 else parts[0]
    return values


def folder_of(out: Path | None, *default: str) -> Path:
    """The folder for results, made before anything runs, so that a wrong path fails at once."""
    from fpirhc.errors import writing
    from fpirhc.whole_file import missing_folders

    folder = out or Path("results", *default)
    with writing(folder, "--out"):
        MADE.extend(missing_folders(folder))
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ".fpirhc-probe").touch()
        (folder / ".fpirhc-probe").unlink()
    return folder
