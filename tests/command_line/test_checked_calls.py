"""A wrong argument of a function is one error that names all of them, before anything runs, with what to write instead."""

import inspect
import pickle
from collections.abc import Callable
from functools import cache
from typing import Any

import pytest
from helpers import tasks

import fpirhc as fp
from fpirhc.errors import InvalidField

torque = cache(lambda: tasks.two_mass.controllers["CTC"])

ANY: Any = fp  # a type checker would refuse these calls
CALLS: dict[str, tuple[Callable[[], Any], str]] = {
    "a name of a controller": (
        lambda: ANY.simulate(tasks.two_mass.problem, "RHC", seed=0),
        "simulate.controller: expected a Controller, got the text 'RHC'; write controllers['RHC'] of a loaded problem file",
    ),
    "a loaded file": (
        lambda: ANY.simulate(tasks.two_mass, torque(), seed=0),
        "simulate.problem: expected a Problem, got a value of the class Task; give its .problem",
    ),
    "a forgotten argument": (
        lambda: ANY.simulate(tasks.two_mass.problem, torque()),
        "simulate needs seed; write simulate(problem=..., controller=..., seed=...)",
    ),
    "a seed that is no number": (
        lambda: ANY.simulate(tasks.two_mass.problem, torque(), seed="a"),
        "simulate.seed: expected a whole number of at least 0, got the text 'a'",
    ),
    "a name of a method": (lambda: ANY.Cases({"a": {}}).matching(all=[]), "no argument 'all'. Valid: wanted."),
    "a number for a signal": (lambda: ANY.Sensor(noise=2e-3), "or None, got 0.002; write fp.Noise(0.002)"),
    "a mapping for a number": (lambda: ANY.Predicted(torque(), {"Q1": 0.06}), "; write one value for all, 0.06"),
    "a number for a mapping": (lambda: ANY.DeadTime(0.02), "; write {'NAME': 0.02} with the name of what it belongs"),
    "a misspelt word": (
        lambda: ANY.Horizon(10, 0.01, replan="cycles"),
        "Horizon.replan: expected 'stage' or 'cycle' or a whole number from 1 to 1000000, got the text 'cycles'; write 'cycle'",
    ),
}


@pytest.mark.parametrize("name", CALLS)
def test_wrong_arguments_are_named(name):
    """The place is that of the caller."""
    call, words = CALLS[name]
    with pytest.raises(InvalidField) as caught:
        call()
    assert words in str(caught.value)
    assert caught.value.place.startswith("test_checked_calls.py, line")


def test_all_mistakes_of_a_call_come_at_once():
    simulate: Any = fp.simulate
    with pytest.raises(InvalidField, match=r"(?s)3 mistakes.*needs seed.*problem.*controller"):
        simulate("two_mass", "CTC")


def test_a_checked_function_is_still_that_function():
    """Its name, signature and docstring are its own, and another process can load it."""
    assert pickle.loads(pickle.dumps(fp.simulate)) is fp.simulate
    assert list(inspect.signature(fp.simulate).parameters)[:2] == ["problem", "controller"]
    assert (fp.simulate.__doc__ or "").startswith("Run the closed loop")
