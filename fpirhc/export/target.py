"""The contract of a target, how targets are found, and how the files of one are written and tried in the loop.

A target is a module of `fpirhc.export.targets` with a value `TARGET`. It turns a `Device` into files; an addition is one file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from fpirhc.controllers.contract import Controller
from fpirhc.errors import InvalidName, InvalidValue, NotSupported, OutputError, nearest, not_writable
from fpirhc.export.device import BareStep, Device, check_name, default_name
from fpirhc.export.processor import Processor
from fpirhc.members import within
from fpirhc.simulation.simulate import simulate
from fpirhc.simulation.stepper import Stepper
from fpirhc.task.problem import Problem


@dataclass(frozen=True)
class Target:
    """A kind of place where a controller runs.

    Args:
        name: word after --to.
        summary: what comes out, in one line.
        files: function of a device that returns the contents of all files by name.
        libm: whose exp, sin and the like it takes, unless told otherwise: "system" or "own".
        processor: function (folder of the files, prefix) -> program with its arguments that answers samples, see `Processor`; None:
            the target has none.
        builder: function that raises where this program cannot be built here.
        told: name of a text among the files that says how large all is on the target; empty where there is none.
    """

    name: str
    summary: str
    files: Callable[[Device], Mapping[str, str | bytes]]
    libm: str = "system"
    processor: Callable[[Path, str], Sequence[str]] | None = None
    builder: Callable[[], object] | None = None
    told: str = ""


@cache
def targets() -> dict[str, Target]:
    """Return all targets by name."""
    members = [module.TARGET for module in within("fpirhc.export.targets")]
    return {target.name: target for target in sorted(members, key=lambda one: one.name)}


def target_called(name: str) -> Target:
    """Return a target."""
    if name not in targets():
        raise InvalidName(f"the target '{name}' is unknown.{nearest(name, list(targets()))}")
    return targets()[name]


def device_of(
    problem: Problem,
    controller: Controller,
    title: str,
    *,
    name: str | None = None,
    live: Sequence[str] = (),
    cycles: int = 2000,
    libm: str = "system",
    bare: bool = False,
) -> Device:
    """Return a controller for a device.

    Args:
        name: prefix of everything in C; None: made of the title.
        libm: "system", or "own" for the same bits on every machine.
        bare: whether the step is to be the controller's alone, without gate, watch and missed cycles.
    """
    whole = f"{problem.name} {title}"
    chosen = default_name(whole) if name is None else name
    check_name(chosen)
    if bare and live:
        raise InvalidValue(f"--bare has no live settings, since nothing checks them: leave out '{live[0]}' or --bare")
    try:
        # A solver without a bound of its time is refused below, for what it is.
        stepper = Stepper(problem, controller, live=live, bounded=False)
        step = BareStep(problem, controller, stepper) if bare else stepper
        device = Device(chosen, whole, problem, controller, step, cycles, libm, bare)
        _ = device.sources, device.bounds
    except NotSupported as error:
        raise NotSupported(f"'{title}' cannot be exported: {error}{_instead(controller)}") from None
    return device


def write(device: Device, target: Target, folder: Path) -> list[Path]:
    """Write the files of a target into a new or empty folder, and return their paths."""
    _check_empty(folder)
    contents = target.files(device)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in contents.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    except OSError as error:
        raise not_writable(folder, error, "--out") from None
    return [folder / name for name in contents]


def _check_empty(folder: Path) -> None:
    try:
        taken = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
    except OSError as error:
        raise not_writable(folder, error, "--out") from None
    if taken:
        raise OutputError(
            f"'{folder}' is not an empty folder, and nothing in it is replaced; choose another one with --out"
        )


def processor_of(target: Target) -> Callable[[Path, str], Sequence[str]]:
    """Return the function that gives a target's program."""
    if target.processor is None:
        there = ", ".join(one.name for one in targets().values() if one.processor is not None)
        raise InvalidValue(f"--check is there for {there}, not for {target.name}")
    if target.builder is not None:
        target.builder()
    return target.processor


def in_the_loop(device: Device, target: Target, folder: Path) -> tuple[int, float]:
    """Return the cycles of a run with the exported program, and how far its commands are from those of this process.

    The difference is the largest one, relative to the largest command.
    """
    outside = Processor(processor_of(target)(folder, device.name), responses=device.controller.response)
    run, other = (simulate(device.problem, one, seed=0) for one in (device.controller, outside))
    if other.stop:
        raise OutputError(f"the run with the exported program ended early: {other.stop}")
    largest = float(np.abs(run["command"]).max())
    return len(run.time), float(np.abs(other["command"] - run["command"]).max()) / (largest or 1.0)


def _instead(controller: Controller) -> str:
    """What to use in place of an optimiser that needs a library; empty for a controller without one."""
    optimiser = None if controller.planner is None else type(controller.planner.optimiser).__name__
    if optimiser in (None, "FixedPoint"):
        return ""
    return f". In place of {optimiser} use FixedPoint(iterations=1, tolerance=...), which is C of its own"
