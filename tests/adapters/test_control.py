"""Systems of python-control as plants, and a controller as one of its systems."""

from __future__ import annotations

import importlib
from functools import cache
from typing import Any

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.errors import InvalidProblem


@cache
def adapter() -> Any:
    """It takes a second to import python-control, which only these tests pay."""
    return importlib.import_module("fpirhc.adapters.control")


def library() -> Any:
    """Python-control."""
    return adapter().control


@cache
def model_and_truth() -> tuple[Any, Any]:
    return library().tf([2], [1, 3, 2, 0]), library().tf([3], [1, 2, 2, 0])


def problem(plant: fp.Plant, reference: float = 0.5, **changes) -> fp.Problem:
    settings = {"start": {}, "period": 0.01, "duration": 3.0, "measure_from": 0.0, **changes}
    return fp.Problem(plant=plant, reference=fp.Trajectory(lambda t: {"y": reference * t**3}), **settings)


def test_a_transfer_function_moves_as_python_control_says():
    """The command of a run, given to python-control's own simulation of the true system."""
    model, true = model_and_truth()
    plant = adapter().plant_of(model, true, inputs={"u": "V"}, outputs={"y": "rad"})
    assert plant.response_orders == {"y": 3}
    task = problem(plant, start=dict.fromkeys(plant.state.elements, 0.0))
    run = fp.simulate(task, fp.ComputedTorque(fp.Exponential(rate=3.0)), seed=0, compiled=False)
    assert run.stop is None
    held = library().c2d(library().ss(true), 0.01)
    answer = library().forced_response(held, None, run["command"][:, 0])
    assert run["output"][:, 0] == pytest.approx(answer.outputs, abs=1e-8)


def test_entries_that_differ_are_parameters():
    plant = adapter().plant_of(*model_and_truth())
    assert {name: (p.approximate, p.exact) for name, p in plant.parameters.items()} == {
        "A_1_1": (-3.0, -2.0), "C_1_3": (2.0, 3.0)
    }  # fmt: skip
    assert list(plant.inputs) == ["u_0"]


def test_a_sampled_system_is_a_map():
    plant = adapter().plant_of(library().c2d(library().ss(library().tf([1], [1, 1])), 0.1), outputs={"y": "K"})
    assert plant.step == 0.1
    task = problem(plant, start=dict.fromkeys(plant.state.elements, 0.0), period=0.1)
    run = fp.simulate(task, fp.ComputedTorque(fp.Exponential(rate=1.0)), seed=0, compiled=False)
    assert np.abs(run["error"]).max() < 1e-9  # the model is exact, and a sampled system follows exactly


@pytest.mark.parametrize(
    ("system", "arguments", "message"),
    [
        (lambda: library().tf([1, 1], [1, 2]), dict, "the output depends on the input at once (D is not zero)"),
        (
            lambda: model_and_truth()[0],
            lambda: {"exact": library().tf([1], [1, 1])},
            "the two systems differ in size or sampling time: 3 states",
        ),
        (lambda: model_and_truth()[0], lambda: {"inputs": {"a": "V", "b": "V"}}, "inputs: 2 names for 1 inputs (u[0])"),
        (lambda: library().ss([[0.5]], [[1]], [[1]], [[0]], True), dict, "the sampling time is not given"),
    ],
)
def test_mistakes_are_named(system, arguments, message):
    with pytest.raises(InvalidProblem) as caught:
        adapter().plant_of(system(), **arguments())
    assert message in str(caught.value)


def test_a_controller_is_a_system():
    """Its loop with a plant of python-control has the commands of our own loop."""
    task = fp.load_problem("two_link_arm").problem
    law = fp.ComputedTorque(fp.Exponential(rate=10.0), fp.ModelReferenced(fp.Affine(gain=-0.1)))
    run = fp.simulate(task, law, seed=0, compiled=False)
    system = importlib.import_module("fpirhc.adapters.control").controller_system(task, law)
    measured = np.hstack([run["state"], run["realised"]])[:50].T
    assert system.input_labels == ["q1", "q2", "q1_1", "q2_1", "q1_2", "q2_2"]
    answer = library().input_output_response(system, np.arange(50) * task.period, measured, system.initial)
    assert pytest.approx(run["command"][:50], rel=1e-12) == np.asarray(answer.outputs).T
