"""Plants of other packages under every controller: what the first study of them had, and the shipped problems.

.venv/bin/python benchmarks/outside_table.py [words of rows] [--write]     # seven minutes; --write puts it into docs/simulators.md

An error is rms after the start (of the lab the mean of three seeds), of a quadrotor the mean distance. Each row has the settings of
its shipped problem, some with another gain of FPI or another filter. A plant whose package is missing is left out with the reason.
`s`: processor time of all runs of the row.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

import fpirhc as fp
from fpirhc.controllers.contract import Controller
from fpirhc.errors import package
from fpirhc.problem_files.problem_file import Task
from fpirhc.problem_files.shipped import missing, shipped_groups

HERE = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(HERE / "benchmarks"), str(HERE / "problems" / "outside" / "quadbench")]
from table import write_table  # noqa: E402
from vehicle import BENCHMARK, FASTEST, MOTOR_NOISE, rotors  # noqa: E402

AXES, HOVER = ("x", "y", "z"), (0.0, 0.0, 9.81)
NOISE = {"": 5e-3, "'": 2e-2, "''": 0.3}  # of position, velocity, acceleration, SI
COLUMNS = ("RHC", "RHC+FPI", "RHC+FPI, plain form", "RHC offset-free")
Figure = Callable[[fp.Problem, fp.Run], tuple[float, ...]]


def rms(problem: fp.Problem, run: fp.Run) -> tuple[float, ...]:
    """The rms error of every coordinate after the start."""
    return tuple(fp.measure(problem, run).rms_error.values())


def distance(problem: fp.Problem, run: fp.Run) -> tuple[float, ...]:
    """The mean distance from the reference after the start."""
    errors = [run[f"error.{name}"].ravel() for name in AXES]
    return (float(np.linalg.norm(errors, axis=0)[round(problem.measure_from / problem.period) :].mean()),)


@dataclass(frozen=True)
class Kind:
    """What all rows of a shipped problem share."""

    own: str  # the field's own controller
    unit: str
    scale: float = 1.0
    figure: Figure = rms
    seeds: int = 1


KINDS = {
    "car": Kind("PD", "mm", 1e3),
    "lab": Kind("PI of the course", "K", seeds=3),
    "mujoco_arm": Kind("CTC", "mrad", 1e3),
    "quadrotor": Kind("SE3 of RotorPy", "m", figure=distance),
}


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    title: str
    file: str  # of the shipped problem
    change: Callable[[Task], Task] = lambda task: task
    gain: float | None = None  # of FPI; None: the shipped one


def of_problem(task: Task, **changes: Any) -> Task:
    """The task with another problem."""
    return replace(task, problem=replace(task.problem, **changes))


def single_track(task: Task, **changes: Any) -> Task:
    """The car without the spin of its wheels."""
    from fpirhc.adapters.commonroad import commonroad_body

    body = commonroad_body("st", task.problem.plant, period=1e-2, speed=20.0, names={"side": "y"})
    return of_problem(task, reality=body, **changes)


def later_course(task: Task) -> Task:
    """The second heater follows five minutes later."""
    course = {"T1": lambda t: 29 * (1 - ca.exp(-t / 60)), "T2": lambda t: 14 / (1 + ca.exp(-(t - 300) / 30))}
    return of_problem(task, reference=fp.Trajectory(lambda t: {name: 21 + one(t) for name, one in course.items()}))


class Late:
    """A body behind a link of some cycles."""

    def __init__(self, body: Any, cycles: int) -> None:
        self.body, self.cycles = body, cycles

    def reset(self, seed: int) -> Any:
        """Begin, with the thrust that hovers on its way."""
        np.random.seed(seed)  # noqa: NPY002  # the package draws the noise of its motors there
        self.way = [np.array(HOVER)] * self.cycles
        return self.body.reset(seed)

    def step(self, time: float, command: np.ndarray) -> Any:
        """Let the command of some cycles before act."""
        self.way.append(command.copy())
        return self.body.step(time, self.way.pop(0))


def benchmark_vehicle() -> dict[str, Any]:
    """The vehicle of AdaptiveQuadBench, in RotorPy's names."""
    known = package("rotorpy.vehicles.hummingbird_params", "outside").quad_params
    places = {f"r{k + 1}": place for k, place in enumerate(rotors(BENCHMARK))}
    no_drag = dict.fromkeys(("c_Dx", "c_Dy", "c_Dz", "k_h"), 0.0)
    told = {name: value for name, value in BENCHMARK.items() if name != "arm_length"}
    ends = {"rotor_speed_min": 0.0, "rotor_speed_max": FASTEST, "motor_noise_std": MOTOR_NOISE, "rotor_pos": places}
    return {**deepcopy(known), **told, **no_drag, **ends}


def long_stages(task: Task) -> Task:
    """The arm with a plan per 10 cycles; a new estimate waits for the next one, because at once it rings."""
    rival: Any = task.controllers["RHC offset-free"]
    slower = replace(rival, at_once=False, estimator=replace(rival.estimator, drift={"shoulder": 10.0, "elbow": 10.0}))
    changed = of_problem(task, horizon=fp.Horizon(stages=20, step=2e-2))
    return replace(changed, controllers={**task.controllers, "RHC offset-free": slower})


def circle(task: Task, *, payload: float = 0.0, late: int = 0) -> Task:
    """The benchmark's vehicle with noisy sensors, which the filter is told, and SE3 with what it is told of the vehicle."""
    from fpirhc.adapters.rotorpy import rotorpy_body, se3_law

    vehicle, plant, start = benchmark_vehicle(), task.problem.plant, {"x": 2.0, "y'": 2 * 2 * np.pi * 0.2}

    def make(_told: Mapping[str, float], _seed: int) -> Late:
        flown = rotorpy_body(plant, period=1e-2, start=start, wind=(3.0, 0.0, 0.0), payload=payload, vehicle=vehicle)
        return Late(flown.body, late)

    sensors = {name + dash: fp.Sensor(noise=fp.Noise(std)) for dash, std in NOISE.items() for name in AXES}
    changed = of_problem(
        task, reality=fp.ExternalPlant(make=make, measures=[*sensors]), sensing=fp.Sensing(sensors=sensors)
    )
    quick = 0.1 if late else 0.3  # of the drifts, in m/s^2 per square root of s: the best of .1, .3 and 1
    drift = {"x": quick, "y": quick, "z": 10 * quick}
    seen = fp.DisturbanceKalman(drift=drift, measured={name: NOISE[name[1:]] for name in sensors})
    rival: Any = task.controllers["RHC offset-free"]
    told = {"RHC offset-free": replace(rival, estimator=seen), "SE3 of RotorPy": fp.ComputedTorque(se3_law(vehicle))}
    return replace(changed, controllers={**task.controllers, **told})


SHORT = fp.Horizon(stages=60, step=2e-3)
ROWS = (
    Row("single track, lane change at 20 m/s", "car", single_track),
    Row("the same, a plan in every cycle", "car", partial(single_track, horizon=fp.Horizon(stages=100, step=1e-2))),
    Row("car that drifts (shipped)", "car"),
    Row("two heaters (shipped)", "lab"),
    Row("the same, T2 follows later", "lab", later_course),
    Row("arm of MuJoCo, a plan per 10 cycles", "mujoco_arm", long_stages, -0.3),
    Row("the same, 60 stages of one cycle", "mujoco_arm", partial(of_problem, horizon=SHORT)),
    Row("the same, 12 stages that grow (shipped)", "mujoco_arm"),
    Row("benchmark's quadrotor, circle in wind", "quadrotor", circle, -0.3),
    Row("the same with .15 kg more", "quadrotor", partial(circle, payload=0.15), -0.3),
    Row("the same without it, 30 ms late", "quadrotor", partial(circle, late=3), -0.3),
    Row("the same, 30 ms late, gain -0.1", "quadrotor", partial(circle, late=3), -0.1),
    Row("RotorPy's quadrotor with .15 kg more (shipped)", "quadrotor"),
)


def with_gain(controller: Controller, gain: float | None) -> Controller:
    """The controller with another gain of its map; without one the controller itself."""
    return controller if gain is None else fp.with_settings(controller, {"deformation.map.gain": gain})


def errors(row: Row, task: Task, name: str) -> str:
    """The errors of a controller in the unit of the row."""
    kind, controller = KINDS[row.file], with_gain(task.controllers[name], row.gain if name == "RHC+FPI" else None)
    found: list[tuple[float, ...]] = []
    for seed in range(kind.seeds):
        run = fp.simulate(task.problem, controller, seed=seed, compiled=None)
        if run.stop is not None:
            return "lost"
        found.append(kind.figure(task.problem, run))
    return ", ".join(f"{kind.scale * value:.3g}" for value in np.mean(found, axis=0))


def main() -> None:
    """Print the table."""
    files = shipped_groups()["plants of other packages"]
    words = [word for word in sys.argv[1:] if not word.startswith("--")]
    lines: list[list[str]] = []
    for row in ROWS:
        if words and not any(word in row.title for word in words):
            continue
        if why := missing(files[row.file]):
            print(f"{row.title}: left out, {why}")
            continue
        begun, task = sum(os.times()[:4]), row.change(fp.load_problem(str(files[row.file])))
        kind, values = KINDS[row.file], [errors(row, task, name) for name in COLUMNS]
        own = f"{kind.own.partition(' ')[0]} {errors(row, task, kind.own)}"
        took = sum(os.times()[:4]) - begun
        lines.append([f"{row.title}, {kind.unit}", *values, own, f"{took:.0f}"])
        print("; ".join(lines[-1]), file=sys.stderr, flush=True)
    heads = ["plant", "RHC", "RHC+FPI", "the same, plain form", "RHC offset-free", "the field's own", "s"]
    write_table("plants of others", heads, lines, HERE / "docs" / "simulators.md")


if __name__ == "__main__":
    main()
