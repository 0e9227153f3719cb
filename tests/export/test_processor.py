"""Controllers in another program: on this machine, and in an emulated Cortex-M with the bits of this machine's C."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

import fpirhc as fp
from fpirhc.export.device import Device
from fpirhc.export.target import device_of, target_called, write
from fpirhc.export.targets.c import template
from fpirhc.symbolic.native import find_compiler

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
CASES = {
    "torque": ("two_mass", "CTC+FPI (eq 6)"),
    "plan": ("two_mass", "RHC+FPI"),
    "tanks": ("leaking_tanks", "RHC+FPI"),
    "map": ("fishery", "RHC+FPI"),
    "motor": ("noisy_motor", "RHC+FPI"),
    "slots": ("crane_slots", "slots+FPI"),
}


def exported(name: str, folder: Path, target: str, cycles: int = 1) -> Device:
    of, title = CASES[name]
    task = fp.load_problem(of)
    problem = replace(task.problem, duration=0.4, measure_from=0.0) if of == "two_mass" else task.problem
    device = device_of(problem, task.controllers[title], title, name="arm", cycles=cycles, libm="own")
    write(device, target_called(target), folder)
    return device


def program(folder: Path) -> str:
    """The processor of a folder of C."""
    sources = [str(path) for path in sorted(folder.glob("*.c")) if path.name != "main.c"]
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-ffp-contract=off", "-DPROCESSOR"]
    made = str(folder / "processor")
    done = subprocess.run(
        [str(find_compiler()), *strict, *sources, "-o", made, "-lm"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return made


def answers(command: Sequence[str], lines: str) -> list[str]:
    return subprocess.run(list(command), input=lines, capture_output=True, text=True, check=True).stdout.splitlines()


@needs_compiler
def test_the_program_says_what_it_does_not_understand(tmp_path):
    exported("torque", tmp_path, "c")
    said = answers([program(tmp_path)], "h\n\nr\ns 00\nx y\ns " + " ".join(["0" * 15 + "g"] * 7) + "\nh")
    few, unknown = "? a sample has too few numbers", "? expected h, r or s"
    assert said == ["h arm 7 2", "r", few, unknown, few, "h arm 7 2"]


WIDE = """
#define ARM_INPUTS 103
#define ARM_COMMANDS 34
typedef double casadi_real;
typedef struct { double number[ARM_INPUTS]; } arm_inputs;
typedef struct { double number[ARM_COMMANDS]; } arm_command;
typedef struct { int cycles; } arm_controller;
static void arm_init(arm_controller* c) { c->cycles = 0; }
static int arm_step(arm_controller* c, arm_inputs* in, arm_command* out) {
  return out->number[0] = in->number[0], ++c->cycles;
}
"""


@needs_compiler
def test_a_program_says_how_many_numbers_a_wide_sample_has(tmp_path):
    """A hundred and three: more than two digits."""
    (tmp_path / "processor.c").write_text(template("processor.c", {"name": "arm", "NAME": "ARM", "title": "wide"}))
    (tmp_path / "arm.h").write_text(WIDE)
    assert answers([program(tmp_path)], "h\n") == ["h arm 103 34"]


# A Cortex-M without a board


@needs_compiler
def test_a_float_export_computes_nothing_in_double(tmp_path):
    """A constant without a type makes a processor without doubles call a library for every product."""
    exported("plan", tmp_path, "c")
    for source in sorted(tmp_path.glob("arm_step*.c")):
        done = subprocess.run(
            [str(find_compiler()), "-std=c99", "-O2", "-ffp-contract=off", "-Dcasadi_real=float", "-S", str(source), "-o", "-"],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert not re.search(r"\b(cvtss2sd|mulsd|addsd)\b|\bfcvt\s+d", done.stdout), source.name
