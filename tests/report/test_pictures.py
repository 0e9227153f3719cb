"""Pictures that a problem wants: what they draw is what the runs hold, and a mistake in one is named."""

from typing import Any

import casadi as ca
import numpy as np
import pytest
from matplotlib.figure import Figure

import fpirhc as fp
from fpirhc.contracts import Layout, Signal, scalar
from fpirhc.errors import InvalidProblem, InvalidValue


def spring(time=1.0):
    """A mass on a spring that follows two periods of a sine."""
    plant = fp.Plant(
        coordinates={"q": "m"},
        inputs={"u": "N"},
        order=2,
        response=lambda q, v, u, p: {"q": (u.u - q.q) / p.mass},
        parameters={"mass": fp.Parameter(approximate=1.2, exact=1.0, unit="kg")},
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"q": ca.sin(4 * ca.pi * t)}),
        start={"q": 0.0, "q'": 4 * np.pi},
        period=1e-3,
        duration=time,
    )


@pytest.fixture(scope="module")
def runs():
    """Two controllers on the spring."""
    controllers = {
        "slow": fp.ComputedTorque(fp.Exponential(rate=5.0)),
        "quick": fp.ComputedTorque(fp.Exponential(rate=20.0)),
    }
    return {n: fp.simulate(spring(), c, seed=0, compiled=False) for n, c in controllers.items()}


ENERGY = fp.Quantity("energy", "J", lambda run: 0.5 * (run["state.q"] ** 2 + run["state.q'"] ** 2))


def test_a_line_over_time_is_the_signal(runs):
    """One panel per signal, one line per run, with its numbers; levels are horizontal lines; times in the problem's unit."""
    figure = Figure()
    fp.OverTime("t", panels=("command.u", ENERGY), levels={"energy": (3.0,)}, since=0.25).draw(figure, runs)
    upper, lower = figure.axes
    np.testing.assert_array_equal(upper.lines[1].get_ydata(), runs["quick"]["command.u"][250:])
    np.testing.assert_array_equal(lower.lines[0].get_ydata(), ENERGY.values(runs["slow"])[250:])
    assert np.asarray(lower.lines[2].get_ydata())[0] == 3.0
    assert (upper.get_ylabel(), lower.get_ylabel()) == ("u [N]", "energy [J]")
    assert lower.get_xlabel() == "time [s]"


def made_run(values: np.ndarray) -> fp.Run:
    """A run whose signals are all this one, a value each millisecond."""
    names = "state", "reference", "error", "command", "nominal", "desired", "deformed", "realised"
    signals = scalar("time", "s"), *(Signal(name, ("q",), ("m",)) for name in names)
    log = np.column_stack([np.arange(len(values)) * 1e-3, *[values] * len(names)])
    return fp.Run("case", "made", 0, 1e-3, Layout(signals), log, None, False, {})


def test_an_alternating_signal_is_drawn_as_wide_as_it_is():
    """Extremes of intervals, not every n-th value; in their order, and values of the series alone. Of the plot of a run too."""
    values = np.where(np.arange(20_000) % 2, 60.0, -60.0) * (np.arange(20_000) > 5000)
    figure = Figure()
    fp.OverTime("t", panels=("state.q",)).draw(figure, {"made": made_run(values)})
    for axis in (*figure.axes, *made_run(values).plot().axes):
        when, what = (np.asarray(one) for one in axis.lines[0].get_data())
        assert what.size <= 4000
        assert np.all(np.diff(when) >= 0)
        assert (what[-100:].min(), what[-100:].max()) == (-60.0, 60.0)
        np.testing.assert_array_equal(what, values[np.rint(when * 1e3).astype(int)])


def test_a_portrait_has_a_panel_for_each_run(runs):
    figure = Figure()
    fp.Portrait("p", x="state.q", y="state.q'").draw(figure, runs)
    assert [a.get_title() for a in figure.axes] == ["slow", "quick"]
    np.testing.assert_array_equal(figure.axes[0].lines[0].get_xdata(), runs["slow"]["state.q"])
    assert figure.axes[0].get_ylabel() == "q' [m/s]"


def cart(q, p):
    """A cart that is as long as it is heavy, its wheel, and the spring to the wall."""
    return [
        fp.Shape.box((q.q, 0.0), p.mass, 0.2),
        fp.Shape.disc((q.q, -0.1), 0.05),
        fp.Shape.spring((-2.0, 0.0), (q.q, 0.0)),
    ]


def planar(shapes: Any = None) -> fp.Planar:
    return fp.Planar("cart", spring().plant, shapes or (lambda q, v, p: cart(q, p)))


def test_a_mechanism_has_the_numbers_of_the_run_and_of_its_reference(runs):
    """Corners of the box are the position and half the exact mass; the reference's lie behind, with its position."""
    run, picture = runs["slow"], planar()
    numbers = picture.frames(run, np.arange(run.cycles))
    width = sum(2 * one["points"] + one["disc"] for one in picture.outlines)
    assert numbers.shape == (run.cycles, 2 * width)
    for begin, signal in ((0, "plant_state.q"), (width, "reference.q")):
        np.testing.assert_allclose(numbers[:, begin], run[signal] - 0.5, atol=1e-12)
        np.testing.assert_allclose(numbers[:, begin + 2], run[signal] + 0.5, atol=1e-12)
        np.testing.assert_allclose(
            numbers[:, begin + 8 : begin + 11].T, [run[signal], *np.full((2, run.cycles), [[-0.1], [0.05]])], atol=1e-12
        )
        np.testing.assert_allclose(numbers[:, begin + width - 2], run[signal], atol=1e-12)


def test_a_page_has_the_frames_that_move_and_the_numbers_that_stand_still(runs):
    motion: Any = planar().motion(runs)
    one = motion["runs"][1]
    assert (one["name"], one["step"], motion["duration"], motion["seconds"]) == ("quick", 4e-3, 1.0, 10.0)
    frames = np.array(one["numbers"]).reshape(-1, len(one["moves"]))
    assert len(frames) == 250
    whole = np.tile(one["still"], (250, 1))
    whole[:, one["moves"]] = frames
    np.testing.assert_allclose(whole, planar().frames(runs["quick"], np.arange(0, 1000, 4)), rtol=1e-4, atol=1e-6)
    assert planar().motion({}) == {}


def test_a_mechanism_stands_still_where_nothing_can_move(runs):
    """Moments of the run, a panel for each controller, three shapes each."""
    figure = Figure()
    planar().draw(figure, runs)
    figure.draw_without_rendering()
    assert [a.get_title() for a in figure.axes] == ["slow", "quick"]
    assert [len(a.lines) for a in figure.axes] == [9, 9]
    assert [len(a.patches) for a in figure.axes] == [18, 18]


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        (lambda q, v, p: "box", r"Planar\('cart', shapes=...\): expected a list of fp.Shape, got 'box'"),
        (lambda q, v, p: [], r"expected a list of fp.Shape, got \[\]"),
        (lambda q, v, p: [fp.Shape.line((0, 0, 0))], r"expected points \(x, y\) of scalars"),
        (lambda q, v, p: [fp.Shape.disc((q.q, 0.0), p.radius)], r"Planar\('cart', shapes=...\).*radius.*mass"),
    ],
)
def test_a_mistake_in_a_mechanism_is_named(shapes, message):
    with pytest.raises((InvalidValue, InvalidProblem), match=message):
        planar(shapes)
