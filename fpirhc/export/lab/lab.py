"""A page with sliders: the closed loops of a problem as WebAssembly, run anew in the browser while a slider moves.

Sliders write numbers into the loop's first memory, where parameters and live settings are. One whose number changes anything else
there, which Python would have to compute, is left out, and the page says why. Scales of plans and the first plan are those
of the build.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.errors import FpirhcError, InvalidValue, NotSupported, package
from fpirhc.export.lab.loop import LabLoop
from fpirhc.export.targets.c import template
from fpirhc.problem_files.problem_file import Task
from fpirhc.problem_files.settings import unit_of_setting
from fpirhc.report.html import asset
from fpirhc.simulation.drawing import PALETTE
from fpirhc.simulation.path import loses
from fpirhc.simulation.pictures import planar
from fpirhc.simulation.pictures.base import Picture
from fpirhc.simulation.pictures.planar import Planar
from fpirhc.simulation.run import judged_motion
from fpirhc.simulation.simulate import Simulator, simulator
from fpirhc.simulation.trials import warn_of_harm
from fpirhc.studies.comparison.compare import select
from fpirhc.symbolic.open import PREFIX
from fpirhc.symbolic.paths import changed_at, paths_to
from fpirhc.task.problem import Problem
from fpirhc.whole_file import write_whole

_SPAN = 4.0  # a slider goes from a fourth to four times its number
_SETTINGS = ("gain", "rate")  # sliders where nobody asks for others, beside the limits of inputs


@dataclass(frozen=True)
class Slider:
    """A number that is moved in the page."""

    # of a live setting, or exact.NAME and approximate.NAME of a parameter
    path: str
    unit: str  # of it
    value: float  # number of the build
    low: float  # smallest number
    high: float  # largest number
    places: dict[int, list[int]]  # entries of the loops' memories, by the number of the loop


@dataclass(frozen=True, eq=False)
class Lab:
    """Loops and sliders of a page.

    Args:
        title: of the problem.
        about: its description.
        file: by which `fpirhc.load_problem` finds it.
        loops: of the controllers.
        sliders: numbers to be moved.
        without: reasons why a number has no slider, by path.
    """

    title: str
    about: str
    file: str
    loops: tuple[LabLoop, ...]
    sliders: tuple[Slider, ...]
    without: dict[str, str]


def lab_of(task: Task, file: str, names: Sequence[str] = (), live: Sequence[str] = ()) -> Lab:
    """Return the lab of some controllers of a problem file, or of the pair of its headline; see `make_lab`."""
    chosen = names or task.headline or list(task.controllers)[:2]
    controllers = select(task, list(chosen))
    shown = {name: controllers[name] for name in chosen}
    return make_lab(task.name, task.title, file, task.problem, shown, live, task.pictures)


def make_lab(
    title: str,
    about: str,
    file: str,
    problem: Problem,
    controllers: dict[str, Controller],
    live: Sequence[str] = (),
    pictures: Sequence[Picture] = (),
) -> Lab:
    """Return the loops of some controllers with their sliders.

    Args:
        problem: the task; its equations run in the page, so a reality outside cannot.
        live: paths of settings with a slider; none: gains, rates and limits of inputs.
        pictures: of the problem; the first `Planar` moves with the loops.
    """
    problem.require_equations(
        "a lab runs the plant's equations in the page; a plant outside Python's equations has none"
    )
    if loses(problem):
        raise NotSupported(
            "a page steps its loop without the driver that runs missing cycles afterwards; leave dropout and range out of sensors"
        )
    package("ziglang", "compiler", "a lab")
    loops, without = [], dict[str, str]()
    for name, controller in controllers.items():
        warn_of_harm(problem, controller)
        ready = _with_live(problem, controller, list(live) or _usual(problem, controller), without)
        loops.append(LabLoop(name, ready, _mechanism(ready, pictures, without)))
    lost = [path for path in live if not any(loop.opens(path) for loop in loops)]
    if lost:
        raise InvalidValue(
            f"no controller of the lab can have '{lost[0]}' live: {without.get(lost[0], 'it is not there')}"
        )
    sliders = [*_settings(loops, without), *_parameters(problem, loops, without)]
    return Lab(title, about, file, tuple(loops), tuple(sliders), without)


def _mechanism(ready: Simulator, pictures: Sequence[Picture], without: dict[str, str]) -> Planar | None:
    """The first picture of a mechanism, whose state and parameters the loop must have."""
    picture = next((one for one in pictures if isinstance(one, Planar)), None)
    if picture is None:
        return None
    loop = ready.loop
    lost = [name for name in picture.columns(loop.trace) if name not in loop.trace.columns]
    if not lost and loop.memory["_exact"].elements == tuple(picture.plant.parameters):
        return picture
    without[picture.title] = (
        f"the plant that moves has no '{lost[0]}'" if lost else "the plant that moves is another one"
    )
    return None


def _usual(problem: Problem, controller: Controller) -> list[str]:
    """Gains and rates of a controller, and the limits of inputs that are finite."""
    own = [path for name in _SETTINGS for path in paths_to(name, controller) if not path.startswith("optimiser.")]
    return [*own, *(f"limits.inputs.{name}" for name, ends in problem.limits.inputs.items() if np.isfinite(ends).any())]


def _with_live(problem: Problem, controller: Controller, wanted: list[str], without: dict[str, str]) -> Simulator:
    """The loop with those of the settings that it can keep open; reasons for the others."""
    open_paths: list[str] = []
    ready = simulator(problem, controller, compiled=False)
    for path in wanted:
        try:
            ready = simulator(problem, controller, compiled=False, live=[*open_paths, path])
            open_paths.append(path)
        except FpirhcError as error:
            without[path] = str(error)  # of the last controller, which adapts where only one does
    return ready


def _parameters(problem: Problem, loops: Sequence[LabLoop], without: dict[str, str]) -> list[Slider]:
    """Sliders of the plant's parameters: those of the plant, and those that the controllers believe."""
    sliders = []
    for name, parameter in problem.plant.parameters.items():
        for side, value in (("exact", parameter.exact), ("approximate", parameter.approximate)):
            other = changed_at(problem, f"plant.parameters.{name}.{side}", value * (1 + 2**-10))
            path = f"{side}.{name}"
            if not value:
                without[path] = "it is zero: nothing says how far a slider would go"
                continue
            places = _places(loops, lambda loop, other=other: loop.started(other), path, without)  # type: ignore[misc]
            if places:
                low, high = np.clip(sorted((value / _SPAN, value * _SPAN)), *parameter.bounds).tolist()
                sliders.append(Slider(path, parameter.unit, float(value), low, high, places))
    return sliders


def _settings(loops: Sequence[LabLoop], without: dict[str, str]) -> list[Slider]:
    """Sliders of the live settings, within the bounds that each of them has."""
    sliders = []
    for path in dict.fromkeys(path for loop in loops for path in loop.ready.live.paths):
        having = [loop for loop in loops if path in loop.ready.live.paths]
        value = having[0].ready.live.start[path]
        size, bounds = max(abs(value), 1e-3), []
        for live in (loop.ready.live for loop in having):
            own = abs(live.start[path])  # a loop may begin with another number
            bounds.append(live.bounds(path, (_SPAN * size + own) / max(own, 1e-3)))
        low, high = max(low for low, _ in bounds), min(high for _, high in bounds)
        low, high = (
            max(low, value / _SPAN if low > 0 else min(value / _SPAN, value * _SPAN, value - size)),
            min(high, max(value / _SPAN, value * _SPAN) if value else size),
        )
        step = value + 1e-4 * ((high - value) or (low - value))
        if step == value:
            without[path] = "its bounds leave no room"
            continue

        def started(loop: LabLoop, path: str = path, step: float = step) -> np.ndarray:
            return loop.written({path: step}) if path in loop.ready.live.paths else loop.start

        places = _places(loops, started, path, without)
        if places:
            sliders.append(Slider(path, unit_of_setting(path, having[0].ready.problem), value, low, high, places))
    return sliders


def _places(
    loops: Sequence[LabLoop], started: Callable[[LabLoop], np.ndarray], path: str, without: dict[str, str]
) -> dict[int, list[int]]:
    """Where a number stands in each loop's memory; nothing where it moves more than itself."""
    places: dict[int, list[int]] = {}
    for number, loop in enumerate(loops):
        try:
            moved = np.flatnonzero(started(loop) != loop.start)
        except FpirhcError as error:
            without[path] = str(error)
            return {}
        columns = [loop.ready.loop.memory.columns[k] for k in moved]
        also = [name for name in columns if not _is_the_number(name, path)]
        if also:
            without[path] = (
                f"the start of {loop.name} is computed from it, and only Python does that: use fpirhc run --set"
            )
            return {}
        if moved.size:
            places[number] = moved.tolist()
    return places


def _is_the_number(column: str, path: str) -> bool:
    side, _, name = path.partition(".")
    owner = {"exact": ("_exact", "parameters"), "approximate": ("parameters",)}.get(side)
    return column == PREFIX + path if owner is None else column in {f"{one}.{name}" for one in owner}


# The page


def write_lab(lab: Lab, path: Path) -> None:
    """Write the page, atomically."""
    write_whole(page(lab), path, "lab")


def page(lab: Lab) -> str:
    """Return the page's text: it loads nothing, and runs its own scripts and WebAssembly alone."""
    problem = lab.loops[0].ready.problem
    data = {
        "title": lab.title,
        "file": lab.file,
        "timeUnit": problem.time_unit,
        "period": problem.period,
        "cycles": problem.cycles,
        "measured": problem.measure_from,
        "worker": _own("worker.js"),
        "colors": [PALETTE[k % len(PALETTE)] for k in range(len(lab.loops))],
        "loops": [_loop_data(loop) for loop in lab.loops],
        "sliders": [{**vars(s), "places": [s.places.get(k, []) for k in range(len(lab.loops))]} for s in lab.sliders],
        "without": lab.without,
        "charts": _charts(lab),
        "motion": _motion(lab),
    }
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    scripts = (asset("uPlot.iife.min.js"), asset("axes.js"), planar.script(), f"const DATA={text};\n{_own('lab.js')}")
    hashes = " ".join(f"'sha256-{base64.b64encode(hashlib.sha256(one.encode()).digest()).decode()}'" for one in scripts)
    policy = (
        f"default-src 'none'; script-src {hashes} 'wasm-unsafe-eval'; worker-src blob:; style-src 'unsafe-inline'; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )
    words = {
        "title": html.escape(lab.title),
        "about": html.escape(" ".join(lab.about.split())),
        "policy": policy,
        "styles": asset("uPlot.min.css") + asset("report.css") + planar.styles() + _own("lab.css"),
        "scripts": "\n".join(f"<script>{one}</script>" for one in scripts),
    }
    return template("page.html", words, __package__)


def _own(name: str) -> str:
    return template(name, {}, __package__)


def _loop_data(loop: LabLoop) -> dict[str, Any]:
    return {
        "name": loop.name,
        "module": base64.b64encode(loop.module).decode(),
        "start": loop.start.tolist(),
        "tables": [base64.b64encode(np.ascontiguousarray(t, dtype="<f8").tobytes()).decode() for t in loop.tables],
        "every": loop.every,
        "cycles": loop.ready.problem.cycles,
        "shown": len(loop.shown),
        "errors": len(loop.ready.loop.trace[loop.error].columns),
        "live": list(loop.ready.live.paths),
        "frame": loop.frame,
        "shapes": loop.shapes,
        "responses": loop.factor.size1_out(0) if loop.factor else 0,
    }


def _motion(lab: Lab) -> dict[str, Any] | None:
    """What the page says of the mechanism; None where a loop has none."""
    first, problem = lab.loops[0], lab.loops[0].ready.problem
    if not all(loop.picture for loop in lab.loops) or first.picture is None:
        return None
    return first.picture.played(problem.duration, problem.time_unit) | {"step": first.frame * problem.period}


def _charts(lab: Lab) -> list[dict[str, Any]]:
    """One chart per coordinate, error and command; curves are columns of the loops."""
    trace, first = lab.loops[0].ready.loop.trace, lab.loops[0]
    names = trace[first.error].elements or (first.error,)
    charts = []
    for k, name in enumerate(names):
        unit = trace[first.error].entry_units[k]
        charts.append({"title": f"error of {name}", "unit": unit, "error": k, "column": f"{first.error}.{name}"})
        charts.append(
            {"title": name, "unit": unit, "column": f"{judged_motion(trace)}.{name}", "aim": f"reference.{name}"}
        )
    command = trace["command"]
    charts += [
        {"title": f"command {name}", "unit": unit, "column": f"command.{name}"}
        for name, unit in zip(command.elements, command.entry_units, strict=True)
    ]
    for chart in charts:
        chart["places"] = [_place(loop, str(chart["column"])) for loop in lab.loops]
        chart["aims"] = _place(first, str(chart["aim"])) if "aim" in chart else None
    return charts


def _place(loop: LabLoop, column: str) -> int | None:
    return loop.shown.index(column) if column in loop.shown else None
