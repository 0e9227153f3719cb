"""Controllers that leave Python by `fpirhc export`, beside the stepper that they are to answer as."""

import json
import shutil
import subprocess
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import fpirhc as fp
from fpirhc.__main__ import main

COMPILERS = [path for path in map(shutil.which, ("gcc", "clang")) if path]
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")


@dataclass(frozen=True, eq=False)
class Exported:
    """The files of a controller, and the problem, controller and stepper that they are made of."""

    folder: Path
    problem: fp.Problem
    controller: Any
    stepper: fp.Stepper

    @property
    def layout(self) -> Any:
        """Names, units and starts of what a step is given, and bounds of its settings."""
        return json.loads((self.folder / "layout.json").read_text())

    @cached_property
    def bounds(self) -> dict[str, tuple[float, float]]:
        return dict(self.stepper.bounds())


def exported(
    folder: Path, of: str, title: str, to: str = "c", live: tuple[str, ...] = (), name: str = "arm"
) -> Exported:
    """Export a controller of a problem, shipped or a file."""
    words = ["export", of, title, "--to", to, "--out", str(folder), "--name", name]
    assert main([*words, *(("--live", *live) if live else ())]) == 0
    task = fp.load_problem(of)
    stepper = fp.Stepper(task.problem, task.controllers[title], live=live, bounded=False)
    return Exported(folder, task.problem, task.controllers[title], stepper)


def built(folder: Path, *flags: str, main: str = "main.c", compiler: str = "") -> Path:
    """The program of a folder, with one file that has a function `main`."""
    mains = {"main.c", main} - {main}
    sources = [str(path) for path in sorted(folder.glob("*.c")) if path.name not in mains]
    program = folder / "program"
    command = [compiler or COMPILERS[0], *STRICT, *(flags or ("-O0",)), *sources, "-o", str(program), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return program


def output(program: Path, *arguments: object) -> str:
    done = subprocess.run([str(program), *map(str, arguments)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
