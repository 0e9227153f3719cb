"""Options that several commands share: one name, one meaning, one text."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from pathlib import Path

Parser = argparse.ArgumentParser | argparse._ArgumentGroup


def add_problem(parser: Parser) -> None:
    """PROBLEM."""
    parser.add_argument("problem", metavar="PROBLEM", help="name of a shipped problem, or path of a problem file")


def add_controller(parser: Parser) -> None:
    """CONTROLLER."""
    text = "name of a controller of the problem; 'fpirhc review PROBLEM' lists them"
    parser.add_argument("controller", metavar="CONTROLLER", help=text)


def add_out(parser: Parser, default: str = "results/PROBLEM") -> None:
    """--out FOLDER."""
    parser.add_argument("--out", metavar="FOLDER", help=f"folder for the results (default: {default})")


def add_controllers(parser: Parser, default: str = "all") -> None:
    """--controllers NAME ..."""
    parser.add_argument("--controllers", nargs="+", metavar="NAME", help=f"only these controllers (default: {default})")


def add_optimisers(parser: Parser) -> None:
    """--optimisers NAME ...; the names are those of `optimiser_choices`."""
    parser.add_argument("--optimisers", action=_Optimisers, nargs="+", metavar="NAME")


def add_seed(parser: Parser, use: str) -> None:
    """--seed K."""
    parser.add_argument("--seed", type=whole(0), default=0, metavar="K", help=f"seed of {use} (default: 0)")


def add_set(parser: Parser, more: str) -> None:
    """--set PATH=NUMBER, again and again."""
    text = (
        "another number for a setting, such as deformation.gain=-1.2, limits.inputs.Q1=-50,20, exact.m1=1.4 or start.q1=2; what a "
        "controller has itself is its own, else the problem's"
    )
    parser.add_argument(
        "--set", action="append", default=[], dest="settings", metavar="PATH=NUMBER", help=f"{text}{more}"
    )


def numbers(settings: Sequence[str]) -> dict[str, float | tuple[float, ...]]:
    """Return numbers by path from texts 'PATH=NUMBER', or 'PATH=LOWER,UPPER' for an interval."""
    from fpirhc.errors import InvalidValue

    values: dict[str, float | tuple[float, ...]] = {}
    for text in settings:
        path, _, value = text.partition("=")
        try:
            if not path.strip():
                raise ValueError
            parts = tuple(float(part) for part in value.split(","))
        except ValueError:
            raise InvalidValue(
                f"--set {text}: expected PATH=NUMBER, such as deformation.gain=-1.2, or PATH=LOWER,UPPER for an interval"
            ) from None
        values[path.strip()] = parts if len(parts) > 1 else parts[0]
    return values


def whole(least: int) -> Callable[[str], int]:
    """Return the type of an option: a whole number of at least `least`."""

    def number(text: str) -> int:
        if text.strip().isdecimal() and int(text) >= least:
            return int(text)
        raise argparse.ArgumentTypeError(f"expected a whole number of at least {least}, got '{text}'")

    return number


def shard(text: str) -> tuple[int, int]:
    """K/N, a part of several."""
    part, mark, parts = text.partition("/")
    if mark and part.isdecimal() and parts.isdecimal() and 1 <= int(part) <= int(parts):
        return int(part), int(parts)
    raise argparse.ArgumentTypeError(f"expected K/N with K from 1 to N, such as 3/100, got '{text}'")


def positive(text: str) -> float:
    """A number above 0."""
    return _number(text, text, lambda one: 0 < one < math.inf, "a number above 0")


def share(text: str) -> float:
    """A number above 0 and below 1."""
    return _number(text, text, lambda one: 0 < one < 1, "a number above 0 and below 1")


def add_mismatch(parser: Parser, default: float | None = 0.0, dead_times: str = "dead times likewise") -> None:
    """--mismatch PERCENT, with the same meaning for parameters wherever it stands; see `fpirhc.plant.plant`."""
    text = (
        f"every exact parameter lies within PERCENT %% of its value in the problem file, or of its spread, and {dead_times} "
        "(default: 0)"
    )
    parser.add_argument("--mismatch", type=mismatch, default=default, metavar="PERCENT", help=text)


def percent(text: str) -> float:
    """A percentage, '20%' or '20'."""
    digits = text.strip().removesuffix("%")
    return _number(text, digits, lambda one: 0 <= one < 100, "percent from 0 to below 100, such as 20%")


def mismatch(text: str) -> float:
    """A percentage that may be 100 and more, where every parameter has a spread; the plant says whether it has."""
    digits = text.strip().removesuffix("%")
    return _number(text, digits, lambda one: 0 <= one < math.inf, "percent of at least 0, such as 20%")


def _number(text: str, digits: str, fits: Callable[[float], bool], expected: str) -> float:
    try:
        value = float(digits)
    except ValueError:
        value = math.nan
    if fits(value):
        return value
    raise argparse.ArgumentTypeError(f"expected {expected}, got '{text}'")


def add_scenarios(parser: Parser, default: int | None, text: str) -> None:
    """--scenarios N."""
    parser.add_argument("--scenarios", type=whole(1), default=default, metavar="N", help=text)


def add_cases(parser: Parser, text: str) -> None:
    """--cases PATTERN ..."""
    what = "names or groups with wildcards, such as 'adult*', or all"
    parser.add_argument("--cases", nargs="+", metavar="PATTERN", help=f"{text}: {what}")


def add_baselines(parser: Parser) -> None:
    """--baselines FOLDER."""
    text = "folder of the baselines (default: baselines beside the problem)"
    parser.add_argument("--baselines", type=Path, metavar="FOLDER", help=text)


def add_processes(parser: Parser) -> None:
    """--processes N."""
    parser.add_argument("--processes", type=whole(1), default=1, metavar="N", help="number of processes (default: 1)")


def add_no_compile(parser: Parser) -> None:
    """--no-compile."""
    text = "run loops in CasADi's virtual machine even where there is a C compiler"
    parser.add_argument("--no-compile", action="store_true", help=text)


def add_json(parser: Parser, instead: str) -> None:
    """--json."""
    parser.add_argument("--json", action="store_true", help=f"print one JSON object instead of {instead}")


def add_fails(parser: Parser) -> None:
    """--fails SHARE."""
    text = "rms error from which a run has failed, as a share of the reference's range (default: 0.5)"
    parser.add_argument("--fails", type=positive, default=argparse.SUPPRESS, metavar="SHARE", help=text)


def add_study(parser: Parser, folder: str, seeds: str) -> None:
    """--seed, --out, --no-compile and --json of a study that prints a table."""
    add_seed(parser, seeds)
    add_out(parser, f"results/PROBLEM/{folder}")
    add_no_compile(parser)
    add_json(parser, "the table")


def add_format(parser: Parser, table: str, default: str | None) -> None:
    """--format csv or parquet."""
    text = f"kind of the file with {table} (default: {default or 'no such file'}); parquet needs pyarrow"
    parser.add_argument("--format", choices=("csv", "parquet"), default=default, help=text)


class _Optimisers(argparse._StoreAction):
    """An option whose help names every optimiser, which takes the import of all of them."""

    @property
    def help(self) -> str:
        """The names, found when they are shown."""
        from fpirhc.studies.open_loop import optimiser_choices

        return f"{', '.join(optimiser_choices())}, or all"

    @help.setter
    def help(self, text: str | None) -> None:
        """Take no other text."""
