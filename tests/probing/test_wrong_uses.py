"""Wrong uses of an external plant and of a probe, as a newcomer makes them, each with its whole message."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.bodies import RHC, Body, body_problem

import fpirhc as fp

PROBLEM = body_problem(1.0)
MEASURES = {"q": "m", "q'": "m/s", "q''": "m/s^2"}


class Silent(Body):
    """Its reset returns nothing."""

    def reset(self, seed: int) -> Any:
        del seed


def body(kind: type[Body] = Body) -> Body:
    return kind(np.array([[1.0]]))


def outside(**settings: Any) -> Any:
    """The task with another external plant."""
    given: dict[str, Any] = {"body": body(), "measures": MEASURES} | settings
    return replace(PROBLEM, reality=fp.ExternalPlant(**given))


def case(changes: Any) -> Any:
    return fp.Cases({"heavy": changes}).problem("heavy", PROBLEM)


def run(problem: fp.Problem) -> Any:
    return fp.simulate(problem, RHC, seed=0, compiled=False)


def probed(**settings: Any) -> Any:
    return fp.probe(PROBLEM, RHC, **settings)


WRONG: dict[str, tuple[Any, str]] = {
    "a function for a body": (
        lambda: outside(body=lambda command: command),
        "ExternalPlant: its body is a value of the class function without reset and step; expected an object with "
        "reset(seed) and step(time, command)",
    ),
    "a body of another period": (
        lambda: outside(period=2e-2),
        "reality: one step of it takes 0.02, and the problem's period is 0.01; write both alike",
    ),
    "a start that returns nothing": (
        lambda: run(outside(body=body(Silent))),
        "reality: reset of Silent returned None, expected 3 numbers: q, q', q''",
    ),
    "a parameter of a plant outside that has none": (
        lambda: case({"exact.mass": 2.0}),
        "cases: case 'heavy', 'exact.mass': 'exact.NAME' has a parameter of what moves, and there is no 'mass'. "
        "No names are valid here.",
    ),
    "a negative amplitude": (
        lambda: probed(amplitude=-1.0),
        "probe(amplitude=-1.0): expected a number of at least 0, in the unit of the signal",
    ),
    "settings of an excitation beside a recording": (
        lambda: probed(recording="run.csv", cycles=300),
        "cycles is of an excitation, and a recording has been excited: leave one of them out",
    ),
    "the amplitude of an input": (
        lambda: probed(amplitude={"u": 1.0}),
        "probe(amplitude=...): 'u' is unknown. Valid: q.",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_use_is_told_in_one_message(name):
    """What, where, what was expected, the nearest name, and how to mend it; the place in the file comes before it."""
    use, message = WRONG[name]
    with pytest.raises(fp.FpirhcError) as caught:
        use()
    assert re.sub(r"^\S+\.py, line \d+: ", "", str(caught.value)) == message
