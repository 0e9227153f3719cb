"""Figures of runs say what they show: names and units of the quantities, the controller by its name, no empty pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from helpers.plants import chain
from matplotlib.axes import Axes

import fpirhc as fp
from fpirhc import compare
from fpirhc.controllers.contract import name_in_task
from fpirhc.problem_files.problem_file import Task
from fpirhc.report.figures import contraction_figure


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
    assert {name: name_in_task(c) for name, c in shipped.controllers.items()} == {
        name: name for name in shipped.controllers
    }
    fresh = fp.ComputedTorque(fp.Exponential(rate=6.0))
    short = replace(shipped.problem, duration=0.01, measure_from=0.0)
    assert fp.simulate(short, fresh, seed=0, compiled=False).controller == "ComputedTorque"
    assert fp.simulate(short, fresh, seed=0, name="mine", compiled=False).controller == "mine"


def reactor() -> Task:
    """Two coordinates and two inputs of different units; maps whose gains are no effective gains."""
    plant = fp.Plant(
        coordinates={"c": "mol/l", "T": "K"},
        inputs={"F": "l/s", "Q_dot": "kW"},
        order=1,
        response=lambda q, u, p: {"c": p.k * u.F - q.c, "T": p.k * u.Q_dot - q.T},
        parameters={"k": fp.Parameter(1.0, 1.5, "1")},
    )
    problem = fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"c": ca.sin(t), "T": 5 * ca.cos(t)}),
        start={"c": 0.0, "T": 4.0},
        period=0.01,
        duration=1.0,
    )
    track = fp.Exponential(rate=6.0)
    controllers = {
        "plain": fp.ComputedTorque(track),
        "affine": fp.ComputedTorque(track, fp.Affine(gain=-1.0)),
        "gentle": fp.ComputedTorque(track, fp.Affine(gain=-0.5)),
        "rotation": fp.ComputedTorque(track, fp.Rotation(fraction=0.4, radius=1e3)),
    }
    return Task("case", Path(__file__), "case", "", problem, controllers, ("plain", "affine"))


@pytest.fixture(scope="module")
def reacted():
    return compare(reactor(), seed=0, compiled=False)


def test_a_chart_has_one_unit(reacted):
    """Litres per second and kilowatts are two charts, with their unit on the axis."""
    own = [axis.get_ylabel() for axis in reacted["affine"].run.plot().axes]
    assert own == [
        "error of c [mol/l]",
        "error of T [K]",
        "c [mol/l]",
        "T [K]",
        "F [l/s]",
        "Q_dot [kW]",
        "responses of c [mol/l/s]",
    ]


def marked(axes: list[Axes]) -> dict[str, tuple[float, float]]:
    """Single points by their label."""
    lines = [(str(line.get_label()), np.asarray(line.get_xydata())) for axis in axes for line in axis.lines]
    return {label: (float(points[0, 0]), float(points[0, 1])) for label, points in lines if len(points) == 1}


def test_the_contraction_is_drawn_against_the_gain_that_the_user_sets(reacted):
    """Affine(gain=-1) is at -1 with its limit 2 / (0.5 * 1.5), the fraction of a rotation at 0.4; one gain has one panel."""
    figure = contraction_figure(reacted)
    assert figure is not None
    *panels, decay = figure.axes
    assert [axis.get_xlabel() for axis in panels] == ["gain", "fraction"]
    assert decay.get_xlabel() == "control cycle"
    points = marked(panels)
    assert points["affine, predicted"] == pytest.approx((-1.0, abs(1 - 0.5 * 1.5)))
    assert points["gentle, predicted"] == pytest.approx((-0.5, abs(1 - 0.25 * 1.5)))
    assert points["rotation, predicted"][0] == pytest.approx(0.4)
    rings = [line for axis in panels for line in axis.lines if line.get_marker() == "o"]
    crosses = [line for axis in panels for line in axis.lines if line.get_marker() == "x"]
    assert {str(line.get_markerfacecolor()) for line in rings} == {"none"}
    assert min(line.get_zorder() for line in crosses) > max(line.get_zorder() for line in rings)
    [limit] = [np.asarray(line.get_xydata())[0, 0] for line in panels[0].lines if line.get_label() == "linear limit"]
    assert limit == pytest.approx(-2 / (0.5 * 1.5))
