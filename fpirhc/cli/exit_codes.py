"""The exit codes of the command line, with the texts of every `--help`, README and the docs."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from types import MappingProxyType


class ExitCode(IntEnum):
    """The code that a command returns to the shell; `meaning` is its meaning in words."""

    meaning: str

    FINISHED = 0, "the command finished"
    ANSWERED_NO = 1, "review answered no"
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
