"""The smallest boards: a controller without gate and watch, libraries for the Arduino IDE, and their worst case as counted.

simavr executes the program of an ATmega328P and counts its clocks; avr-gcc, avr-libc and simavr are Linux packages.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.errors import InvalidValue, NotSupported
from fpirhc.export.device import Device, c_of
from fpirhc.export.footprint import operations, worst_case
from fpirhc.export.target import device_of, target_called, write
from fpirhc.symbolic.functions import nan_where
from fpirhc.symbolic.native import find_compiler

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
needs_avr = pytest.mark.skipif(shutil.which("avr-gcc") is None, reason="no avr-gcc (packages gcc-avr and avr-libc)")
needs_simavr = pytest.mark.skipif(shutil.which("simavr") is None, reason="no simavr (package simavr)")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-ffp-contract=off")
CYCLES, CLOCK = 60, 16e6


def device(title: str, *, bare: bool = True, cycles: int = 400, problem: str = "two_mass") -> Device:
    task = fp.load_problem(problem)
    return device_of(task.problem, task.controllers[title], title, name="arm", cycles=cycles, bare=bare)


@needs_compiler
@pytest.mark.parametrize("title", ["CTC+FPI (eq 6)", "RHC+FPI"])
def test_a_bare_step_is_the_controllers_own_bit_by_bit(title, tmp_path):
    """Without gate and watch the same commands come in a run without faults, from less memory, and nothing warns."""
    bare, gated = device(title), device(title, bare=False, cycles=1)
    write(bare, target_called("c"), tmp_path)
    sources = [str(p) for p in sorted(tmp_path.glob("*.c")) if p.name != "processor.c"]
    subprocess.run([str(find_compiler()), *STRICT, *sources, "-o", str(tmp_path / "replay"), "-lm"], check=True)
    said = subprocess.run([str(tmp_path / "replay"), str(tmp_path / "samples.bin")], capture_output=True, text=True)
    assert "differ in a bit: command 0, memory 0, trace 0" in said.stdout
    assert said.returncode == 0
    assert bare.stepper.memory.size < gated.stepper.memory.size - 30
    run = fp.simulate(bare.problem, bare.controller, seed=0)
    memory, commands = bare.stepper.start(), []
    rows = np.hstack([np.reshape(run[name], (len(run.time), -1)) for name in bare.inputs.names if name != "time"])
    for time, row in zip(run.time[:400], rows, strict=False):
        command, memory = bare.stepper.step_measured(float(time), row, memory)
        commands.append(command)
    np.testing.assert_allclose(commands, run["command"][:400], rtol=0, atol=1e-9 * np.abs(run["command"]).max())


def test_a_bare_step_has_no_live_settings():
    """Nothing would check them."""
    task = fp.load_problem("two_mass")
    title = "CTC+FPI (eq 6)"
    with pytest.raises(InvalidValue, match=r"no live settings.*leave out 'deformation.gain' or --bare"):
        device_of(task.problem, task.controllers[title], title, live=["deformation.gain"], bare=True)


def test_operations_are_those_of_the_longest_way():
    """Scalar code, a map, a switch and a product of matrices, counted by hand."""
    x = ca.SX.sym("x")
    three = ca.Function("three", [x], [ca.sin(x) * x + 1])
    one = ca.Function("one", [x], [2 * x])
    assert operations(three) == 3
    assert operations(three.map(5)) == 15
    assert operations(ca.Function.conditional("either", [one], three)) == 3
    y = ca.MX.sym("y", 4)
    both = ca.Function("both", [y], [three(y[0]) + one(y[1])])
    assert operations(both) == 5
    a = ca.MX.sym("a", 4, 4)
    assert operations(ca.Function("product", [a, y], [a @ y])) == 2 * 16


@needs_compiler
def test_a_worst_case_names_missed_cycles_and_bytes():
    """After missed cycles a step does the work of all of them; a bare one never does."""
    gated, bare = worst_case(device("CTC+FPI (eq 6)", bare=False)), worst_case(device("CTC+FPI (eq 6)"))
    assert re.match(r"\d+ operations of a step, 501 times as many after 500 missed cycles", gated)
    assert re.match(r"\d+ operations of a step(; \d+ bytes of code .*|)$", bare)
    assert int(bare.split()[0]) < 0.3 * int(gated.split()[0])


@needs_compiler
def test_an_arduino_library_computes_in_float(tmp_path):
    """Its sources build here with every warning an error, and their type is float; header and sketch have one name."""
    write(device("CTC+FPI (eq 6)"), target_called("arduino"), tmp_path)
    assert "includes=arm.h" in (tmp_path / "library.properties").read_text().splitlines()
    sketch = (tmp_path / "examples" / "arm" / "arm.ino").read_text()
    assert "#include <arm.h>" in sketch
    assert "@" not in sketch
    own = [str(path) for path in (tmp_path / "src").glob("*.c")]
    (tmp_path / "type.c").write_text('#include "arm.h"\nchar is_float[sizeof(((arm_command*)0)->Q1) == 4 ? 1 : -1];\n')
    command = [str(find_compiler()), *STRICT, f"-I{tmp_path / 'src'}", "-c", *own, str(tmp_path / "type.c")]
    subprocess.run(command, check=True, cwd=tmp_path)


def test_own_functions_in_double_are_refused():
    """They would be computed in float on a board."""
    task = fp.load_problem("two_mass")
    title = "CTC+FPI (eq 6)"
    own = device_of(task.problem, task.controllers[title], title, libm="own", bare=True, cycles=1)
    with pytest.raises(InvalidValue, match="leave --libm out"):
        target_called("arduino").files(own)


@needs_avr
def test_sizes_on_boards_and_what_fits_none(tmp_path):
    """Without gate in 8 kB of flash, with it in 21 kB; a plan of twenty stages on no board, by so many bytes."""
    for bare, flash in ((True, 8_000), (False, 21_000)):
        files = target_called("arduino").files(device("CTC+FPI (eq 6)", bare=bare))
        said = str(files["sizes.txt"]).splitlines()
        assert int(said[0].split()[1]) < flash
        assert [line.endswith(": fits") for line in said] == [True, True]
    with pytest.raises(
        NotSupported, match=r"fits no board: Uno lacks \d+ bytes of flash and \d+ bytes of RAM; Mega.*--bare, fewer"
    ):
        write(device("RHC+FPI", bare=False, cycles=1), target_called("arduino"), tmp_path / "none")
    assert not (tmp_path / "none").exists()


MAIN = """
#include <stdio.h>
#include <string.h>
#include <avr/io.h>
#include <avr/interrupt.h>
#include <avr/pgmspace.h>
#include <avr/sleep.h>
#include "arm.h"
static const float SAMPLES[][7] PROGMEM = ROWS;
static arm_controller c;
static int put(char one, FILE* to) { (void)to; while (!(UCSR0A & 1 << UDRE0)) {} UDR0 = one; return 0; }
static FILE out = FDEV_SETUP_STREAM(put, 0, _FDEV_SETUP_WRITE);
int main(void) {
  int k;
  UCSR0B = 1 << TXEN0, TCCR1B = 2; /* clocks in eights */
  stdout = &out;
  arm_init(&c);
  for (k = 0; k < COUNT; ++k) {
    arm_inputs in;
    arm_command command;
    unsigned took;
    memcpy_P(&in, SAMPLES[k], sizeof in);
    TCNT1 = 0;
    arm_step(&c, &in, &command);
    took = TCNT1;
    printf("= %08lx %08lx %u\\n", *(unsigned long*)&command.Q1, *(unsigned long*)&command.Q2, took);
  }
  cli();
  sleep_enable();
  sleep_cpu();
}
"""


def test_a_choice_of_scalar_code_is_one_expression():
    """A comparison is a byte, a choice has both its sides, and rows are read where they are needed; bits are those of test_c."""
    x, y = ca.SX.sym("x"), ca.SX.sym("y", 2)
    chosen = ca.if_else(x < y[0], y[1], 3 * x)
    (text,), sizes = c_of(ca.Function("f", [x, y], [chosen, chosen + y[0]]), "arm")
    body = text[text.index("res0 =") :]
    assert re.search(r"const signed char (v\d+) = \(arg0\[0\]<arg1\[0\]\);", body)
    assert re.search(r"= \(v\d+\?arg1\[1\]:v\d+\);", body)
    assert "? arg" not in body
    assert sizes == {"arg": 2, "res": 2, "iw": 1, "w": 1}


def test_an_elementary_function_is_computed_where_a_choice_takes_it():
    """What one choice alone takes waits for its flag, and what another result takes too does not; NaN is no arcsine."""
    x, y = ca.SX.sym("x"), ca.SX.sym("y", 2)
    flag, shared = x < y[0], ca.log(y[1])
    chosen = ca.if_else(flag, ca.exp(x) + shared, ca.if_else(x > y[1], ca.cos(x), x))
    (text,), _ = c_of(ca.Function("f", [x, y], [chosen, x + nan_where(flag), shared]), "arm")
    assert re.search(r"= \(v\d+\?exp\(arg0\[0\]\):0\);", text)
    assert re.search(r"= \(!v\d+&&v\d+\?cos\(arg0\[0\]\):0\);", text)
    assert re.search(r"= log\(arg1\[1\]\);", text)
    assert "asin" not in text
    assert "?NAN:" in text


@needs_avr
@needs_simavr
@pytest.mark.parametrize(("bare", "longest"), [(True, 2.5e-3), (False, 4.2e-3)])
def test_an_uno_keeps_pace_with_the_controller(bare, longest, tmp_path):
    """Commands of a run in float are those of double to a ten thousandth of the largest, in time on an ATmega328P."""
    one = device("CTC+FPI (eq 6)", cycles=1, bare=bare)
    write(one, target_called("arduino"), tmp_path)
    run = fp.simulate(one.problem, one.controller, seed=0)
    rows = np.hstack([np.reshape(run[n], (len(run.time), -1)) for n in one.inputs.names])[:CYCLES]
    table = ",\n".join("{" + ", ".join(repr(float(np.float32(v))) for v in row) + "}" for row in rows)
    (tmp_path / "main.c").write_text(MAIN.replace("ROWS", "{" + table + "}").replace("COUNT", str(CYCLES)))
    answers = [line.split() for line in simulated(tmp_path).splitlines() if line.startswith("=")]
    assert len(answers) == CYCLES
    words = np.array([[int(word, 16) for word in line[1:3]] for line in answers], dtype=np.uint32)
    largest = np.abs(run["command"][:CYCLES]).max()
    np.testing.assert_allclose(words.view(np.float32), run["command"][:CYCLES], rtol=0, atol=1e-4 * largest)
    assert max(int(line[3]) for line in answers) * 8 / CLOCK < longest


def simulated(folder: Path) -> str:
    """What the program of a library with a main file says on the serial port of an ATmega328P."""
    sources = [*map(str, sorted((folder / "src").glob("*.c"))), str(folder / "main.c")]
    flags = ["-mmcu=atmega328p", "-std=gnu99", "-Os", "-ffunction-sections", "-Wl,--gc-sections", f"-I{folder / 'src'}"]
    program = str(folder / "program.elf")
    subprocess.run(["avr-gcc", *flags, *sources, "-lm", "-o", program], check=True)
    command = ["simavr", "-m", "atmega328p", "-f", f"{CLOCK:.0f}", program]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    return re.sub(r"\x1b\[[0-9;]*m", "", done.stdout + done.stderr).replace(".\n", "\n")
