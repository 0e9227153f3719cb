"""Wrong uses of an external plant, of cases and of a probe, as a newcomer makes them, each with its whole message."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bodies import RHC, Body, body_problem

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


def with_reality(reality: Any) -> Any:
    return replace(PROBLEM, reality=reality)


def case(changes: Any) -> Any:
    return fp.Cases({"heavy": changes}).problem("heavy", PROBLEM)


def run(problem: fp.Problem) -> Any:
    return fp.simulate(problem, RHC, seed=0, compiled=False)


def probed(**settings: Any) -> Any:
    return fp.probe(PROBLEM, RHC, **settings)


def recorded(text: str) -> Any:
    Path("run.csv").write_text(text)
    return probed(recording="run.csv")


WRONG: dict[str, tuple[Any, str]] = {
    "a class for a body": (
        lambda: outside(body=Body),
        "ExternalPlant: its body is the class Body; write Body() for an object of it",
    ),
    "a function for a body": (
        lambda: outside(body=lambda command: command),
        "ExternalPlant: its body is a value of the class function without reset and step; expected an object with "
        "reset(seed) and step(time, command)",
    ),
    "no measures": (
        lambda: outside(measures={}),
        "problem: reality: 3 mistakes\n  1. it does not measure q (m), which the sensing of the problem needs; "
        "add it to measures, or choose an estimator that does without: Sensing(estimator=...)\n  2. it does "
        "not measure q' (m/s), which the sensing of the problem needs; add it to measures, or choose an "
        "estimator that does without: Sensing(estimator=...)\n  3. it does not measure q'' (m/s^2), which the "
        "sensing of the problem needs; add it to measures, or choose an estimator that does without: "
        "Sensing(estimator=...)",
    ),
    "a name twice": (
        lambda: outside(measures=["q", "q", "q''"]),
        "ExternalPlant: measures: q is named 2 times; an answer has every quantity once",
    ),
    "a text for a list of names": (
        lambda: outside(measures="q, q'"),
        "ExternalPlant.measures: expected {name: a text} or (a text, ...), got the text \"q, q'\"; write {'NAME': \"q, q'\"} "
        "with the name of what it belongs to, or write ('q', \"q'\")",
    ),
    "another unit": (
        lambda: outside(measures=MEASURES | {"q": "mm"}),
        "problem: reality: it measures q in mm, the model has it in m; write both in one unit",
    ),
    "an unknown quantity": (
        lambda: outside(measures=MEASURES | {"angle": "rad"}),
        "problem: reality: measures: quantity 'angle' is unknown. Valid: q, q', q''.",
    ),
    "parameters of a body that stands": (
        lambda: outside(parameters={"b": fp.Parameter(1.0, 1.0, "1")}),
        "ExternalPlant: a body that stands cannot take parameters; write make=lambda parameters, seed: body",
    ),
    "a body of another period": (
        lambda: outside(period=2e-2),
        "reality: one step of it takes 0.02, and the problem's period is 0.01; write both alike",
    ),
    "a dead time without its input": (
        lambda: outside(dead_time=0.02),
        "ExternalPlant.dead_time: expected {name: a finite number of at least 0}, got 0.02; write "
        "{'NAME': 0.02} with the name of what it belongs to",
    ),
    "a start that returns nothing": (
        lambda: run(outside(body=body(Silent))),
        "reality: reset of Silent returned None, expected 3 numbers: q, q', q''",
    ),
    "exact parameters of a body that stands": (
        lambda: outside().reality.with_exact(np.array([1.0])),
        "the external plant has no exact parameters that a study could draw; state them, "
        "ExternalPlant(make=lambda parameters, seed: body, parameters={...}), or compare it without a study",
    ),
    "a body that is not in an external plant": (
        lambda: with_reality(body()),
        "Problem.reality: expected a Reality or an ExternalPlant or None, got a value of the class Body; "
        "write fp.Reality(plant=...) or fp.ExternalPlant(body=...)",
    ),
    "make that returns nothing": (
        lambda: run(outside(body=None, make=lambda _parameters, _seed: None)),
        "reality: make returned None; expected an object with reset(seed) and step(time, command)",
    ),
    "make that returns a class": (
        lambda: run(outside(body=None, make=lambda _parameters, _seed: Body)),
        "reality: make returned the class Body; write Body() for an object of it",
    ),
    "make that fails": (
        lambda: run(outside(body=None, make=lambda parameters, _seed: parameters["mass"])),
        "reality: make raised KeyError: 'mass'",
    ),
    "a parameter of a plant outside that has none": (
        lambda: case({"exact.mass": 2.0}),
        "cases: case 'heavy', 'exact.mass': what moves is outside and has no parameter 'mass'; state it: "
        "ExternalPlant(make=lambda parameters, seed: body, parameters={'mass': ...})",
    ),
    "parameters in a mapping of their own": (
        lambda: case({"approximate": {"b": 2.0}}),
        "cases: case 'heavy', 'approximate': 'approximate' alone names no parameter; write one entry for each, "
        "'approximate.NAME'",
    ),
    "no case": (lambda: fp.Cases({}), 'cases: there is none; expected {"heavy": {"exact.mass": 2.0}}'),
    "a parameter without its word": (
        lambda: case({"b": 2.0}),
        "cases: case 'heavy', 'b': the problem has no 'b'. It is a parameter: 'exact.b' is what moves, "
        "'approximate.b' is what the controllers know, 'known.b' is both: what moves has it, and the "
        "controllers know it.",
    ),
    "a parameter that is not there": (
        lambda: case({"approximate.mass": 2.0}),
        "cases: case 'heavy', 'approximate.mass': 'approximate.NAME' has a parameter of what the controllers "
        "know, and there is no 'mass'. Valid: b.",
    ),
    "a field that is misspelt": (
        lambda: case({"limit.inputs.u": (-1.0, 1.0)}),
        "cases: case 'heavy', 'limit.inputs.u': the problem has no 'limit.inputs.u'. It is an input: "
        "'limits.inputs.u' are its limits.",
    ),
    "a text for a number": (
        lambda: case({"start.q": "0.1"}),
        "cases: case 'heavy', 'start.q': expected a finite number, got the text '0.1'",
    ),
    "too few cycles": (
        lambda: probed(cycles=20),
        "probe: 20 cycles are too few to tell a gain from noise; expected at least 40, 300 are usual",
    ),
    "a negative amplitude": (
        lambda: probed(amplitude=-1.0),
        "probe(amplitude=-1.0): expected a number of at least 0, in the unit of the signal",
    ),
    "the amplitude of an input": (
        lambda: probed(amplitude={"u": 1.0}),
        "probe(amplitude=...): 'u' is unknown. Valid: q.",
    ),
    "the chatter of a coordinate": (
        lambda: probed(chatter={"q": 1.0}),
        "probe(chatter=...): 'q' is unknown. Valid: u.",
    ),
    "a record without rows": (
        lambda: recorded("time,u,q,q'\n"),
        "recording run.csv: it has fewer than two rows of numbers below the line of names",
    ),
    "a record of another period": (
        lambda: recorded("time,u,q,q'\n0,0,0,0\n0.01,1,0,0\n0.03,0,0,0\n"),
        "recording run.csv: its times are not 0.01 s apart, the period of the problem: 0.01 is followed by 0.03",
    ),
    "a record that is not there": (
        lambda: probed(recording="run1.csv"),
        "recording 'run1.csv' cannot be read: No such file or directory",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_use_is_told_in_one_message(name, tmp_path, monkeypatch):
    """What, where, what was expected, the nearest name, and how to mend it; the place in the file comes before it."""
    monkeypatch.chdir(tmp_path)
    use, message = WRONG[name]
    with pytest.raises(fp.FpirhcError) as caught:
        use()
    assert re.sub(r"^\S+\.py, line \d+: ", "", str(caught.value)) == message
