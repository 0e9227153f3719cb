"""Writes the page about the command line, which conf.py does too, and README's exit codes: python docs/make_command_line.py"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from fpirhc.cli.verb import ExitCode, Verb, markdown_table, shipped

PAGE = Path(__file__).resolve().parent / "command-line.md"
README = PAGE.parents[1] / "README.md"
_TABLE = re.compile(r"\| code \| meaning \|.*?\n(?!\|)", re.DOTALL)


def meanings() -> str:
    """The table of exit codes alone, which a new command does not change."""
    rows = [f"| {code:d} | {code.meaning} |" for code in ExitCode]
    return "\n".join(["| code | meaning |", "|---|---|", *rows])


def exit_codes() -> str:
    """The table of exit codes, with the commands that return each."""
    verbs = shipped().values()
    users = {code: [f"`{verb.name}`" for verb in verbs if code in verb.exit_codes] for code in ExitCode}
    return markdown_table({c: "all" if len(n) == len(shipped()) else ", ".join(n) for c, n in users.items()})


def readme() -> str:
    """The text of README with its table of exit codes."""
    return _TABLE.sub(lambda _: f"{meanings()}\n", README.read_text(encoding="utf-8"), count=1)


def page() -> str:
    """The page's text: every command with its options, examples and exit codes."""
    head = [
        "# Command line",
        "",
        "`fpirhc COMMAND --help` prints the same. `python -m fpirhc` is the same program.",
        "",
    ]
    parts = [line for verb in shipped().values() for line in _section(verb)]
    return "\n".join([*head, *parts, "## All exit codes", "", exit_codes(), ""])


def _section(verb: Verb) -> list[str]:
    examples = [f"    {line}  # {remark}" for line, remark in verb.examples]
    options = [f"| `{_call(a)}` | {_text(a)} |" for a in _actions(verb)]
    codes = [
        f"- {code:d}: {meaning}"
        for code, meaning in verb.exit_codes.items()
        if code not in (ExitCode.CRASHED, ExitCode.OUTPUT_CLOSED)
    ]
    notes = ["```text", verb.notes.strip(), "```", ""] if verb.notes else []
    table = ["| argument | meaning |", "|---|---|", *options, ""] if options else []
    title = [f"## {verb.name}", "", f"{verb.summary[0].upper()}{verb.summary[1:]}.", ""]
    return [*title, *examples, "", *table, *notes, "Exit codes:", "", *codes, ""]


def _actions(verb: Verb) -> list[argparse.Action]:
    actions = verb.parser()._actions
    return [a for a in actions if a.help != argparse.SUPPRESS and "--help" not in a.option_strings]


def _call(action: argparse.Action) -> str:
    more = " ..." if action.nargs in ("+", "*") else ""
    value = "" if action.nargs == 0 else f"{action.metavar or action.dest.upper()}{more}"
    return " ".join(part for part in (", ".join(action.option_strings), value) if part)


def _text(action: argparse.Action) -> str:
    return (action.help or "").replace("%%", "%").replace("|", "\\|")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    README.write_text(readme(), encoding="utf-8")
