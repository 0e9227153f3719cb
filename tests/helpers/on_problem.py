"""The shipped examples of controllers, each with the problem that it is tried on."""

from dataclasses import replace
from typing import Any

import fpirhc as fp
from fpirhc.conformance import Example, two_masses
from fpirhc.contracts import Controller


def on_problem(member: Any) -> tuple[Controller, fp.Problem]:
    """A controller of the shipped examples with its problem."""
    if not isinstance(member, Example):
        return member, two_masses()
    task = fp.load_problem(member.problem) if member.problem else None
    problem = replace(task.problem if task else two_masses(), **{"measure_from": 0.0, **member.changes})
    return (task.controllers[member.controller] if task and member.value is None else member.value), problem


def named(values: Any) -> list[str]:
    """Names of parameters: class and number."""
    return [f"{type(v).__name__}-{k}" for k, v in enumerate(values)]
