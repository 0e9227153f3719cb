"""A closed loop as WebAssembly: the curves, the mechanism's shapes and the contraction of a run, cycle by cycle."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.contraction.spectrum import response_jacobian
from fpirhc.errors import FpirhcError
from fpirhc.export.binaries import web_module
from fpirhc.export.device import c_of, literal
from fpirhc.export.targets.c import template
from fpirhc.simulation.changes import patch
from fpirhc.simulation.loop import start_memory
from fpirhc.simulation.pictures.planar import Planar
from fpirhc.simulation.ranges import ranges_of
from fpirhc.simulation.run import judged_motion
from fpirhc.simulation.simulate import Simulator
from fpirhc.simulation.tables import run_tables
from fpirhc.symbolic.driver import SIGNATURE
from fpirhc.symbolic.open import PREFIX
from fpirhc.task.problem import Problem

_POINTS = 2000  # of a curve
_FRAMES = 500  # of a mechanism that moves


@dataclass(frozen=True, eq=False)
class LabLoop:
    """A closed loop that a page runs."""

    name: str  # of the controller
    ready: Simulator  # the loop with its live settings
    picture: Planar | None = None  # the mechanism that moves with it; None: none

    @cached_property
    def start(self) -> np.ndarray:
        """The first memory."""
        return self.started(self.ready.problem)

    def started(self, problem: Problem) -> np.ndarray:
        """Return the first memory with other parameters."""
        if not self.ready.live.paths:
            return start_memory(self.ready.loop, problem, self.ready.controller)
        own, controller, values = self.ready.live.changed({})
        return start_memory(self.ready.loop, replace(own, plant=problem.plant), controller, values)

    def written(self, numbers: dict[str, float]) -> np.ndarray:
        """Return the first memory into which a device writes these settings."""
        memory, live = self.start.copy(), self.ready.live
        places, values = patch(self.ready.loop, live.changed(numbers)[2])
        memory[places] = values
        return memory

    def opens(self, path: str) -> bool:
        """Whether a slider moves this setting, or one end of it."""
        return any(one in (path, f"{path}.0", f"{path}.1") for one in self.ready.live.paths)

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

    @cached_property
    def module(self) -> bytes:
        """The loop as WebAssembly."""
        problem, loop = self.ready.problem, self.ready.loop
        own, sizes = c_of(loop.function, "lab")
        places = {name: k for k, name in enumerate(loop.trace.columns)}
        errors = loop.trace[self.error].columns
        ranges = ranges_of(problem, loop.trace)
        count = [table.shape[1] for table in self.tables]
        words = {
            **{key: str(size + 4) for key, size in sizes.items()},
            "declaration": f"int lab_raw{SIGNATURE};".replace("casadi_real", "double").replace(
                "casadi_int", "long long"
            ),
            "memory": str(loop.memory.size),
            "trace": str(loop.trace.size),
            "cycles": str(problem.cycles),
            "every": str(self.every),
            "shown": str(len(self.shown)),
            "errors": str(len(errors)),
            "first": str(int(np.ceil(problem.measure_from / problem.period - 1e-9))),
            "places": ", ".join(str(places[name]) for name in self.shown),
            "bounded": ", ".join(map(str, ranges.columns)),
            "lower": ", ".join(map(literal, ranges.lower)),
            "upper": ", ".join(map(literal, ranges.upper)),
            "error_places": ", ".join(str(places[name]) for name in errors),
            "tables": "\n".join(
                f'static double table_{k}[CYCLES * {size}];\nEXPORT("table_{k}") void* at_{k}(void) {{ return table_{k}; }}'
                for k, size in enumerate(count)
            ),
            "arguments": "\n".join(f"    arg[{k + 1}] = table_{k} + k * {size};" for k, size in enumerate(count)),
            "frame": str(self.frame),
            "drawing": "static void draw(int row, const double* held) { (void)row, (void)held; }",
        }
        files = {f"lab_step{k}.c": text for k, text in enumerate(own)}
        if self.seen.numel_out(0):
            drawn, sizes = c_of(self.seen, "lab_drawn")
            files |= {f"lab_drawn{k}.c": text for k, text in enumerate(drawn)}
            followed = [places[name] for name in self.followed]
            numbers = {"numbers": self.seen.numel_out(0)}
            words["drawing"] = template(
                "drawing.c",
                {key: str(size) for key, size in (sizes | numbers).items()}
                | {"declaration": words["declaration"].replace("lab_raw", "lab_drawn_raw")}
                | {"followed": ", ".join(map(str, followed)), "count": str(len(followed))},
                __package__,
            )
        files["lab_run.c"] = template("loop.c", words, __package__)
        return web_module(files)

    @property
    def every(self) -> int:
        """A curve has one point per so many cycles."""
        return max(1, self.ready.problem.cycles // _POINTS)

    @property
    def frame(self) -> int:
        """The mechanism has one frame per so many cycles."""
        return max(1, self.ready.problem.cycles // _FRAMES)

    @property
    def followed(self) -> list[str]:
        """Columns from which the numbers of a frame follow: those of the mechanism, and those of the contraction."""
        trace = self.ready.loop.trace
        drawn = self.picture.columns(trace) if self.picture else []
        return [*drawn, *(c for name in ("state", "deformed") if self.factor for c in trace[name].columns)]

    @property
    def shapes(self) -> int:
        """How many of the numbers of a frame are those of the mechanism."""
        return self.drawn.numel_out(0) if self.picture else 0

    @cached_property
    def drawn(self) -> ca.Function:
        """The Function (signals that the mechanism follows, exact parameters) -> numbers of its shapes."""
        assert self.picture is not None
        return self.picture.function(len(self.picture.columns(self.ready.loop.trace)))

    @cached_property
    def seen(self) -> ca.Function:
        """The Function (`followed`, memory) -> numbers of a frame: of the shapes, then I - a J W by columns."""
        loop = self.ready.loop
        values, memory = ca.MX.sym("v", len(self.followed)), ca.MX.sym("m", loop.memory.size)
        parts, held = [], loop.memory.split(memory)
        behind = self.drawn.size1_in(0) if self.picture else 0
        if self.picture:
            parts.append(self.drawn(values[:behind], held["_exact"]))
        if self.factor:
            state, deformed = ca.vertsplit(values[behind:], [0, loop.trace["state"].size, values.numel() - behind])
            parts.append(ca.vec(self.factor(state, deformed, held["_exact"], held["parameters"], memory)))
        return ca.Function("fpirhc_seen", [values, memory], [ca.densify(ca.vertcat(*parts))])

    @cached_property
    def factor(self) -> ca.Function | None:
        """The Function (state, deformed, exact, approximate, memory) -> I - a J W, which multiplies response errors in a cycle.

        None where nothing is deformed, or the plant is not the model's.
        """
        problem, loop, controller = self.ready.problem, self.ready.loop, self.ready.live.planted()[1]
        map_, model = controller.deformation, controller.plant_model(problem)
        own = problem.reality is None and not problem.signals and model.plant is problem.plant
        of_responses = map_.adapts and controller.response(problem) is None and controller.deforms != "target"
        known = {"_exact", "parameters"} <= {*loop.memory.names} and {"state", "deformed"} <= {*loop.trace.names}
        if not (own and of_responses and known) or controller.learns or problem.plant.equations.inverse_opaque:
            return None
        try:
            jacobian = response_jacobian(problem.plant)
        except FpirhcError:
            return None
        memory = ca.SX.sym("m", loop.memory.size)
        arguments = [ca.SX.sym(jacobian.name_in(k), jacobian.size1_in(k)) for k in range(4)]
        weights, gain = map_.iteration.weights, map_.effective_gain()
        weighted = jacobian(*arguments) @ (ca.DM.eye(arguments[1].numel()) if weights is None else ca.DM(weights))
        step = ca.SX.eye(arguments[1].numel()) - self._read(gain, memory) * weighted
        return ca.Function("fpirhc_factor", [*arguments, memory], [ca.densify(step)])

    def _read(self, number: float | ca.SX, memory: ca.SX) -> ca.SX:
        """A number with the live settings that the memory holds; the others are those of the build."""
        if not isinstance(number, ca.SX):
            return ca.SX(number)
        layout, start, made = self.ready.loop.memory, self.ready.live.start, number
        open_ones = ca.symvar(made)
        held = [
            memory[layout.slice(s.name()).start]
            if s.name() in layout.names
            else ca.SX(start[s.name().removeprefix(PREFIX)])
            for s in open_ones
        ]
        return ca.substitute(made, ca.vertcat(*open_ones), ca.vertcat(*held))

    @cached_property
    def tables(self) -> list[np.ndarray]:
        """Disturbances, the sensors' noise and set-points of the run with seed 0, one row per cycle."""
        return run_tables(self.ready.problem, 0, self.ready.problem.cycles)
