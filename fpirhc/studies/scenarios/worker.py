"""A process that runs scenarios for another one: `python -m fpirhc.studies.scenarios.worker`, see `cluster`.

Its first line of input has the problem file and the conditions, and it answers with the fingerprint. Every other line has jobs
[[scenarios, controller], ...], and it answers with their records.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TextIO

from fpirhc.errors import FpirhcError
from fpirhc.problem_files.problem_file import load_problem
from fpirhc.studies.scenarios.bench import Bench, Conditions
from fpirhc.studies.scenarios.fingerprint import fingerprint
from fpirhc.studies.tuned_file import with_tuned

Job = tuple[Sequence[int], str]  # numbers of scenarios, name of the controller


@dataclass(frozen=True, eq=False)
class Study:
    """What a worker runs."""

    bench: Bench  # runs scenarios
    greeting: Mapping[str, Any]  # facts on which the numbers depend


def study(opening: Mapping[str, Any]) -> Study:
    """Return the study that an opening states: the path of the problem file, tuned settings, conditions."""
    task = with_tuned(load_problem(opening["path"]), opening["tuned"])
    conditions = Conditions(**opening["conditions"])
    bench = Bench(task, conditions)
    return Study(bench, fingerprint(task, conditions))


def answered(bench: Bench, jobs: Sequence[Job]) -> list[dict[str, Any]]:
    """Return the records of jobs, or {"error": why} behind those of the jobs before one where nobody expected an error."""
    records: list[dict[str, Any]] = []
    for numbers, name in jobs:
        try:
            records += bench.records(numbers, name)
        except Exception as error:  # noqa: BLE001 -- a process that dies of it would be started again and again
            return [*records, {"error": f"scenario {numbers[0]}, controller '{name}': {error}"}]
    return records


def main() -> None:
    """Answer until the input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process; the first one ends the others
    answers = _private_output()
    opening = json.loads(sys.stdin.readline())
    try:
        ready = study(opening)
        _answer(answers, ready.greeting)
    except FpirhcError as error:
        _answer(answers, {"error": str(error)})
        return
    for line in sys.stdin:
        _answer(answers, answered(ready.bench, json.loads(line)))


def _private_output() -> TextIO:
    """The standard output for answers alone: everything that a problem file prints goes to standard error."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return answers


def _answer(answers: TextIO, value: Any) -> None:
    answers.write(json.dumps(value) + "\n")
    answers.flush()


if __name__ == "__main__":
    try:
        main()
    except BrokenPipeError:  # the parent is gone, and with it every use of an answer
        os._exit(1)
