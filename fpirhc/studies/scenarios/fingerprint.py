"""Facts on which the results of a study depend; results with other facts are never mixed with them."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterator
from dataclasses import asdict
from importlib.metadata import version
from typing import Any

from fpirhc.content import digest
from fpirhc.describe import describe
from fpirhc.problem_files.neighbours import neighbours
from fpirhc.problem_files.problem_file import Task
from fpirhc.studies.scenarios.bench import Conditions
from fpirhc.symbolic.native import machine_facts
from fpirhc.task.problem import Problem

FORMAT = 8  # of records and of these facts


def fingerprint(task: Task, conditions: Conditions) -> dict[str, Any]:
    """Return the facts, for the header of a file of results.

    Settings and formulas stand apart, so that a refusal says which of them is another one.
    """
    settings = json.dumps([describe(task.problem), describe(task.controllers)])
    return {
        "format": FORMAT,
        "problem": task.name,
        "problem file": _hash(task.path.read_bytes()),
        "modules beside the file": {name: _hash(content) for name, content in neighbours(task.path).items()},
        "settings": _hash(settings.encode()),
        "formulas and spreads": digest(task.problem, task.controllers, *_formulas(task.problem)),
        "cases": _hash(json.dumps(describe(task.cases)).encode()),
        "metrics": digest(task.metrics),
        **asdict(conditions),
        **{name: version(name) for name in ("fpirhc", "casadi", "numpy")},
        "python": ".".join(platform.python_version_tuple()[:2]),  # which writes the code of functions its own way
        "machine": platform.machine(),
        **machine_facts(),
    }


def _formulas(problem: Problem) -> Iterator[object]:
    """What the symbols say, whatever a formula read its numbers from."""
    for plant in (problem.plant, problem.real_plant):
        yield plant.equations.response
        yield plant.equations.output
    yield problem.reference_function


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
