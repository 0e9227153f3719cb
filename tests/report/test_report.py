"""The report: one file, safe, complete, or not there."""

import base64
import hashlib
import html
import io
import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import tasks
from helpers.plants import sine_of_three
from matplotlib.colors import to_rgb
from matplotlib.image import imread

import fpirhc as fp
from fpirhc.errors import OutputError

COLOURS = {"plain": "#0072b2", "adaptive": "#d55e00", "exact": "#009e73"}  # by the place in the file


def compared(*controllers: str, pictures: Sequence[Any] = (), **changes: Any) -> Any:
    """A linear plant with a wrong model along a sine: a pair with and without adaptation, and one with the exact model."""
    track, form, noise = fp.Exponential(rate=6.0), fp.Sigmoid(gain=-0.5, scale=5.0), {"u": fp.Noise(0.01)}
    every = {"plain": fp.ComputedTorque(track), "adaptive": fp.ComputedTorque(track, form)}
    every["exact"] = fp.ExactModel(every["plain"])
    usual = {"start": {"y": 0.3}, "duration": 1.0, "measure_from": 0.0, "disturbances": noise}
    about = {"description": "    y = 2 x\n\nIts task.", "pictures": tuple(pictures)}
    task = tasks.made(replace(sine_of_three(), **usual | changes), every, **about)
    return fp.compare(task, controllers=controllers or None, seed=0, compiled=False)


def ended() -> Any:
    """The first controller has a run of 300 cycles."""
    found = compared()
    entry = found["plain"]
    short = replace(entry.run, log=entry.run.log[:300], stop="signal 'x' is not finite at t = 0.3 s")
    own = replace(entry, run=short, metrics=fp.measure(found.task.problem, short))
    return replace(found, entries=(own, *found.entries[1:]))


def daily() -> Any:
    """A tumour with a dose a day, for thirty days."""
    task = tasks.tumour_daily
    short = replace(task.problem, duration=30.0, measure_from=10.0)
    return fp.compare(replace(task, problem=short), seed=0, controllers=["RHC", "RHC+FPI"], compiled=False)


HOSTILE = "<script>alert('x')</script> \"& [bold]\x1b[31m</b>"


def hostile() -> Any:
    """Names with tags, markup and control characters."""
    track, line = fp.Exponential(rate=6.0), tasks.two_mass.problem
    controllers = {"CTC": fp.ComputedTorque(track), HOSTILE: fp.ComputedTorque(track, fp.Sigmoid(gain=-0.5))}
    short = replace(line, duration=0.05, measure_from=0.0, horizon=None, cost=None)
    return fp.compare(tasks.made(short, controllers, title=HOSTILE, description=HOSTILE), seed=0, compiled=False)


@dataclass(frozen=True)
class Page:
    """A comparison, what its page has and what it has not (both as patterns), what it shows as text, and ends of its charts."""

    found: Callable[[], Any]
    has: Sequence[str] = ()
    lacks: Sequence[str] = ()
    shows: Sequence[str] = ()
    ends: dict[str, Any] = field(default_factory=dict)


GOOD, BAD = (
    fp.Portrait(n, x=f"state.{x}", y="error.y", controllers=("adaptive",)) for n, x in (("good", "y"), ("bad", "p"))
)
ENDS = fp.Limits(inputs={"u": (-20.0, math.inf)}, states={"y": (-9.0, 9.0), "y'": (-4.0, 5.0)}, prices={"y": 1.0})
SECONDS = r"\d s\b|\[s\]|\b1/s\b|/s\^|[A-Za-z\)]/s\b| s\]"  # a number in seconds, or a unit that has them
PAGES = {
    "whole": Page(
        partial(compared, pictures=(GOOD, BAD)),
        [
            r"(?s)id='verdict'.*<table>.*<h2>Signals over time.*<h2>Pictures.*<h3>Contraction.*<h2>The problem.*<h2>Settings",
            # settings as Python, and only what is no default
            r"<pre>fp.ExactModel\(controller=fp.ComputedTorque\(tracking=fp.Exponential\(rate=6.0\)\)\)</pre>",
            r"deformation=fp.Sigmoid\(gain=-0.5, scale=5.0\)",
            "<pre class='about'>y = 2 x</pre><p class='about'>Its task.</p>",
            "<img[^>]*good: adaptive", "bad is not drawn",
        ]),
    "part": Page(partial(compared, "exact", "adaptive"), lacks=["Pictures of this problem"]),
    # A limited state that nobody judges has a chart; a price is no limit, and an error and a free input have none.
    "limited": Page(
        partial(compared, "plain", limits=ENDS),
        ends={"y": ("m", []), "command u": ("N", [-20.0, None]), "y'": ("m/s", [-4.0, 5.0])}),
    "left": Page(
        partial(compared, "plain", limits=fp.Limits(states={"y'": (-1.0, 1.0)})),
        ["<tr class='red'><th scope='row'>plain</th>", "class='outcome-violates-a-limit'>plain violates a limit: y&#39; reach"]),
    "ended": Page(ended, ["does not finish: signal &#39;x&#39; is not finite", "<td class='none'>none</td>"]),
    "empty": Page(lambda: replace(compared("plain"), entries=(), skipped={"x": "because"}), ["No controller finished"]),
    "days": Page(daily, [r"\[day\]"], [SECONDS]),
    "hostile": Page(hostile, shows=["<script>alert('x')</script>"]),
}  # fmt: skip


@pytest.mark.parametrize("name", PAGES)
def test_a_page(name, tmp_path):
    """It fetches nothing, runs its own scripts alone, shows names as they are, and no peak of a chart is lost."""
    wanted = PAGES[name]
    found, path = wanted.found(), tmp_path / "report.html"
    fp.write_report(found, path)
    assert [one.name for one in tmp_path.iterdir()] == ["report.html"]
    page = path.read_text(encoding="utf-8")
    assert len(page) < 3_000_000
    assert not re.search(r"""(src|href)\s*=\s*['"](?!data:)|@import""", page)
    own_scripts_alone(page)
    assert "alert('x')</script>" not in page
    assert [one for one in wanted.has if not re.search(one, page)] == []
    said = re.sub(r"(?s)<(script|style)>.*?</\1>|data:image[^']*|took [\d.]+ s\.", " ", page)
    assert [one for one in wanted.lacks if re.search(one, said)] == []
    for text in (said, found._repr_html_()) if found.entries else ():
        assert not re.search(r"<(b|bold)\b", text)
        assert [one for one in wanted.shows if one not in html.unescape(text)] == []
    told = repr(found)
    assert ("\x1b" in told, "at limit" in told, "Problem(" in told) == (False, bool(found.entries), False)
    charts_are_whole(found, page, wanted.ends)
    with pytest.raises(OutputError, match="cannot write the report"):
        fp.write_report(found, tmp_path / "missing" / "report.html")


def own_scripts_alone(page: str) -> None:
    """Every script is named by its hash, no source elsewhere is allowed, and the policy stands before all scripts."""
    [policy] = re.findall(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', page)
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    scripts = re.findall(r"<script>(.*?)</script>", page, flags=re.DOTALL)
    hashes = [f"'sha256-{base64.b64encode(hashlib.sha256(s.encode()).digest()).decode()}'" for s in scripts]
    assert rules["script-src"].split() == hashes
    assert rules["default-src"] == rules["base-uri"] == rules["form-action"] == "'none'"
    assert rules["img-src"] == "data:"
    assert page.index("Content-Security-Policy") < page.index("<script")


def charts_are_whole(found: Any, page: str, ends: dict[str, Any]) -> None:
    """Each controller has the colour of its place in the file, also in pictures; errors have their extremes."""
    begin = page.index("DATA", page.index('{"controllers"') - 20)
    data = json.JSONDecoder().raw_decode(page[page.index("{", begin) :])[0]
    assert [one["name"] for one in data["controllers"]] == [e.name for e in found.entries]
    assert [one["color"] for one in data["controllers"] if COLOURS.get(one["name"], one["color"]) != one["color"]] == []
    charts = {one["title"]: one for one in data["charts"]}
    shown = {title: (chart["unit"], chart["limits"]) for title, chart in charts.items() if "limits" in chart}
    assert shown == (ends or shown)
    for entry in found.entries:
        quantity = entry.run.layout["error"].elements[0]
        [drawn] = [one["values"] for one in charts[f"error of {quantity}"]["series"] if one["name"] == entry.name]
        assert len(drawn) == len(data["time"])
        drawn, own = [v for v in drawn if v is not None], entry.run[f"error.{quantity}"]
        assert (max(drawn), min(drawn)) == pytest.approx((own.max(), own.min()), rel=1e-4)
    own = {e.name for e in found.entries} <= {*COLOURS}
    for png in re.findall(r"data:image/png;base64,([^']*)'", page) if own else ():
        pixels = imread(io.BytesIO(base64.b64decode(png)))[..., :3]
        near = [np.abs(pixels - np.array(to_rgb(COLOURS[n]))).max(axis=-1).min() for n in ("adaptive", "plain")]
        assert (near[0] < 0.15, near[1] > 0.3) == (True, True)


def test_the_plot_of_a_run_names_quantities_units_and_controller():
    """A chart has one unit; a concentration is no position; the name is that of the problem file and not of a class."""
    response = lambda q, u, p: {"c": p.k * u.F - q.c, "T": p.k * u.Q_dot - q.T}  # noqa: E731
    gain = {"k": fp.Parameter(1.0, 1.5, "1")}
    plant = fp.Plant({"c": "mol/s", "T": "K"}, {"F": "l/s", "Q_dot": "kW"}, gain, response, order=1)
    reference = fp.Trajectory(lambda t: {"c": ca.sin(t), "T": 5 * ca.cos(t)})
    one = fp.Problem(plant, reference, {"c": 0.0, "T": 4.0}, period=0.01, duration=0.5)
    loaded = tasks.made(one, {"pump, steady": fp.ComputedTorque(fp.Exponential(rate=6.0))})
    run = fp.simulate(loaded.problem, loaded.controllers["pump, steady"], seed=0, compiled=False)
    labels = [axis.get_ylabel() for axis in run.plot().axes]
    wanted = ["error of c [mol/s]", "error of T [K]", "c [mol/s]", "T [K]", "F [l/s]", "Q_dot [kW]"]
    assert labels == [*wanted, "responses of c [mol/s^2]"]
    assert run.controller == run.plot().get_suptitle() == "pump, steady"
