"""What is wrong with a reality, or with a body outside, is said where the problem is made: what, where, what was expected."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.drives import CONTROLLERS, MEASURES, Wrapped, lagged, parameters, run, task
from helpers.plants import linear, pendulum

import fpirhc as fp

Y = linear(2.0, 1.0)
OUTPUT = replace(Y, outputs={"z": fp.Output("m", lambda q, v, p: 2 * q.y)})
GAIN = {"b": fp.Parameter(approximate=1.0, exact=2.0, unit="1/kg", bounds=(0.1, 10.0))}
LEVEL = fp.Plant({"h": "m"}, {"u": "m/s"}, {}, lambda q, u, p: {"h": u.u - q.h}, order=1)


def real(plant: fp.Plant, **settings: Any) -> fp.Problem:
    return task(reality=fp.Reality(plant, **settings))


def loose(body: Any = None, **settings: Any) -> Any:
    """An external plant from whatever is given."""
    return fp.ExternalPlant(
        body if "make" in settings else body or Wrapped(task()), **{"measures": MEASURES} | settings
    )


def body(**settings: Any) -> fp.Problem:
    return task(reality=loose(**settings))


class Stepless:
    """Half a body."""

    reset = Wrapped.reset


WRONG: dict[str, tuple[Any, str]] = {
    "no coordinate": (
        lambda: real(replace(Y, coordinates={"z": "m"}, response=lambda q, v, u, p: {"z": p.b * u.u})),
        "has no 'y', which the model has",
    ),
    "no output": (lambda: task(plant=OUTPUT, reality=fp.Reality(Y), cost=None, horizon=None,
                               reference=fp.Trajectory(lambda t: {"z": 0 * t})), "has no 'z'"),
    "unit": (lambda: real(replace(Y, coordinates={"y": "mm"})), "in mm, the model's 'y' in m;"),
    "unit of an input": (lambda: real(replace(Y, inputs={"u": "kN"})), "its inputs are u in kN, the model's are u in N"),
    "unit of time": (lambda: real(replace(Y, time_unit="ms")), "time is in ms, the model's in s"),
    "other input": (
        lambda: real(replace(Y, inputs={"F": "N"}, response=lambda q, v, u, p: {"y": p.b * u.F})),
        "inputs are F in N, the model's are u in N",
    ),
    "lower order": (
        lambda: real(fp.Plant({"y": "m"}, {"u": "N"}, parameters(), lambda q, u, p: {"y": p.b * u.u}, order=1)),
        "y' jumps with the command",
    ),
    "out of reach": (
        lambda: real(replace(lagged(), response=lambda q, v, u, p: {"y": -q.y, "F": (u.u - q.F) / p.tau})),
        "no input reaches its 'y'",
    ),
    "unknown start": (lambda: real(lagged(), start={"force": 1.0}), "start: state 'force' is unknown. Valid: y, F, y'"),
    "unknown sensor": (
        lambda: real(lagged(), start={"F": 0.0}, seen={"y": "Y"}), "coordinate of the reality 'Y' is unknown"
    ),
    "no start": (lambda: real(lagged()), "does not have: F; give their first values: Reality(start={'F': ...})"),
    "stiff": (lambda: real(lagged(tau=1e-4), start={"F": 0.0}), "RungeKutta4(substeps=1) makes it grow by"),
    "judged": (lambda: task(reality=fp.Reality(Y), judged=["y", "F"]), "'F'"),
    "a plant": (lambda: task(reality=pendulum()), "Reality"),
    "no exact model": (
        lambda: run(real(lagged(), start={"F": 0.0}), fp.ExactModel(CONTROLLERS["computed torque"])),
        "coordinates ('y', 'F'), the controller's are ('y',): it cannot be the exact model",
    ),
    "range": (lambda: replace(LEVEL, ranges={"levels": (0.0, 1.0)}), "'levels'"),
    "empty range": (lambda: replace(LEVEL, ranges={"h": (1.0, 0.0)}), "(lowest, highest), got (1.0, 0.0)"),
    "start out of range": (
        lambda: fp.Problem(
            replace(LEVEL, ranges={"h": (0.5, 1.0)}), fp.Trajectory(lambda t: {"h": 1 + 0 * t}), {"h": 0.2}, 0.01, 1.0
        ),
        "'h' is 0.2, outside its physical range of 0.5 to 1",
    ),
    "no body": (lambda: fp.ExternalPlant(measures=MEASURES), "either a body or make=lambda parameters, seed: body"),
    "two bodies": (
        lambda: fp.ExternalPlant(Wrapped(task()), measures=MEASURES, make=lambda _p, _s: None), "either a body or make"
    ),
    "half a body": (lambda: loose(Stepless()), "its body is a value of the class Stepless without step"),
    "a class": (lambda: loose(Stepless), "its body is the class Stepless; write Stepless() for an object of it"),
    "not measured": (lambda: body(measures={"y": "m", "y'": "m/s"}), "y'' (m/s^2), which the sensing"),
    "unknown measure": (lambda: body(measures={**MEASURES, "yy": "m"}), "'yy' is unknown. Did you mean 'y'?"),
    "measured unit": (lambda: body(measures={**MEASURES, "y": "mm"}), "measures y in mm, the model has it in m"),
    "an option": (lambda: loose(rests={}), "no field 'rests'. Did you mean 'rest'?"),
    "a lag of nothing": (lambda: loose(lag=0.002), "lag: expected {name: a finite number of at least 0}"),
    "a negative lag": (lambda: body(lag={"u": -0.1}), "lag['u']: expected a finite number of at least 0, got -0.1"),
    "an infinite lag": (lambda: body(lag={"u": math.inf}), "got inf"),
    "lag of nobody": (lambda: body(lag={"v": 0.1}), "input 'v' is unknown"),
    "parameters alone": (lambda: loose(parameters=GAIN), "a body that stands cannot take parameters; write make="),
    "one argument": (lambda: loose(make=lambda _: None), "make: expected a function of 2 arguments or None"),
    "made of nothing": (
        lambda: run(body(make=lambda _p, _s: None)), "reality: make returned None; expected an object with reset(seed)"
    ),
    "raises": (lambda: run(body(make=lambda p, _: p["c"])), "reality: make raised KeyError: 'c'"),
    "out of bounds": (
        lambda: body(make=lambda p, s: Wrapped(task()), parameters=GAIN).with_exact(np.array([20.0])), "outside its bounds"
    ),
    "nothing to draw": (lambda: body().with_exact(np.array([1.0])), "no exact parameters"),
    "no equations": (lambda: run(body(), fp.ExactModel(CONTROLLERS["computed torque"])), "no equations"),
    "a disturbance": (lambda: task(reality=loose(), disturbances={"y": fp.Step(0.0, 1.0)}), "disturbances"),
    "no object": (lambda: task(reality=Wrapped(task())), "reality: expected a Reality or an ExternalPlant"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_reality_says_what_was_expected(name):
    make, words = WRONG[name]
    with pytest.raises(fp.FpirhcError) as caught:
        make()
    assert words in " ".join(str(caught.value).split())
