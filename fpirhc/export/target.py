"""The contract of a target, how targets are found, and how the files of one are written.

A target is a module of `fpirhc.export.targets` with a value `TARGET`. It turns a `Device` into files; an addition is one file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from fpirhc.controllers.contract import Controller
from fpirhc.errors import NotSupported, OutputError, not_writable
from fpirhc.export.device import Device, check_name, default_name, in_comment
from fpirhc.members import within
from fpirhc.simulation.stepper import Stepper
from fpirhc.task.problem import Problem


@dataclass(frozen=True)
class Target:
    """A kind of place where a controller runs."""

    name: str  # word after --to
    files: Callable[[Device], Mapping[str, str | bytes]]  # contents of all files by name


@cache
def targets() -> dict[str, Target]:
    """Return all targets by name."""
    members = [module.TARGET for module in within("fpirhc.export.targets")]
    return {target.name: target for target in sorted(members, key=lambda one: one.name)}


def device_of(
    problem: Problem, controller: Controller, title: str, *, name: str | None = None, live: Sequence[str] = ()
) -> Device:
    """Return a controller for a device; `name` is the prefix of everything in C, None: made of the title."""
    whole = f"{problem.name} {title}"
    chosen = default_name(whole) if name is None else name
    check_name(chosen)
    try:
        # A solver without a bound of its time is refused below, for what it is.
        stepper = Stepper(problem, controller, live=live, bounded=False)
        device = Device(chosen, in_comment(whole), problem, controller, stepper)
        _ = device.sources, device.bounds
    except NotSupported as error:
        raise NotSupported(f"'{title}' cannot be exported: {error}{_instead(controller)}") from None
    return device


def write(device: Device, target: Target, folder: Path) -> list[Path]:
    """Write the files of a target into a new or empty folder, and return their paths."""
    try:
        taken = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
        contents = {} if taken else target.files(device)
        for name, content in contents.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    except OSError as error:
        raise not_writable(folder, error, "--out") from None
    if taken:
        raise OutputError(
            f"'{folder}' is not an empty folder, and nothing in it is replaced; choose another one with --out"
        )
    return [folder / name for name in contents]


def _instead(controller: Controller) -> str:
    """What to use in place of an optimiser that needs a library; empty for a controller without one."""
    optimiser = None if controller.planner is None else type(controller.planner.optimiser).__name__
    if optimiser in (None, "FixedPoint"):
        return ""
    return f". In place of {optimiser} use FixedPoint(iterations=1, tolerance=...), which is C of its own"
