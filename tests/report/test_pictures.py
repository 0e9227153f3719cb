"""Pictures that a problem wants: what they draw is what the runs hold, and a mistake in one spoils neither file nor report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from matplotlib.figure import Figure

import fpirhc as fp
from fpirhc.errors import InvalidName, InvalidProblem, InvalidValue, ProblemFileError
from fpirhc.report.html import own_pictures, render
from fpirhc.simulation.pictures.base import averaged, extremes
from fpirhc.simulation.pictures.lines import passages


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


def test_an_alternating_command_is_drawn_as_wide_as_it_is():
    """Extremes of intervals, not every n-th value; in their order, and nothing but values of the series."""
    times = np.arange(20_000) * 1e-3
    values = np.where(np.arange(20_000) % 2, 60.0, -60.0) * (times > 5)
    when, what = extremes(times, values)
    assert what.size == 4000
    assert np.all(np.diff(when) >= 0)
    assert (what[-100:].min(), what[-100:].max()) == (-60.0, 60.0)
    np.testing.assert_array_equal(what, values[np.searchsorted(times, when)])
    assert extremes(times[:10], values[:10])[0].size == 10


def test_a_portrait_has_a_panel_for_each_run(runs):
    figure = Figure()
    fp.Portrait("p", x="state.q", y="state.q'").draw(figure, runs)
    assert [a.get_title() for a in figure.axes] == ["slow", "quick"]
    np.testing.assert_array_equal(figure.axes[0].lines[0].get_xdata(), runs["slow"]["state.q"])
    assert figure.axes[0].get_ylabel() == "q' [m/s]"


def test_a_raster_counts_passages_upwards(runs):
    """Two sines pass half their height twice upwards; a signal that begins above has not passed."""
    figure = Figure()
    fp.Raster("r", signal="reference.q", threshold=0.5).draw(figure, runs)
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == ["slow (2)", "quick (2)"]
    times = np.arange(6.0)
    np.testing.assert_array_equal(passages(times, np.array([2.0, 0, 2, 2, 1, 3]), 1.0), [2.0, 5.0])


def test_an_unknown_signal_is_named(runs):
    with pytest.raises(InvalidName, match=r"'state\.p'.*state\.q"):
        fp.Portrait("p", x="state.p", y="state.q").draw(Figure(), runs)


FILE = '''"""A spring."""
from test_pictures import spring
import fpirhc as fp
problem = spring(0.05)
controllers = {"CTC": fp.ComputedTorque(fp.Exponential(rate=5.0))}
pictures = (%s,)
'''


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ("'phase'", r"line 6: pictures\[0\]: expected a Picture, got the text 'phase'"),
        ("fp.Portrait('p', x='state.q', y='state.q', controllers=('CTX',))", r"picture 'p': controller 'CTX'.*CTC"),
    ],
)
def test_mistakes_in_a_file_are_told_when_it_is_loaded(written, message, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    path = tmp_path / "spring.py"
    path.write_text(FILE % written)
    with pytest.raises(ProblemFileError, match=message):
        fp.load_problem(str(path))


def test_a_picture_that_cannot_be_drawn_leaves_the_report_whole(tmp_path, monkeypatch):
    """Its place says why; one whose controllers did not run is left out; without pictures there is no section."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    path = tmp_path / "spring.py"
    path.write_text(
        FILE % "fp.Portrait('good', x='state.q', y='error.q'), fp.Portrait('bad', x='state.p', y='state.q')"
    )
    comparison = fp.compare(fp.load_problem(str(path)), seed=0, compiled=False)
    (good, bad), _ = own_pictures(comparison)
    assert good.source.startswith("data:image/png")
    assert not bad.source
    page = render(comparison).partition("Pictures of this problem")[2].partition("</section>")[0]
    assert page.count("<img") == 1
    assert "bad is not drawn" in page
    first: Any = comparison.pictures[0]
    absent = replace(first, controllers=("RHC",))
    assert own_pictures(replace(comparison, pictures=(absent,))) == ([], [])
    assert "Pictures of this problem" not in render(replace(comparison, pictures=()))


def test_a_heat_map_has_one_scale_for_all_runs(runs):
    """A row for each signal from the bottom up, and the extremes of all panels as the ends of the colours."""
    figure = Figure()
    fp.HeatMap("h", rows=("error.q", "reference.q"), place="rod", quantity="position").draw(figure, runs)
    slow, quick, scale = figure.axes
    values = [np.array([run["error.q"], run["reference.q"]]) for run in runs.values()]
    for axis, own in zip((slow, quick), values, strict=True):
        [mesh] = axis.collections
        np.testing.assert_array_equal(mesh.get_array(), own)
        assert mesh.get_clim() == (np.min(values), np.max(values))
    assert [axis.get_title() for axis in (slow, quick)] == ["slow", "quick"]
    assert (slow.get_ylabel(), quick.get_xlabel(), scale.get_ylabel()) == ("rod", "time [s]", "position [m]")


def test_many_cycles_of_a_heat_map_are_averaged():
    """A column is the mean of its interval, so the mean of the whole is kept."""
    values = np.random.default_rng(3).normal(size=20_000)
    columns = averaged(values, 1000)
    assert columns.shape == (1000,)
    assert columns[0] == pytest.approx(values[:20].mean())
    np.testing.assert_array_equal(averaged(values[:1000], 1000), values[:1000])


def test_a_heat_map_has_rows_of_one_unit(runs):
    """The scale has one unit; without a row there is nothing to draw."""
    mixed = fp.HeatMap("h", rows=("state.q", "state.q'"))
    with pytest.raises(InvalidValue, match=r"one scale of colours shows one unit, and rows have m, m/s"):
        mixed.draw(Figure(), runs)
    with pytest.raises(InvalidValue, match=r"expected at least one signal, such as 'state.q'"):
        fp.HeatMap("h", rows=())


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
