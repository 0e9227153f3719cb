"""The contract of a command, a value that names it, explains it, adds its options and runs it; and the commands that there are."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cache, partial
from importlib.metadata import EntryPoint, entry_points
from types import MappingProxyType
from typing import NoReturn

from fpirhc.members import within

GROUPS = {"start": "to start", "run": "to run", "keep": "to keep results right", "tools": "tools"}  # in this order
DEBUG = "--debug"  # an option of every command; `main` reads it before the command does


@dataclass(frozen=True)
class Verb:
    """One command of the command line.

    Args:
        name: word after `fpirhc`.
        summary: one line for `fpirhc --help`.
        add: adds arguments and options to a parser; it may import modules that it needs for their choices.
        run: does the work with the options and returns an exit code; heavy libraries are imported here.
        codes: exit codes that this command returns, with their meanings; those of `OF_EVERY_VERB` are added.
        examples: pairs of a command line and a remark; the first one also stands in `fpirhc --help`.
        notes: paragraphs below the examples.
        group: heading under which it stands in `fpirhc --help`, a key of `GROUPS`.
    """

    name: str
    summary: str
    add: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], ExitCode]
    examples: tuple[tuple[str, str], ...]
    codes: Mapping[ExitCode, str] = field(default_factory=dict)
    notes: str = ""
    group: str = "tools"

    @property
    def exit_codes(self) -> dict[ExitCode, str]:
        """Every exit code that the command can return, in order, with its meaning."""
        known = {**OF_EVERY_VERB, **self.codes}
        return {code: known[code] for code in sorted(known)}

    def parser(self) -> argparse.ArgumentParser:
        """Return the parser of the command's own options, with examples and exit codes below them."""
        notes = f"\n{self.notes.strip()}\n" if self.notes else ""
        parser = Parser(
            prog=f"fpirhc {self.name}",
            description=f"{self.summary[0].upper()}{self.summary[1:]}.",
            epilog=f"examples:\n{aligned(self.examples)}\n{notes}\nexit codes:\n{table(self.exit_codes)}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        self.add(parser)
        parser.add_argument(DEBUG, action="store_true", help="print the traceback of an error")
        return parser

    def options(self, words: Sequence[str]) -> argparse.Namespace:
        """Return the options that the words after the command give.

        Raises:
            InvalidName: an unknown option, or a word too many; the nearest option is offered.
        """
        return self.parser().parse_args(words)


class Parser(argparse.ArgumentParser):
    """A parser whose error is one sentence with what was expected, the nearest valid name, and where the help is."""

    def error(self, message: str) -> NoReturn:
        """Raise the error."""
        from fpirhc.errors import InvalidName, InvalidValue

        for pattern, tell in _MISTAKES.items():
            match = re.match(pattern, message, re.DOTALL)
            if match:
                kind = InvalidName if tell in (_unknown, _no_choice) else InvalidValue
                raise kind(f"{tell(self, *match.groups())} See {self.prog} --help.")
        raise InvalidValue(f"{message.removeprefix('argument ')}. See {self.prog} --help.")


def _unknown(parser: Parser, words: str) -> str:
    from fpirhc.errors import nearest

    first = words.split()[0]
    if first.startswith("-"):
        from fpirhc.task.problem import Problem

        options = [name for name in parser._option_string_actions if name.startswith("--")]
        if first[2:].replace("-", "_") in Problem.__dataclass_fields__:
            return f"the option '{first}' is unknown; write Problem({first[2:].replace('-', '_')}=...) in the problem file."
        return f"the option '{first}' is unknown.{nearest(first, options)}"
    needed = [str(one.metavar or one.dest) for one in parser._actions if not one.option_strings]
    return f"'{first}' is a word too many; write {' '.join((parser.prog, *needed))} [options]."


def _no_choice(_: Parser, name: str, value: str, choices: str) -> str:
    from fpirhc.errors import nearest

    valid = re.findall(r"[^\s,']+", choices)
    return f"{name} '{value}' is unknown.{nearest(value, valid)}"


def _missing(parser: Parser, names: str) -> str:
    helps = {str(one.metavar or one.dest): one.help for one in parser._actions if not one.option_strings}
    lacking = [f"{name} ({helps[name]})" if helps.get(name) else name for name in names.split(", ")]
    return f"{' and '.join(lacking)} {'is' if len(lacking) == 1 else 'are'} missing."


def _no_value(parser: Parser, name: str, _: str) -> str:
    option = name.split("/")[0]
    return f"{name} needs a value: {option} {parser._option_string_actions[option].metavar}."


def _wrong_value(_: Parser, name: str, kind: str, value: str) -> str:
    return f"{name} {value}: expected {_KINDS.get(kind, f'a value of the kind {kind}')}."


def _ambiguous(_: Parser, option: str, options: str) -> str:
    return f"the option '{option}' may be {', '.join(options.split(', ')[:-1])} or {options.split(', ')[-1]}; write the whole name."


_KINDS = {"int": "a whole number", "float": "a number"}
_MISTAKES: dict[str, Callable[..., str]] = {  # what argparse says, by the sentence that says it to a user
    r"unrecognized arguments: (.*)": _unknown,
    r"argument (\S+): invalid choice: '(.*)' \(choose from (.*)\)": _no_choice,
    r"the following arguments are required: (.*)": _missing,
    r"argument (\S+): expected (one|at least one) argument": _no_value,
    r"argument (\S+): invalid (\w+) value: (.*)": _wrong_value,
    r"ambiguous option: (\S+) could match (.*)": _ambiguous,
}


def aligned(examples: tuple[tuple[str, str], ...]) -> str:
    """Return examples one per line, with aligned remarks; the remark of a long example has a line of its own."""
    room = max((len(line) for line, _ in examples if len(line) <= _WIDEST), default=0)
    lines = []
    for line, remark in examples:
        if len(line) <= room:
            lines.append(f"  {line:{room}s}   {remark}".rstrip())
        else:
            lines += [f"  {line}", f"  {'':{room}s}   {remark}".rstrip()]
    return "\n".join(lines)


_WIDEST = 52  # characters of an example with its remark on the same line


class ExitCode(IntEnum):
    """The code that a command returns to the shell; `meaning` is its meaning in words."""

    meaning: str

    FINISHED = 0, "the command finished"
    ANSWERED_NO = 1, "review answered no, or probe proposes no adaptation"
    BAD_INPUT = 2, "bad input: a name, a value, a problem file, or an option"
    NOT_WRITABLE = 3, "a file or folder cannot be written, or holds results of something else"
    ENDED_EARLY = 4, "a run ended early (its reason is named), or a plan did not converge"
    CHANGED = 5, "a metric changed"
    NO_BASELINE = 6, "a baseline is missing, stale, damaged, edited by hand, or of a newer format"
    FAULTY_INSTALLATION = 7, "a check of the installation failed"
    CRASHED = 70, "an error inside fpirhc; --debug prints the traceback"
    INTERRUPTED = 130, "interrupted from the keyboard; finished results are kept"
    OUTPUT_CLOSED = 141, "the reader of the output closed it before the end, as head does"

    def __new__(cls, value: int, meaning: str) -> ExitCode:
        """Make a member of a number and its meaning."""
        member = int.__new__(cls, value)
        member._value_ = value
        member.meaning = meaning
        return member


def _meanings(*codes: ExitCode) -> Mapping[ExitCode, str]:
    return MappingProxyType({code: code.meaning for code in codes})


OF_EVERY_VERB = _meanings(
    ExitCode.FINISHED, ExitCode.BAD_INPUT, ExitCode.CRASHED, ExitCode.INTERRUPTED, ExitCode.OUTPUT_CLOSED
)


def table(meanings: Mapping[ExitCode, str]) -> str:
    """Return the codes in order, one per line, as `--help` shows them."""
    return "\n".join(f"  {code:<4d} {meanings[code]}" for code in sorted(meanings))


def markdown_table(users: Mapping[ExitCode, str]) -> str:
    """Return the table of all codes for README and docs; `users` names the commands that can return each."""
    rows = [f"| {code:d} | {code.meaning} | {users.get(code, '')} |" for code in ExitCode]
    return "\n".join(["| code | meaning | commands |", "|---|---|---|", *rows])


GROUP = "fpirhc.verbs"


@dataclass(frozen=True)
class Known:
    """A command that exists.

    Args:
        name: its name.
        summary: its line in `fpirhc --help`.
        group: the group there.
        load: function that loads it.
    """

    name: str
    summary: str
    group: str
    load: Callable[[], Verb]


@cache
def shipped() -> dict[str, Verb]:
    """Return the commands of this package by name: the value `VERB` of every module of the package `verbs`."""
    verbs = [module.VERB for module in within("fpirhc.cli.verbs")]
    return {verb.name: verb for verb in sorted(verbs, key=lambda verb: verb.name)}


def known() -> dict[str, Known]:
    """Return all commands by name; those of other packages are loaded at their first use and replace none of this package."""
    verbs = {
        verb.name: Known(verb.name, verb.summary, verb.group, partial(_itself, verb)) for verb in shipped().values()
    }
    for point in entry_points(group=GROUP):
        if point.name in verbs:
            print(f"fpirhc: '{_origin(point)}' adds a command '{point.name}', which exists: ignored", file=sys.stderr)
            continue
        verbs[point.name] = Known(point.name, f"(of the package {_origin(point)})", "tools", partial(_loaded, point))
    return verbs


def _itself(verb: Verb) -> Verb:
    return verb


def _loaded(point: EntryPoint) -> Verb:
    from fpirhc.errors import NotSupported

    try:
        verb = point.load()
    except Exception as error:  # a package of somebody else may raise anything while it is imported
        raise NotSupported(
            f"the command '{point.name}' of the package {_origin(point)} cannot be imported "
            f"({type(error).__name__}: {error}); repair that package or remove it"
        ) from error
    if not isinstance(verb, Verb):
        raise NotSupported(
            f"the command '{point.name}' of the package {_origin(point)} is a {type(verb).__name__}: "
            f"its entry point {GROUP} must name a value of fpirhc.cli.verb.Verb"
        )
    return verb


def _origin(point: EntryPoint) -> str:
    return point.dist.name if point.dist else point.value
