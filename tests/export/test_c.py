"""Controllers as C99: the replay of recorded cycles with faults is the stepper bit by bit, and a device checks what it is told."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from helpers.exports import COMPILERS, STRICT, Exported, built, exported, output
from helpers.kinds import slow_but

from fpirhc import Status

pytestmark = pytest.mark.skipif(not COMPILERS, reason="no C compiler")
SANITIZED = ("-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
CHANGED = """from dataclasses import replace
import fpirhc as fp
task = fp.load_problem("two_mass")
problem, controllers = task.problem, dict(task.controllers)
"""
LIMITED = CHANGED + 'problem = replace(problem, limits=replace(problem.limits, states={"q1": (1.85, 2.35)}))\n'
THREE_STAGES = CHANGED + "problem = replace(problem, horizon=replace(problem.horizon, stages=3))\n"
HOSTILE = CHANGED + (
    'names = {**problem.plant.coordinates, "q1": "m*/int bad;/*"}\n'
    "problem = replace(problem, plant=replace(problem.plant, coordinates=names))\n"
    'controllers["law */ #error\\nexit(1); /* "] = controllers["CTC"]\n'
)
CASES = {
    "torque": ("two_mass", "CTC+FPI (eq 6)"),
    "plan": ("two_mass", "RHC+FPI"),
    "state limits": (LIMITED, "RHC+FPI"),
    "outputs": ("anaesthesia", "RHC+FPI"),
    "map": ("fishery", "RHC+FPI"),
    "sensors": ("noisy_motor", "RHC+FPI"),
}
LIVE = ("deformation.gain", "limits.inputs.Q1.0", "limits.inputs.Q1.1")


def of_case(name: str, folder: Path, live: tuple[str, ...] = ()) -> Exported:
    """The files of a case in a new folder."""
    problem, title = CASES[name]
    return exported(folder / "device", of_text(problem, folder), title, live=live)


def of_text(problem: str, folder: Path) -> str:
    """The name of a problem; a text becomes a file."""
    if "\n" not in problem:
        return problem
    (folder / "own.py").write_text(problem, encoding="utf-8")
    return str(folder / "own.py")


@pytest.mark.parametrize("name", slow_but(CASES, "torque", "state limits", "map"))
def test_a_replay_with_faults_is_the_stepper_bit_by_bit(name, tmp_path):
    """Commands, memory and trace of 2000 cycles, by every compiler here, and with sanitizers; no warning of the strict ones."""
    of_case(name, tmp_path)
    for compiler in COMPILERS:
        # Loops in C with sanitizers, by one compiler: they find the same with every one.
        flagged = {"plan": [("-O2",), SANITIZED], "state limits": [SANITIZED] * (compiler == COMPILERS[0])}
        for flags in flagged.get(name, [("-O2",)]):
            said = output(built(tmp_path / "device", *flags, compiler=compiler), tmp_path / "device" / "samples.bin")
            assert "2000 cycles: command off by at most 0 " in said
            assert "differ in a bit: command 0, memory 0, trace 0" in said
            for status in (Status.BAD_SAMPLE, Status.BAD_TIME, Status.BRIDGED):
                assert f" {int(status)} (" in said, said


def test_a_replay_tells_what_differs(tmp_path):
    """The comparison can fail: one bit of a recorded command is turned."""
    of_case("torque", tmp_path)
    file = tmp_path / "device" / "samples.bin"
    data = bytearray(file.read_bytes())
    data[16 + 8 * 8] ^= 1  # the head, then the first cycle's sample of 7 numbers and its damage
    file.write_bytes(data)
    done = subprocess.run([str(built(file.parent)), str(file)], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "command 1, memory 0, trace 0" in done.stdout


@pytest.mark.skipif(shutil.which("nm") is None, reason="no nm")
@pytest.mark.parametrize("name", ["torque", "state limits"])
def test_a_controller_has_no_heap_no_files_and_no_globals(name, tmp_path):
    """Of other files it calls functions of numbers and of memory alone, and it writes into nothing but its struct."""
    folder = of_case(name, tmp_path, live=("deformation.gain",)).folder
    own = [str(path) for path in sorted(folder.glob("arm*.c"))]
    subprocess.run([COMPILERS[0], *STRICT, "-O0", "-c", *own], cwd=folder, check=True)
    objects = [f"{Path(one).stem}.o" for one in own]
    said = subprocess.run(["nm", *objects], cwd=folder, capture_output=True, text=True, check=True)
    symbols = [line.split()[-2:] for line in said.stdout.splitlines() if line and not line.endswith(":")]
    outside = {symbol for kind, symbol in symbols if kind == "U" and not symbol.startswith("arm_")}
    numbers = "exp log pow sin cos sincos tan asin acos atan tanh atanh sqrt fmin fmax floor ceil fmod lrint"
    assert outside <= {*numbers.split(), "memcpy", "memset", "memmove"}
    assert not [symbol for kind, symbol in symbols if kind in "DdBbC"]
    named = re.findall(r"\S+\.c\b", (folder / "CMakeLists.txt").read_text())
    assert {*named} == {path.name for path in folder.glob("*.c")}


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


def test_a_device_refuses_wrong_settings_and_never_leaves_the_limits_of_the_build(tmp_path):
    """Not finite, outside the bounds, beyond the other end of the interval, no setting: refused, and the old number stays."""
    device = of_case("torque", tmp_path, live=LIVE)
    (device.folder / "set.c").write_text(SET)
    first, second, third, fourth = output(built(device.folder, main="set.c")).splitlines()
    assert first == "0000 0001 01 -0.75 40"
    _, command, traced = second.split()
    assert float(command) == float(traced) == device.problem.limits.inputs["Q1"][1]
    assert third == "1 -0.75"
    assert fourth == "0"
    header, layout = (device.folder / "arm.h").read_text(), device.layout
    assert "    casadi_real q1_d; /* m/s */" in header
    assert f"#define ARM_MEMORY {device.stepper.memory.size} " in header
    assert [row["unit"] for row in layout["trace"]] == list(device.stepper.signals.units)
    assert {*layout["bounds"]} == {"deformation.gain", "limits.inputs.Q1.0", "limits.inputs.Q1.1"}


SINGLE = r"""
#include "arm.h"
#include <math.h>
#include <stdio.h>
#include <string.h>
ROWS
int main(void) {
  static arm_controller good, bad;
  static arm_command out;
  int k, j, b, wrong = 0;
  const casadi_real worse[3] = {(casadi_real)NAN, (casadi_real)INFINITY, (casadi_real)-INFINITY};
  arm_init(&good);
  for (k = 0; k < 6; ++k) {
    arm_inputs in;
    arm_command held;
    memcpy(&in, rows[k], sizeof in);
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


@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("name", slow_but(["torque", "outputs"], "outputs"))
def test_what_is_no_number_passes_no_gate_in_either_type(name, real, tmp_path):
    """Every input, NaN and both infinities: a skipped cycle with the last command and a memory of numbers."""
    device = of_case(name, tmp_path)
    rows = np.tile([row["start"] for row in device.layout["inputs"]], (6, 1)).astype(float)
    start = device.problem.start_state
    rows[:, 0] = device.problem.period * np.arange(6)
    rows[:, 1 : 1 + start.size] = start
    text = ", ".join("{" + ", ".join(f"(casadi_real){v!r}" for v in row.tolist()) + "}" for row in rows)
    place = f"enum {{ STATUS = {device.stepper.signals.slice('status').start} }};"
    table = f"static const casadi_real rows[6][ARM_INPUTS] = {{{text}}};\n{place}"
    (device.folder / "single.c").write_text(SINGLE.replace("ROWS", table))
    assert output(built(device.folder, f"-Dcasadi_real={real}", main="single.c")) == "0\n"


FAILING = r"""
#include "arm.h"
#include <stdio.h>
#include <string.h>
int arm_raw(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem);
int arm_real(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem);
static int fails;
int arm_raw(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem) {
  return fails ? 1 : arm_real(arg, res, iw, w, mem);
}
int main(void) {
  static arm_controller c;
  static arm_inputs in;
  arm_command out, held = {0};
  int k;
  arm_init(&c);
  in.state.q1 = 2.2, in.state.q2 = 5.4;
  for (k = 0; k < 12; ++k) {
    in.time = k * ARM_PERIOD;
    fails = k >= 4 && k < 8;
    printf("%d%d ", arm_step(&c, &in, &out) == ARM_SOLVER_FAILED, memcmp(&held, &out, sizeof out) == 0);
    held = out;
  }
  return 0;
}
"""


def test_a_solver_that_fails_holds_the_last_command(tmp_path):
    """And says so; the next cycle goes on."""
    folder = of_case("plan", tmp_path).folder
    raw = folder / "arm_step.c"
    raw.write_text(raw.read_text().replace("arm_raw", "arm_real"))
    (folder / "failing.c").write_text(FAILING)
    said = output(built(folder, main="failing.c")).split()
    assert [told[0] for told in said] == list("000011110000")
    assert [held for _, held in said[4:8]] == ["1"] * 4


def test_a_plan_in_float_is_the_plan(tmp_path):
    """Three stages: the line search's rounding is that of the type, so it does not stop at once (8 N off with that of double)."""
    device = exported(tmp_path / "device", of_text(THREE_STAGES, tmp_path), "RHC+FPI")
    program = built(device.folder, "-Dcasadi_real=float")
    said = subprocess.run([program, device.folder / "samples.bin"], capture_output=True, text=True, check=False)
    assert float(said.stdout.split("at most ")[1].split(" ")[0]) < 0.01, said.stdout


def test_a_text_of_a_problem_file_stays_in_its_comment(tmp_path):
    """Names and units may hold the end of a comment, the beginning of another, and more than one line."""
    device = exported(tmp_path / "device", of_text(HOSTILE, tmp_path), "law */ #error\nexit(1); /* ")
    assert "2000 cycles: command off by at most 0 " in output(built(device.folder), device.folder / "samples.bin")


CASE = ("two_mass", "CTC+FPI (eq 6)")


def test_an_arduino_library_replays_in_float(tmp_path):
    """No warning, commands to a thousandth of those in double with faults among the samples; header and sketch have one name."""
    exported(tmp_path / "board", *CASE, "arduino"), exported(tmp_path / "c", *CASE)
    assert "includes=arm.h" in (tmp_path / "board" / "library.properties").read_text().splitlines()
    sketch = (tmp_path / "board" / "examples" / "arm" / "arm.ino").read_text()
    assert "#include <arm.h>" in sketch
    assert "@" not in sketch
    assert "TOO LONG for a period of" in sketch
    src = tmp_path / "board" / "src"
    (tmp_path / "type.c").write_text(
        '#define Q1 17\n#include "arm.h"\nextern char is_float[sizeof(((arm_command*)0)->Q1) == 4 ? 1 : -1];\n'
    )
    (tmp_path / "main.c").write_text((tmp_path / "c" / "main.c").read_text())  # apart from the header in double
    files = [*src.glob("*.c"), tmp_path / "type.c", tmp_path / "main.c"]
    program = tmp_path / "replay"
    command = [COMPILERS[0], *STRICT, "-O2", "-ffp-contract=off", f"-I{src}", *map(str, files), "-lm"]
    subprocess.run([*command, "-o", str(program)], check=True, cwd=tmp_path)
    done = subprocess.run([program, tmp_path / "c" / "samples.bin"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert "2000 cycles" in done.stdout
