"""A page with sliders: the closed loops of a problem as WebAssembly, run anew in the browser while a slider moves.

Sliders write parameters, gains and limits of inputs into the loop's first memory. A parameter that changes anything else there,
which Python would have to compute, has none. Scales of plans and the first plan are those of the build.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections import ChainMap
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.errors import FpirhcError, package, require
from fpirhc.export import Device, Target, c_of, literal, web_module
from fpirhc.export.c import checks_of, data_of, filled, layout_of, recorded, sources, template
from fpirhc.problem_files.problem_file import Task
from fpirhc.report.html import asset
from fpirhc.simulation.drawing import colours_of
from fpirhc.simulation.loop import start_memory
from fpirhc.simulation.ranges import Ranges
from fpirhc.simulation.replay import needs_driver
from fpirhc.simulation.run import judged_motion
from fpirhc.simulation.simulate import Simulator
from fpirhc.simulation.tables import run_tables
from fpirhc.simulation.trials import warn_of_harm
from fpirhc.symbolic.dotted import changed_at
from fpirhc.symbolic.driver import SIGNATURE
from fpirhc.task.problem import Problem
from fpirhc.whole_file import write_whole

_SPAN = 4.0  # a slider goes from a fourth to four times its number
_POINTS = 2000  # of a curve


@dataclass(frozen=True, eq=False)
class LabLoop:
    """A closed loop that a page runs."""

    name: str  # of the controller
    ready: Simulator

    @cached_property
    def start(self) -> np.ndarray:
        """The first memory."""
        return self.started(self.ready.problem)

    def started(self, problem: Problem) -> np.ndarray:
        """Return the first memory with other parameters."""
        return start_memory(self.ready.loop, problem, self.ready.controller)

    @cached_property
    def shown(self) -> list[str]:
        """Columns that the page draws."""
        trace = self.ready.loop.trace
        groups = ("time", "reference", judged_motion(trace), "command", self.error)
        return [column for name in groups for column in trace[name].columns]

    @property
    def error(self) -> str:
        """The signal of the error that counts: the plant's own where sensors show another."""
        return "true_error" if "true_error" in self.ready.loop.trace else "error"

    @property
    def every(self) -> int:
        """A curve has one point per so many cycles."""
        return max(1, self.ready.problem.cycles // _POINTS)

    @cached_property
    def tables(self) -> list[np.ndarray]:
        """Disturbances, the sensors' noise and set-points of the run with seed 0, one row per cycle."""
        return run_tables(self.ready.problem, 0, self.ready.problem.cycles)

    @cached_property
    def module(self) -> bytes:
        """The loop as WebAssembly."""
        problem, loop = self.ready.problem, self.ready.loop
        own, sizes = c_of(loop.function, "lab")
        places = {name: k for k, name in enumerate(loop.trace.columns)}
        errors, ranges = loop.trace[self.error].columns, Ranges(problem, loop.trace)
        count = [table.shape[1] for table in self.tables]
        numbers = {
            "memory": loop.memory.size,
            "trace": loop.trace.size,
            "cycles": problem.cycles,
            "every": self.every,
            "shown": len(self.shown),
            "errors": len(errors),
            "first": int(np.ceil(problem.measure_from / problem.period - 1e-9)),
        }
        lists = {
            "places": (places[name] for name in self.shown),
            "bounded": ranges.columns,
            "lower": map(literal, ranges.lower),
            "upper": map(literal, ranges.upper),
            "error_places": (places[name] for name in errors),
        }
        words = {
            **{key: str(size + 4) for key, size in sizes.items()},
            **{key: str(number) for key, number in numbers.items()},
            **{key: ", ".join(map(str, some)) for key, some in lists.items()},
            "declaration": f"int lab_raw{SIGNATURE};".replace("casadi_real", "double").replace(
                "casadi_int", "long long"
            ),
            "tables": "\n".join(
                f'static double table_{k}[CYCLES * {size}];\nEXPORT("table_{k}") void* at_{k}(void) {{ return table_{k}; }}'
                for k, size in enumerate(count)
            ),
            "arguments": "\n".join(f"    arg[{k + 1}] = table_{k} + k * {size};" for k, size in enumerate(count)),
        }
        files = {f"lab_step{k}.c": text for k, text in enumerate(own)}
        return web_module({**files, "lab_run.c": template("loop.c", words)})


def write_lab(task: Task, file: str, controllers: dict[str, Controller], path: Path) -> None:
    """Write the page of some controllers of a task, which `fpirhc.load_problem` finds by `file`."""
    problem = task.problem
    driven = needs_driver(problem)
    require(not driven, f"a page has no driver between the cycles of its loop; leave out {driven}")
    package("ziglang", "compiler", "a lab")
    loops = []
    for name, controller in controllers.items():
        warn_of_harm(problem, controller)
        loops.append(LabLoop(name, Simulator.adjustable(problem, controller)))
    write_whole(_page(task, file, loops), path, "lab")


def _sliders(problem: Problem, loops: list[LabLoop]) -> list[dict[str, Any]]:
    """Numbers to be moved: path, unit, the number of the build, its range, and its places in the memory of every loop."""
    found, rows = [], [loop.ready.numbers for loop in loops]
    for path, (unit, value, bounds, _) in ChainMap(*rows).items():
        ends = np.clip(sorted((value / _SPAN, value * _SPAN)), *bounds).tolist()
        found.append((path, unit, value, *ends, [own.get(path, ())[-1:] for own in rows]))
    for name, parameter in problem.plant.parameters.items():
        for side, value in (("exact", parameter.exact), ("approximate", parameter.approximate)):
            other = changed_at(problem, f"plant.parameters.{name}.{side}", value * (1 + 2**-10))
            ends = np.clip(sorted((value / _SPAN, value * _SPAN)), *parameter.bounds).tolist()
            own = {"exact": {f"_exact.{name}", f"parameters.{name}"}, "approximate": {f"parameters.{name}"}}[side]
            moved = [_moved(loop, other, own) for loop in loops]
            if value and None not in moved:
                found.append((f"{side}.{name}", parameter.unit, float(value), *ends, moved))
    keys = ("path", "unit", "value", "low", "high", "places")
    return [dict(zip(keys, one, strict=True)) for one in found if one[3] < one[4] and any(one[5])]


def _moved(loop: LabLoop, problem: Problem, own: set[str]) -> list[int] | None:
    """Where the first memory of another problem differs; None where it is elsewhere too, or cannot be computed."""
    try:
        places = np.flatnonzero(loop.started(problem) != loop.start).tolist()
    except FpirhcError:
        return None
    return places if {loop.ready.loop.memory.columns[k] for k in places} <= own else None


def _page(task: Task, file: str, loops: list[LabLoop]) -> str:
    """The page's text: it loads nothing, and runs its own scripts and WebAssembly alone."""
    problem = loops[0].ready.problem
    data = {
        "file": file,
        "timeUnit": problem.time_unit,
        "period": problem.period,
        "cycles": problem.cycles,
        "measured": problem.measure_from,
        "worker": template("worker.js", {}),
        "colors": [colours_of(task.controllers)[one.name] for one in loops],
        "loops": [_loop_data(loop) for loop in loops],
        "sliders": _sliders(problem, loops),
        "charts": _charts(loops),
    }
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    own = f"const DATA={text};\n{template('lab.js', {})}"
    scripts = asset("uPlot.iife.min.js"), asset("axes.js"), own
    hashes = " ".join(f"'sha256-{base64.b64encode(hashlib.sha256(one.encode()).digest()).decode()}'" for one in scripts)
    policy = (
        f"default-src 'none'; script-src {hashes} 'wasm-unsafe-eval'; worker-src blob:; style-src 'unsafe-inline'; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )
    words = {
        "title": html.escape(task.name),
        "about": html.escape(" ".join(task.title.split())),
        "policy": policy,
        "styles": asset("uPlot.min.css") + asset("report.css"),
        "scripts": "\n".join(f"<script>{one}</script>" for one in scripts),
    }
    return template("page.html", words)


def _loop_data(loop: LabLoop) -> dict[str, Any]:
    return {
        "name": loop.name,
        "module": base64.b64encode(loop.module).decode(),
        "start": loop.start.tolist(),
        "tables": [base64.b64encode(np.ascontiguousarray(t, dtype="<f8").tobytes()).decode() for t in loop.tables],
        "every": loop.every,
        "shown": len(loop.shown),
        "errors": len(loop.ready.loop.trace[loop.error].columns),
        "live": list(loop.ready.numbers),
    }


def _charts(loops: list[LabLoop]) -> list[dict[str, Any]]:
    """One chart per coordinate, error and command; curves are columns of the loops."""
    trace, error = loops[0].ready.loop.trace, loops[0].error
    charts: list[dict[str, Any]] = []
    for k, name in enumerate(trace[error].elements or (error,)):
        unit, motion = trace[error].entry_units[k], judged_motion(trace)
        charts.append({"title": f"error of {name}", "unit": unit, "error": k, "column": f"{error}.{name}"})
        charts.append({"title": name, "unit": unit, "column": f"{motion}.{name}", "aim": f"reference.{name}"})
    for name, unit in zip(trace["command"].elements, trace["command"].entry_units, strict=True):
        charts.append({"title": f"command {name}", "unit": unit, "column": f"command.{name}"})
    for chart in charts:
        chart["places"] = [_place(loop, chart["column"]) for loop in loops]
        chart["aims"] = _place(loops[0], chart.get("aim", ""))
    return charts


def _place(loop: LabLoop, column: str) -> int | None:
    return loop.shown.index(column) if column in loop.shown else None


def _files(device: Device) -> Mapping[str, str | bytes]:
    name, layout, structs = device.name, layout_of(device), data_of(device)
    calls = [f'EXPORT("{part}") void* get_{part}(void) {{ return &c.{part}; }}' for part in structs]
    for check, _ in checks_of(device).values():
        calls.append(f'EXPORT("set") int put(int which, double value) {{ return {check}(&c, which, value); }}')
    files = {**sources(device), f"{name}_wasm.c": filled(device, "wasm.c", data="\n".join(calls))}
    text = json.dumps(layout, indent=1)
    return {
        f"{name}.wasm": web_module(files),
        f"{name}.mjs": filled(device, "wasm.mjs", layout=text, data=json.dumps(list(structs))),
        "layout.json": text,
        "samples.bin": recorded(device),
        "replay.mjs": filled(device, "wasm_replay.mjs"),
    }


TARGETS = (Target("wasm", _files),)
