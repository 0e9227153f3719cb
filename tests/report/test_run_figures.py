"""Figures of runs say what they show: names and units of the quantities, the controller by its name, no empty pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import casadi as ca
import pytest
from plants import chain

import fpirhc as fp
from fpirhc.problem_files.problem_file import Task
from fpirhc.report.figures import pair_figures
from fpirhc.report.html import headline_pair
from fpirhc.studies.comparison.compare import compare


def task(order: int, unit: str = "mg/l") -> Task:
    """A chain of integrators, with and without adaptation."""
    track = fp.Exponential(rate=6.0)
    problem = fp.Problem(
        plant=replace(chain(order), coordinates={"y": unit}),
        reference=fp.Trajectory(lambda t: {"y": ca.sin(t)}),
        start={"y": 0.2},
        period=0.01,
        duration=0.5,
    )
    controllers = {
        "pump, steady": fp.ComputedTorque(track),
        "pump": fp.ComputedTorque(track, fp.Sigmoid(gain=-0.5, scale=5.0)),
    }
    return Task("case", Path(__file__), "case", "", problem, controllers, ("pump, steady", "pump"))


def test_the_plot_of_a_run_names_quantities_units_and_controller():
    """A concentration is no position; the name is that of the problem file and not of a class."""
    loaded = task(1)
    run = fp.simulate(loaded.problem, loaded.controllers["pump"], seed=0, compiled=False)
    figure = run.plot()
    labels = [axis.get_ylabel() for axis in figure.axes]
    assert labels == ["error of y [mg/l]", "y [mg/l]", "u [N]", "responses of y [mg/l/s]"]
    assert run.controller == "pump"
    assert figure.get_suptitle() == "pump"


def test_a_shipped_task_gives_its_controllers_their_names():
    """As in the tutorial: simulate(task.problem, task.controllers[name])."""
    shipped = fp.load_problem("two_mass")
    assert {name: c.task_name for name, c in shipped.controllers.items()} == {
        name: name for name in shipped.controllers
    }
    fresh = fp.ComputedTorque(fp.Exponential(rate=6.0))
    short = replace(shipped.problem, duration=0.01, measure_from=0.0)
    assert fp.simulate(short, fresh, seed=0, compiled=False).controller == "ComputedTorque"
    assert fp.simulate(short, fresh, seed=0, name="mine", compiled=False).controller == "mine"


@pytest.mark.parametrize("order", [1, 2])
def test_a_plant_of_order_one_has_no_phase_picture(order):
    """The phase plane is the first derivative against the coordinate; with order one the derivative is no state."""
    pair = headline_pair(compare(task(order), seed=0, compiled=False))
    assert pair is not None
    figures = pair_figures(*pair)
    assert ("Phase trajectories" in figures) == (order == 2)
    assert all(axis.lines for figure in figures.values() for axis in figure.axes)
    if order == 2:
        axis = figures["Phase trajectories"].axes[0]
        assert (axis.get_xlabel(), axis.get_ylabel()) == ("y [mg/l]", "y' [mg/l/s]")
