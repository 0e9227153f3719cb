"""Figures of runs say what they show: names and units of the quantities, the controller by its name, no empty pictures."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from matplotlib.axes import Axes
from plants import chain

import fpirhc as fp
from fpirhc.controllers.contract import name_in_task
from fpirhc.problem_files.problem_file import Task
from fpirhc.report.figures import contraction_figure, pair_figures
from fpirhc.report.html import asset, headline_pair
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
    assert {name: name_in_task(c) for name, c in shipped.controllers.items()} == {
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
    """Litres per second and kilowatts are two pictures, with their unit on the axis; a run's own figure has them, too."""
    figures = pair_figures(reacted["plain"], reacted["affine"])
    assert [name for name in figures if name.startswith("Command")] == ["Command [l/s]", "Command [kW]"]
    assert [name for name in figures if name.startswith("Tracking")] == ["Tracking error [mol/l]", "Tracking error [K]"]
    labels = {name: figure.axes[0].get_ylabel() for name, figure in figures.items()}
    assert (labels["Command [l/s]"], labels["Command [kW]"]) == ("F [l/s]", "Q_dot [kW]")
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


def test_every_unit_has_its_responses(reacted):
    """A mole and a kelvin have a picture each, of the first quantity with this unit."""
    figures = pair_figures(reacted["plain"], reacted["affine"])
    labels = [figure.axes[0].get_ylabel() for name, figure in figures.items() if name.startswith("Highest")]
    assert labels == ["responses of c [mol/l/s]", "responses of T [K/s]"]


def test_a_reference_has_a_colour_of_its_own(reacted):
    """Where what follows lies on it, both are seen: the reference is drawn later, dashed, and in another colour."""
    figures = pair_figures(reacted["plain"], reacted["affine"])
    for name in ("Trajectory tracking [K]", "Trajectory tracking [mol/l]"):
        motion, reference = figures[name].axes[0].lines
        assert "nominal" in str(reference.get_label())
        assert reference.get_color() != motion.get_color()
        assert (motion.get_linestyle(), reference.get_linestyle()) == ("-", "--")


def test_both_sides_of_a_pair_have_the_same_axes(reacted):
    """A smaller error looks smaller; nothing of either side is cut."""
    for name, figure in pair_figures(reacted["plain"], reacted["affine"]).items():
        left, right = figure.axes
        assert left.get_ylim() == right.get_ylim(), name
        assert left.get_xlim() == right.get_xlim(), name
    left, right = pair_figures(reacted["plain"], reacted["affine"])["Tracking error [K]"].axes
    low, high = left.get_ylim()
    drawn = np.concatenate([line.get_ydata() for axis in (left, right) for line in axis.lines])
    assert low < drawn.min() < drawn.max() < high


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


def test_nothing_is_green_in_a_red_report():
    """Best cells are marked without a colour of success, and a better pair of a lost headline has none either."""
    style = asset("report.css")
    marks = re.findall(r"--mark:#(..)(..)(..)", style)
    assert len(marks) == 2
    for channels in marks:
        red, green, blue = (int(c, 16) for c in channels)
        assert green <= max(red, blue)
    assert ".outcome-worse~ul li.outcome-better{color:var(--ink)}" in style
