"""`fpirhc merge FOLDER ...`: join the parts of a comparison of scenarios that several machines computed."""

from __future__ import annotations

import argparse
from pathlib import Path

from fpirhc.cli.verb import ExitCode, Verb


def _add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "folders", nargs="+", type=Path, metavar="FOLDER", help="folder of a part, with its scenarios.jsonl"
    )
    parser.add_argument("--out", required=True, type=Path, metavar="FOLDER", help="folder of the whole")


def _run(options: argparse.Namespace) -> ExitCode:
    """Join the parts, and say what the whole has and how its report is made."""
    from fpirhc.studies.scenarios.scenario_study import LEDGER, merge_shards

    joined = merge_shards(options.folders, options.out)
    twice = f", {joined.twice} of them twice" if joined.twice else ""
    print(f"{joined.records} results of {joined.scenarios} scenarios, {', '.join(joined.controllers)}{twice}")
    print(f"wrote {options.out / LEDGER}")
    print(f"report: the command of the parts without --shard, and with --out {options.out}; it runs what is missing")
    return ExitCode.FINISHED


VERB = Verb(
    name="merge",
    summary="join the parts of a comparison of scenarios",
    group="run",
    add=_add,
    run=_run,
    codes={
        ExitCode.FINISHED: "the parts are joined",
        ExitCode.BAD_INPUT: "bad input: an option",
        ExitCode.NOT_WRITABLE: ExitCode.NOT_WRITABLE.meaning,
    },
    examples=(
        ("fpirhc merge results/part1 results/part2 --out results/whole", "two parts of one study"),
        (
            "fpirhc compare two_mass --scenarios 100 --mismatch 20 --out results/whole",
            "its report, with nothing left to run",
        ),
    ),
    notes="""
Parts are made with fpirhc compare PROBLEM --scenarios N --shard K/M, one on each machine of a cluster, such as the tasks of
an array job. Scenario k is the same one on every machine. Results of another problem, seed or version are refused; a problem
is its file, the modules beside it, and every formula. A result that stands in two parts is kept once.
""",
)
