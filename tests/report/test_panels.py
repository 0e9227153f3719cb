"""Panels show what they are given: every number at its place, no text outside the picture, and nothing of a bad number."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure

from fpirhc.simulation.panels import Panel, Panels

SVG = "{http://www.w3.org/2000/svg}"


def drawn(figure: Panels) -> ElementTree.Element:
    return ElementTree.fromstring(figure.svg())


def frames(root: ElementTree.Element) -> list[tuple[float, float]]:
    """Widths and heights of the frames."""
    boxes = [one.find(f"{SVG}rect") for one in root.iter(f"{SVG}clipPath")]
    return [(float(box.attrib["width"]), float(box.attrib["height"])) for box in boxes if box is not None]


def lines(root: ElementTree.Element) -> list[np.ndarray]:
    """Points of every piece of every line, in pixels of its frame."""
    pieces = []
    for group in root.iter(f"{SVG}g"):
        if group.get("transform", "").startswith("scale"):
            for path in group.iter(f"{SVG}path"):
                for piece in re.findall(r"M([^M]+)", path.attrib["d"]):
                    steps = np.array([int(n) for n in re.findall(r"-?\d+", piece)]).reshape(-1, 2)
                    pieces.append(steps.cumsum(axis=0) / 10)
    return pieces


def words(root: ElementTree.Element) -> list[str]:
    return [one.text or "" for one in root.iter(f"{SVG}text")]


def one_panel() -> tuple[Panels, Panel]:
    figure = Panels(8, 3)
    return figure, figure.axes[0]


def distance(points: np.ndarray, line: np.ndarray) -> float:
    """The largest distance of points from a line with corners."""
    begin, along = line[:-1], np.diff(line, axis=0)
    lengths = np.maximum((along**2).sum(axis=1), 1e-12)
    share = np.clip(np.einsum("nij,ij->ni", points[:, None] - begin, along) / lengths, 0, 1)
    return float(np.linalg.norm(points[:, None] - begin - share[..., None] * along, axis=2).min(axis=1).max())


@pytest.mark.parametrize("kind", ["sine", "noise", "spike", "loop", "steps"])
def test_a_line_is_where_its_numbers_are(kind):
    """Within half a pixel, whatever points are left out: no spike is lost, and no place is passed that was not reached."""
    time = np.linspace(0, 10, 2000)
    x, y = {
        "sine": (time, np.sin(3 * time)),
        "noise": (time, np.random.default_rng(0).normal(size=time.size)),
        "spike": (time, np.where(np.arange(time.size) == 777, 50.0, 0.0)),
        "loop": (np.sin(time), np.cos(7 * time)),
        "steps": (time, np.floor(time)),
    }[kind]
    figure, panel = one_panel()
    panel.plot(x, y, color="#000000")
    root = drawn(figure)
    [(width, height)], [line] = frames(root), lines(root)
    (left, right), (low, high) = panel.get_xlim(), panel.get_ylim()
    wanted = np.stack([(x - left) / (right - left) * width, (high - y) / (high - low) * height], axis=1)
    assert distance(wanted, line) < 0.5
    assert distance(line, wanted) < 0.5
    assert len(line) <= len(wanted)


@pytest.mark.parametrize("logarithmic", [False, True])
def test_the_ranges_are_those_of_matplotlib(logarithmic):
    """All that is drawn with a margin of a twentieth, lines across included; only positive numbers have a logarithm."""
    values = np.array([0.02, 3.0, 40.0, 0.5])
    axis, (_, panel) = Figure().subplots(), one_panel()
    for one in (axis, panel):
        (one.semilogy if logarithmic else one.plot)(np.arange(4.0), values, color="#000000")
        one.axhline(70.0, color="#000000")
        one.axvline(-2.0, color="#000000")
    assert panel.get_xlim() == pytest.approx(axis.get_xlim())
    assert panel.get_ylim() == pytest.approx(axis.get_ylim())


@pytest.mark.parametrize("size", [1e-9, 0.02, 1.0, 30.0, 4e7])
@pytest.mark.parametrize("middle", [0.0, 5.0])
def test_the_numbers_of_the_ticks_are_their_places(size, middle):
    """Read with their common factor they lie at even steps inside the frame, each where its number is, and they stand apart."""
    figure, panel = one_panel()
    panel.plot(np.linspace(middle - 1, middle + 1, 9) * size, np.zeros(9), color="#000000")
    root = drawn(figure)
    [(width, height)] = frames(root)
    below = [one for one in root.iter(f"{SVG}text") if float(one.attrib["y"]) > height]
    [factor] = [float(one.text or "") for one in below if (one.text or "").startswith("1e")] or [1.0]
    ticks = [one for one in below if not (one.text or "").startswith("1e")]
    numbers = np.array([float((one.text or "").replace("−", "-")) for one in ticks]) * factor
    at = np.array([float(one.attrib["x"]) for one in ticks])
    left, right = panel.get_xlim()
    assert 3 <= len(ticks) <= 10
    np.testing.assert_allclose(at, (numbers - left) / (right - left) * width, atol=0.2)
    assert np.all(np.diff(at) > 6 * max(len(one.text or "") for one in ticks))


def test_a_number_that_is_none_leaves_a_gap():
    """NaN, infinity and numbers without a logarithm are not drawn and do not move the ranges; a frame is always left."""
    figure, panel = one_panel()
    panel.plot(np.arange(7.0), np.array([0, 1, np.nan, 2, 1, np.inf, 0]), color="#000000")
    assert [len(piece) for piece in lines(drawn(figure))] == [2, 2, 1]
    assert panel.get_ylim() == pytest.approx((-0.1, 2.1))
    figure, panel = one_panel()
    panel.semilogy(np.arange(3.0), np.array([-1.0, 0.0, np.nan]), color="#000000")
    assert "nan" not in figure.svg()
    assert lines(drawn(figure)) == []


def test_names_are_shown_as_they_are():
    """No markup and no formula is read from a name; the legend has every label once, and a dollar sign is one."""
    figure, panel = one_panel()
    panel.plot(np.arange(2.0), np.arange(2.0), color="#000000", label=r"a<b>&amp; \$x\$")
    panel.set_title("<script>")
    panel.set_ylabel("q' [m/s]")
    panel.legend()
    shown = words(drawn(figure))
    assert shown.count("a<b>&amp; $x$") == 1
    assert {"<script>", "q' [m/s]"} <= set(shown)


def test_a_legend_lies_where_no_line_is():
    """A line in the upper right corner moves the legend elsewhere."""
    places = []
    for top in (False, True):
        figure, panel = one_panel()
        panel.plot(np.linspace(0, 1, 500), np.zeros(500), color="#000000")
        x = np.linspace(0.5, 1, 500) if top else np.linspace(0, 0.5, 500)
        panel.plot(x, np.ones(500), color="#000000", label="line")
        panel.legend()
        [box] = [one for one in drawn(figure).iter(f"{SVG}rect") if one.get("rx")]
        places.append(float(box.attrib["x"]))
    assert places[0] > places[1]
