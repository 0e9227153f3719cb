"""The smallest boards: a controller without gate and watch, libraries for the Arduino IDE, and their worst case as counted.

simavr executes the program of an ATmega328P and counts its clocks; avr-gcc, avr-libc and simavr are Linux packages.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.errors import InvalidValue
from fpirhc.export.device import Device
from fpirhc.export.target import device_of, target_called, write
from fpirhc.symbolic.native import find_compiler

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
needs_avr = pytest.mark.skipif(shutil.which("avr-gcc") is None, reason="no avr-gcc (packages gcc-avr and avr-libc)")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-ffp-contract=off")


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


@needs_compiler
def test_an_arduino_library_computes_in_float(tmp_path):
    """Its sources build here with every warning an error, and their type is float; header and sketch have one name.

    A number may be called as a macro of Arduino's headers.
    """
    write(device("CTC+FPI (eq 6)"), target_called("arduino"), tmp_path)
    assert "includes=arm.h" in (tmp_path / "library.properties").read_text().splitlines()
    sketch = (tmp_path / "examples" / "arm" / "arm.ino").read_text()
    assert "#include <arm.h>" in sketch
    assert "@" not in sketch
    own = [str(path) for path in (tmp_path / "src").glob("*.c")]
    (tmp_path / "type.c").write_text(
        '#define Q1 17\n#include "arm.h"\nchar is_float[sizeof(((arm_command*)0)->Q1) == 4 ? 1 : -1];\n'
    )
    command = [str(find_compiler()), *STRICT, f"-I{tmp_path / 'src'}", "-c", *own, str(tmp_path / "type.c")]
    subprocess.run(command, check=True, cwd=tmp_path)


def test_own_functions_in_double_are_refused():
    """They would be computed in float on a board."""
    task = fp.load_problem("two_mass")
    title = "CTC+FPI (eq 6)"
    own = device_of(task.problem, task.controllers[title], title, libm="own", bare=True, cycles=1)
    with pytest.raises(InvalidValue, match="leave --libm out"):
        target_called("arduino").files(own)


# A motor with a finger on it, held by a library on a simulated board

SERVED = """
#include <avr/io.h>
#include "arm.h"
static arm_controller c;
static unsigned char get(void) { while (!(UCSR0A & 1 << RXC0)) {} return UDR0; }
static void put(unsigned char one) { while (!(UCSR0A & 1 << UDRE0)) {} UDR0 = one; }
int main(void) {
  UCSR0A = 1 << U2X0, UCSR0B = 1 << TXEN0 | 1 << RXEN0;
  arm_init(&c);
  for (;;) {
    arm_inputs in;
    arm_command command;
    unsigned k;
    for (k = 0; k < sizeof in; ++k) ((unsigned char*)&in)[k] = get();
    arm_step(&c, &in, &command);
    for (k = 0; k < sizeof command; ++k) put(((unsigned char*)&command)[k]);
  }
}
"""
BOARD = """
#include <stdarg.h>
#include <stdio.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/avr_uart.h>
static int said;
static void heard(struct avr_irq_t* irq, uint32_t byte, void* none) { (void)irq; (void)none; putchar((int)byte); ++said; }
static void quiet(avr_t* avr, const int level, const char* format, va_list all) { (void)avr; (void)level; (void)format; (void)all; }
int main(int count, char** words) {
  elf_firmware_t firmware = {{0}};
  uint32_t flags = 0;
  int k;
  avr_t* avr = avr_make_mcu_by_name("atmega328p");
  avr_global_logger_set(quiet);
  if (count < 2 || elf_read_firmware(words[1], &firmware)) return 1;
  firmware.frequency = 16000000;
  avr_init(avr);
  avr_load_firmware(avr, &firmware);
  avr_ioctl(avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
  flags &= ~(uint32_t)(AVR_UART_FLAG_STDIO | AVR_UART_FLAG_POOL_SLEEP);
  avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), heard, 0);
  for (k = 0; k < 100000; ++k) avr_run(avr); /* until it listens */
  for (;;) {
    int byte;
    for (k = 0; k < 8; ++k) {
      if ((byte = getchar()) == EOF) return 0;
      avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT), (uint32_t)byte);
    }
    for (said = 0; said < 4;) avr_run(avr);
    fflush(stdout);
  }
}
"""
HARNESS = (Path("/usr/include/simavr/sim_avr.h"), Path("/usr/include/libelf.h"))


def motor(command: Callable[[float, float], float], seed: int) -> np.ndarray:
    """Errors of a speed of 60 rpm in rad/s, 900 cycles: motor, finger and encoder, with nothing of the package.

    The encoder has the mean speed of the last cycle with a jitter of .74 %, in steps of 4 us. The finger brakes with .08 N m for
    1.5 s of every four, with ramps of .15 s.
    """
    drag, wanted, random = 0.2354 / (159 * np.pi / 30), 2 * np.pi, np.random.default_rng(seed)
    inertia, quantum, errors = drag * 0.12, 4e-6 / 1e-2 * 2 * np.pi, []
    state, seen = np.array([wanted, drag * wanted + 0.004]), wanted

    def rate(t: float, state: np.ndarray, u: float) -> np.ndarray:
        speed, torque = state
        since = (t % 4.0) - 1.0
        finger = 0.08 * min(1.0, max(0.0, min(since, 1.5 - since) / 0.15))
        return np.array(
            [(torque - drag * speed - 0.004 * np.tanh(speed / 0.5) - finger) / inertia, (0.2354 * u - torque) / 0.02]
        )

    for k in range(900):
        u = command(k * 1e-2, quantum * np.round((seen + 0.0074 * 2 * np.pi * random.standard_normal()) / quantum))
        total = 0.0
        for j in range(10):
            t, h = k * 1e-2 + j * 1e-3, 1e-3
            a = rate(t, state, u)
            b = rate(t + h / 2, state + h / 2 * a, u)
            c = rate(t + h / 2, state + h / 2 * b, u)
            state = state + h / 6 * (a + 2 * b + 2 * c + rate(t + h, state + h * c, u))
            total += state[0] / 10
        seen = total
        errors.append(state[0] - wanted)
    return np.array(errors)


@needs_avr
@pytest.mark.skipif(
    not all(map(Path.exists, HARNESS)), reason="no simavr library (packages libsimavr-dev and libelf-dev)"
)
def test_an_uno_holds_a_motor_against_a_finger(tmp_path):
    """In the loop, commands are those of Python for the same samples; the iteration takes the error to a quarter."""
    task = fp.load_problem("noisy_motor")
    law, map_ = fp.Exponential(rate=8), fp.Sigmoid(gain=-1.0, shift=0.3, scale=5e3)
    adaptive = fp.Increment(map_, cycles=task.problem.response_delay, uncertainty=0)
    (tmp_path / "board.c").write_text(BOARD)
    board = ["gcc", "-O2", str(tmp_path / "board.c"), "-o", str(tmp_path / "board"), "-lsimavr", "-lelf"]
    subprocess.run(board, check=True)
    plain, other = (
        held(device_of(task.problem, one, "motor", name="arm", cycles=1), tmp_path / "board", tmp_path / str(k))
        for k, one in enumerate((fp.ComputedTorque(law), fp.ComputedTorque(law, adaptive)))
    )
    assert [plain, other] == pytest.approx([1.18, 0.273], rel=0.02)


def held(device: Device, board: Path, folder: Path) -> float:
    """The rms error of the motor, in rad/s, with a library on the board; every command is compared with that of Python."""
    write(device, target_called("arduino"), folder)
    (folder / "main.c").write_text(SERVED)
    flags = ["-mmcu=atmega328p", "-std=gnu99", "-Os", "-ffunction-sections", "-Wl,--gc-sections", f"-I{folder / 'src'}"]
    sources = [*map(str, sorted((folder / "src").glob("*.c"))), str(folder / "main.c")]
    subprocess.run(["avr-gcc", *flags, *sources, "-lm", "-o", str(folder / "program.elf")], check=True)
    stepper, apart = fp.Stepper(device.problem, device.controller), [0.0]
    memory = stepper.start()
    with subprocess.Popen([str(board), str(folder / "program.elf")], stdin=-1, stdout=-1) as running:
        to, back = running.stdin, running.stdout
        assert to
        assert back

        def command(t: float, speed: float) -> float:
            nonlocal memory
            to.write(np.array([t, speed], dtype="<f4").tobytes())
            to.flush()
            answer = float(np.frombuffer(back.read(4), dtype="<f4")[0])
            wanted, memory = stepper.step_measured(t, np.array([speed]), memory)
            apart.append(abs(answer - wanted[0]))
            return answer

        error = float(np.sqrt(np.mean(motor(command, seed=1)[100:] ** 2)))
        to.close()
    assert max(apart) < 1e-4
    return error
