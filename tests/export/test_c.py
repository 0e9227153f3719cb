"""Controllers as C99: the replay of recorded cycles with faults is the stepper bit by bit, and a device checks what it is told."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.kinds import slow_but

import fpirhc as fp
from fpirhc import Status
from fpirhc.errors import InvalidName, NotSupported, OutputError
from fpirhc.export.device import Device, default_name, identifiers
from fpirhc.export.samples import with_faults
from fpirhc.export.target import device_of, target_called, targets, write
from fpirhc.symbolic.native import find_compiler

COMPILERS = [path for path in (shutil.which("gcc"), shutil.which("clang")) if path]
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
SANITIZED = ("-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
CASES = {
    "torque": ("two_mass", "CTC+FPI (eq 6)"),
    "plan": ("two_mass", "RHC+FPI"),
    "state limits": ("two_mass", "RHC+FPI"),
    "outputs": ("anaesthesia", "RHC+FPI"),
    "map": ("fishery", "RHC+FPI"),
    "sensors": ("noisy_motor", "RHC+FPI"),
}
LIVE = ["deformation.gain", "limits.inputs.Q1"]


def exported(name: str, folder: Path, *, live: tuple[str, ...] = (), cycles: int = 400, **changes: Any) -> Device:
    """The files of a case in a folder, with the prefix 'arm'."""
    of, title = CASES[name]
    task = fp.load_problem(of)
    problem = replace(task.problem, **changes)
    if name == "state limits":
        problem = replace(problem, limits=replace(problem.limits, states={"q1": (1.85, 2.35)}))
    device = device_of(problem, task.controllers[title], title, name="arm", live=live, cycles=cycles)
    write(device, target_called("c"), folder)
    return device


def built(folder: Path, *flags: str, main: str = "main.c", compiler: str = "", without: str = "") -> Path:
    """The program of a folder, with one file that has a function `main`."""
    mains = {"main.c", main} - {main}
    sources = [str(path) for path in sorted(folder.glob("*.c")) if path.name not in mains and path.name != without]
    program = folder / "program"
    command = [compiler or str(find_compiler()), *STRICT, *(flags or ("-O2",)), *sources, "-o", str(program), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return program


def output(program: Path, *arguments: object) -> str:
    done = subprocess.run([str(program), *map(str, arguments)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@needs_compiler
@pytest.mark.parametrize("name", slow_but(CASES, "torque", "state limits", "map"))
def test_a_replay_with_faults_is_the_stepper_bit_by_bit(name, tmp_path):
    """Commands, memory and trace of 2000 cycles, by every compiler here, and with sanitizers; no warning of the strict ones."""
    exported(name, tmp_path, cycles=2000)
    for compiler in COMPILERS or [str(find_compiler())]:
        # Both loops in C with sanitizers, which find the same with every compiler; the rest of their code is that of the others.
        sanitized = name in ("plan", "state limits") and compiler == (*COMPILERS, compiler)[0]
        for flags in (("-O2",), SANITIZED) if sanitized else (("-O2",),):
            said = output(built(tmp_path, *flags, compiler=compiler), tmp_path / "samples.bin")
            assert "2000 cycles: command off by at most 0 " in said
            assert "differ in a bit: command 0, memory 0, trace 0" in said
            for status in (Status.BAD_SAMPLE, Status.BAD_TIME, Status.BRIDGED):
                assert f" {int(status)} (" in said, said


@needs_compiler
@pytest.mark.skipif(shutil.which("nm") is None, reason="no nm")
@pytest.mark.parametrize("name", ["torque", "state limits"])
def test_a_controller_has_no_heap_no_files_and_no_globals(name, tmp_path):
    """Of other files it calls functions of numbers and of memory alone, and it writes into nothing but its struct."""
    exported(name, tmp_path, live=("deformation.gain",), cycles=1)
    own = [str(path) for path in sorted(tmp_path.glob("arm*.c"))]
    subprocess.run([str(find_compiler()), *STRICT, "-O1", "-c", *own], cwd=tmp_path, check=True)
    said = subprocess.run(
        ["nm", *(f"{Path(one).stem}.o" for one in own)], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    symbols = [line.split()[-2:] for line in said.stdout.splitlines() if line and not line.endswith(":")]
    outside = {symbol for kind, symbol in symbols if kind == "U" and not symbol.startswith("arm_")}
    numbers = "exp log pow sin cos sincos tan asin acos atan tanh atanh sqrt fmin fmax floor ceil fmod lrint"
    assert outside <= {*numbers.split(), "memcpy", "memset", "memmove"}
    assert not [symbol for kind, symbol in symbols if kind in "DdBbC"]


@needs_compiler
def test_a_replay_tells_what_differs(tmp_path):
    """The comparison can fail: one bit of a recorded command is turned."""
    exported("torque", tmp_path)
    file = tmp_path / "samples.bin"
    data = bytearray(file.read_bytes())
    data[16 + 8 * 8] ^= 1  # the head, then the first cycle's sample of 7 numbers and its damage
    file.write_bytes(data)
    done = subprocess.run([str(built(tmp_path)), str(file)], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "command 1, memory 0, trace 0" in done.stdout


def test_faults_are_in_the_samples():
    """No numbers, outliers, a jump and missing cycles, as often as they are said to be there."""
    problem = fp.load_problem("two_mass").problem
    rows = with_faults(np.tile(problem.period * np.arange(400.0)[:, None], (1, 7)), problem)
    assert np.isnan(rows).sum() == 2
    assert np.isinf(rows).sum() == 3
    assert (rows[:, 1] > 1e8).sum() == 3
    assert (np.diff(rows[np.isfinite(rows[:, 0]), 0]) > 2.5 * problem.period).sum() >= 3


# Settings, limits, instances

SET = r"""
#include "arm.h"
#include <math.h>
#include <stdio.h>
#include <string.h>
int main(void) {
  static arm_controller c, other;
  arm_inputs in = {0};
  arm_command out, same;
  int k, status = 0;
  arm_init(&c), arm_init(&other);
  printf("%d%d%d%d ", arm_set(&c, ARM_SET_DEFORMATION_GAIN, NAN), arm_set(&c, ARM_SET_DEFORMATION_GAIN, INFINITY),
         arm_set(&c, ARM_SET_DEFORMATION_GAIN, 3), arm_set(&c, (arm_setting)99, -1));
  printf("%d%d%d%d ", arm_set(&c, ARM_SET_LIMITS_INPUTS_Q1_1, -1e9), arm_set(&c, ARM_SET_LIMITS_INPUTS_Q1_1, 1e4),
         arm_set(&c, ARM_SET_LIMITS_INPUTS_Q1_0, -301), arm_set(&c, ARM_SET_LIMITS_INPUTS_Q1_1, 40));
  printf("%d%d ", arm_set(&c, ARM_SET_LIMITS_INPUTS_Q1_0, 40), arm_set(&c, ARM_SET_DEFORMATION_GAIN, -0.75));
  printf("%.17g %.17g\n", (double)c.settings.deformation_gain, (double)c.settings.limits_inputs_Q1_1);
  memcpy(&in.state, &(arm_inputs){0}.state, sizeof in.state);
  in.state.q1 = 1.9, in.state.q2 = 5.4;
  c.settings.limits_inputs_Q1_0 = 1e8, c.settings.limits_inputs_Q1_1 = 1e9; /* past the check */
  for (k = 0; k < 5; ++k) {
    in.time = k * ARM_PERIOD;
    status = arm_step(&c, &in, &out);
    arm_step(&other, &in, &same);
  }
  printf("%d %.17g %.17g\n", status, (double)out.Q1, (double)c.trace.command.Q1);
  arm_reset(&c);
  printf("%d %.17g\n", memcmp(&c.memory, &other.memory, sizeof c.memory) != 0, (double)c.settings.deformation_gain);
  arm_init(&c), arm_reset(&other);
  printf("%d\n", memcmp(&c.memory, &other.memory, sizeof c.memory));
  return 0;
}
"""


@needs_compiler
def test_a_device_refuses_wrong_settings_and_never_leaves_the_limits_of_the_build(tmp_path):
    """Not finite, outside the bounds, beyond the other end of the interval, no setting: refused, and the old number stays."""
    device = exported("torque", tmp_path, live=tuple(LIVE))
    (tmp_path / "set.c").write_text(SET)
    first, second, third, fourth = output(built(tmp_path, main="set.c")).splitlines()
    assert first == "0000 0001 01 -0.75 40"
    _, command, traced = second.split()
    assert float(command) == float(traced) == device.problem.limits.inputs["Q1"][1]
    assert third == "1 -0.75"
    assert fourth == "0"


PAIR = r"""
#include "arm.h"
#include <stdio.h>
int main(void) {
  static arm_controller c;
  arm_init(&c);
  printf("%d%d", arm_set(&c, ARM_SET_DEFORMATION_WEIGHTS_0, 0.8), arm_set(&c, ARM_SET_DEFORMATION_WEIGHTS_1, 0.6));
  return 0;
}
"""


@needs_compiler
def test_two_weights_of_a_list_are_no_interval(tmp_path):
    """The first may be above the second, as Python takes them."""
    problem, _ = two_mass()
    controller = fp.ComputedTorque(fp.Exponential(6.0), fp.Affine(gain=-0.2, weights=(0.9, 0.5)))
    live = ("deformation.weights.0", "deformation.weights.1")
    write(device_of(problem, controller, "CTC", name="arm", live=live, cycles=1), target_called("c"), tmp_path)
    (tmp_path / "set.c").write_text(PAIR)
    assert output(built(tmp_path, main="set.c")) == "11"


def test_a_number_that_must_follow_from_a_setting_is_not_left_behind():
    """The law's exact step for another rate is computed in Python, so its rate cannot be live on a device."""
    task = fp.load_problem("two_mass")
    law = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Sigmoid(gain=-0.5, scale=50.0))
    assert device_of(task.problem, law, "law", live=["tracking.rate"], cycles=1).bounds["tracking.rate"][0] >= 0
    fractional = replace(law, tracking=fp.Fractional(rate=6.0, order=0.9, memory=0.2))
    with pytest.raises(NotSupported, match="must not stay as it was"):
        device_of(task.problem, fractional, "fractional", live=["tracking.rate"], cycles=1)


# A solver that fails

FAILING = r"""
#include "arm.h"
int arm_raw(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem);
int arm_real(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem);
static int called;
int arm_raw(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem) {
  ++called;
  if ((called >= 40 && called < 44) || called == 60) return 1;
  return arm_real(arg, res, iw, w, mem);
}
"""


@needs_compiler
def test_a_solver_that_fails_holds_as_the_stepper_does(tmp_path, monkeypatch):
    """The last command, the memory as it was, and the cycles made up for later: in C as where a solver raises in Python.

    Scalar code has no loop that can fail.
    """
    calls, real = [0], fp.Stepper._run

    def failing(self):
        evaluate = self._evaluate

        def counted():
            calls[0] += 1
            if 40 <= calls[0] < 44 or calls[0] == 60:
                raise RuntimeError("a solver raised")
            return evaluate()

        self._evaluate = counted
        try:
            return real(self)
        finally:
            self._evaluate = evaluate

    monkeypatch.setattr(fp.Stepper, "_run", failing)
    exported("plan", tmp_path, cycles=90)
    raw = tmp_path / "arm_step.c"
    raw.write_text(raw.read_text().replace("arm_raw", "arm_real"))
    (tmp_path / "failing.c").write_text(FAILING)
    said = output(built(tmp_path), tmp_path / "samples.bin")
    assert f" {int(Status.SOLVER_FAILED)} (" in said
    assert "command 0, memory 0" in said  # the trace of a dropped step is not defined


# Float

SINGLE = r"""
#include "arm.h"
#include <math.h>
#include <stdio.h>
#include <string.h>
int main(void) {
  static arm_controller good, bad;
  int k, j, b, wrong = 0;
  const casadi_real worse[3] = {(casadi_real)NAN, (casadi_real)INFINITY, (casadi_real)-INFINITY};
  arm_init(&good);
  for (k = 0; k < 6; ++k) {
    arm_inputs in;
    arm_command out, held;
    memcpy(&in, ROWS[k], sizeof in);
    for (j = 0; j < ARM_INPUTS && k > 1; ++j)
      for (b = 0; b < 3; ++b) {
        arm_inputs broken = in;
        int m;
        ((casadi_real*)&broken)[j] = worse[b];
        bad = good;
        arm_step(&bad, &broken, &held);
        wrong += ((casadi_real*)&bad.trace)[STATUS] != ARM_BAD_SAMPLE;
        wrong += memcmp(&held, &out, sizeof held) != 0;
        for (m = 0; m < ARM_MEMORY; ++m) wrong += !(fabs(((casadi_real*)&bad.memory)[m]) <= HUGE_VALF);
      }
    arm_step(&good, &in, &out);
  }
  printf("%d\n", wrong);
  return 0;
}
"""


@needs_compiler
@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("name", slow_but(["torque", "outputs"], "outputs"))
def test_what_is_no_number_passes_no_gate_in_either_type(name, real, tmp_path):
    """Every input, NaN and both infinities: a skipped cycle with the last command and a memory of numbers.

    In float a limit of 1e300 would be infinite, and an infinite concentration would pass.
    """
    device = exported(name, tmp_path)
    rows = np.tile(device.inputs.start(), (6, 1))
    start = device.problem.start_state
    rows[:, 0] = device.problem.period * np.arange(6)
    rows[:, 1 : 1 + start.size] = start
    text = ", ".join("{" + ", ".join(f"(casadi_real){v!r}" for v in row.tolist()) + "}" for row in rows)
    text = f"static const casadi_real ROWS[6][ARM_INPUTS] = {{{text}}};\n"
    place = f"enum {{ STATUS = {device.stepper.signals.slice('status').start} }};\n"
    main = SINGLE.replace('#include "arm.h"\n', f'#include "arm.h"\n{text}{place}')
    main = main.replace("arm_command out, held;", "static arm_command out;\n    arm_command held;")
    (tmp_path / "single.c").write_text(main)
    assert output(built(tmp_path, "-O2", f"-Dcasadi_real={real}", main="single.c")) == "0\n"


@needs_compiler
def test_a_plan_in_float_is_the_plan(tmp_path):
    """Three stages: the line search's rounding is that of the type, so it does not stop at once (8 N off with that of double)."""
    whole = fp.load_problem("two_mass").problem.horizon
    assert whole is not None
    horizon = replace(whole, stages=3)
    exported("plan", tmp_path, cycles=60, horizon=horizon)
    program = built(tmp_path, "-O2", "-Dcasadi_real=float")
    said = subprocess.run([str(program), str(tmp_path / "samples.bin")], capture_output=True, text=True, check=False)
    worst = float(said.stdout.split("at most ")[1].split(" ")[0])
    assert worst < 0.01, said.stdout


# What is written, and what is refused


def test_header_and_layout_have_the_names_and_units(tmp_path):
    device = exported("torque", tmp_path, live=tuple(LIVE), cycles=1)
    header, layout = (tmp_path / "arm.h").read_text(), json.loads((tmp_path / "layout.json").read_text())
    assert "    casadi_real q1_d; /* m/s */" in header
    assert "  ARM_BAD_SAMPLE = 5," in header
    assert f"#define ARM_MEMORY {device.stepper.memory.size} " in header
    assert [row["name"] for row in layout["inputs"]] == list(device.inputs.columns)
    assert [row["unit"] for row in layout["trace"]] == list(device.stepper.signals.units)
    assert set(layout["bounds"]) == {"deformation.gain", "limits.inputs.Q1.0", "limits.inputs.Q1.1"}
    text = "".join(path.read_text() for path in tmp_path.glob("arm*.c"))
    for word in ("malloc", "stdio", "__builtin_cpu_supports", "CASADI_SYMBOL_EXPORT"):
        assert word not in text


def test_the_cmake_file_names_files_that_are_there():
    """A name of another file stops the very first command of the page."""
    problem, controllers = two_mass()
    files = target_called("c").files(device_of(problem, controllers["CTC"], "CTC", cycles=1))
    named = re.findall(r"\S+\.c\b", str(files["CMakeLists.txt"]))
    assert set(named) == {name for name in files if name.endswith(".c")}


def test_names_in_c():
    assert identifiers(["q1", "q1'", "q1''", "q1_d", "a b", "int", "2nd"]) == [
        "q1",
        "q1_d",
        "q1_dd",
        "q1_d_2",
        "a_b",
        "_int",
        "_2nd",
    ]
    assert default_name("two_mass CTC+FPI (eq 6)") == "two_mass_ctc_fpi_eq_6"
    assert default_name("2 tanks") == "c_2_tanks"


@cache
def two_mass() -> tuple[Any, Any]:
    task = fp.load_problem("two_mass")
    return task.problem, task.controllers


@pytest.mark.parametrize("name", ["2nd", "a b", "int", "example", "replay", "test", "math", "", "x" * 41, "ü"])
def test_a_name_that_c_does_not_take_is_refused(name):
    problem, controllers = two_mass()
    with pytest.raises(InvalidName, match=r"cannot be the name of a controller in C.*Did you mean"):
        device_of(problem, controllers["CTC"], "CTC", name=name)


@pytest.mark.parametrize("optimiser", [fp.Ipopt(1e-6), fp.Fatrop(1e-6), fp.SequentialQuadratic(1e-6)])
def test_a_solver_with_a_library_of_its_own_is_refused_by_name(optimiser):
    problem, _ = two_mass()
    controller = fp.RecedingHorizon(optimiser, fp.Sigmoid(gain=-0.5, scale=50.0))
    with pytest.raises(
        NotSupported, match=f"'rival' cannot be exported.*In place of {type(optimiser).__name__} use FixedPoint"
    ):
        device_of(problem, controller, "rival")


def test_a_folder_that_is_not_empty_and_an_unknown_target_are_refused(tmp_path):
    problem, controllers = two_mass()
    device = device_of(problem, controllers["CTC"], "CTC", cycles=1)
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match="not an empty folder"):
        write(device, target_called("c"), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
    with pytest.raises(OutputError, match="not an empty folder"):
        write(device, target_called("c"), tmp_path / "mine.txt")
    with pytest.raises(InvalidName, match=r"target 'x' is unknown.*c"):
        target_called("x")
    assert list(targets())


@needs_compiler
def test_a_text_of_a_problem_file_stays_in_its_comment(tmp_path):
    """Names and units may hold the end of a comment, the beginning of another, and more than one line."""
    problem, controllers = two_mass()
    plant = replace(problem.plant, coordinates={**problem.plant.coordinates, "q1": "m*/int bad;/*"})
    title = "law */ #error\nexit(1); /* "
    device = device_of(replace(problem, plant=plant), controllers["CTC"], title, name="arm", cycles=60)
    write(device, target_called("c"), tmp_path)
    assert "60 cycles: command off by at most 0 " in output(built(tmp_path), tmp_path / "samples.bin")
