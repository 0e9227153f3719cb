"""Controllers in another program: on this machine, and in an emulated Cortex-M with the bits of this machine's C."""

from __future__ import annotations

import io
import queue
import re
import shutil
import struct
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from kinds import slow_but

import fpirhc as fp
import fpirhc.export.processor
from fpirhc.cli.main import main
from fpirhc.errors import InvalidField, InvalidValue, OutputError
from fpirhc.export import cortex
from fpirhc.export.cortex import Image
from fpirhc.export.device import Device
from fpirhc.export.processor import Processor
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


def lines_of(folder: Path) -> str:
    """The recorded samples, faults among them, as lines."""
    data = (folder / "samples.bin").read_bytes()
    cycles, given, commands, _ = struct.unpack_from("<4i", data)
    row = 8 * (given + 1 + commands + 2)
    words = (struct.unpack_from(f"<{given}Q", data, 16 + k * row) for k in range(cycles))
    return "h\nr\n" + "".join("s " + " ".join(f"{w:016x}" for w in one) + "\n" for one in words)


@needs_compiler
@pytest.mark.parametrize(
    "name", slow_but(("torque", "plan", "tanks", "map", "motor", "slots"), "torque", "motor", "slots")
)
def test_a_loop_with_the_program_is_the_run(name, tmp_path):
    """Every state and command, twice from the start: what differs is the last digits of exp and the like.

    Where something is estimated the program is sent what the sensors show, noise with it, and has the estimators of its own.
    """
    device = exported(name, tmp_path, "c")
    run = fp.simulate(device.problem, device.controller, seed=0)
    outside = Processor([program(tmp_path)], responses=device.controller.response)
    for _ in range(2):
        other = fp.simulate(device.problem, outside, seed=0)
        np.testing.assert_allclose(other["command"], run["command"], rtol=1e-10, atol=1e-9)
        np.testing.assert_allclose(other["state"], run["state"], rtol=1e-10, atol=1e-12)
        assert (other["status"] == run["status"]).all()


@needs_compiler
def test_a_program_takes_part_in_a_comparison(tmp_path):
    device = exported("torque", tmp_path, "c")
    controllers = {"inside": device.controller, "board": Processor([program(tmp_path)])}
    task = replace(
        fp.load_problem("two_mass"), problem=device.problem, controllers=controllers, headline=("inside", "board")
    )
    inside, board = fp.compare(task, seed=0).entries
    assert board.metrics["rms_error"]["q1"] == pytest.approx(inside.metrics["rms_error"]["q1"], rel=1e-9)


@needs_compiler
def test_the_program_says_what_it_does_not_understand(tmp_path):
    exported("torque", tmp_path, "c")
    said = answers([program(tmp_path)], "h\n\nr\ns 00\nx y\ns " + " ".join(["0" * 15 + "g"] * 7) + "\nh")
    few, unknown = "? a sample has too few numbers", "? expected h, r or s"
    assert said == ["h arm 7 2", "r", few, unknown, few, "h arm 7 2"]


ECHO = """
import sys
left = {cycles}
for line in sys.stdin:
    left -= line[0] == 's'
    if left < 0: {end}
    print({{'h': 'h arm 7 2', 'r': 'r'}}.get(line[0], {answer!r}), flush=True)
"""
ZEROS = "s 0 0000000000000000 0000000000000000"


def talking(cycles: int = 9, end: str = "break", answer: str = ZEROS) -> list[str]:
    """A program that answers for some cycles."""
    return [sys.executable, "-c", ECHO.format(cycles=cycles, end=end, answer=answer)]


@pytest.mark.parametrize(
    ("command", "cycles", "message"),
    [
        (talking(), 9, "at t = 0.009: the processor has ended"),
        (talking(end="input()"), 9, "at t = 0.009: the processor gave no answer in 0.5 s"),
        (talking(answer="s 0 12"), 0, "the processor answered 's 0 12'; expected s, a status and 2 numbers"),
        (talking(answer="? no"), 0, "the processor answered '[?] no'"),
    ],
)
def test_a_program_that_fails_ends_the_run_by_name(command, cycles, message):
    problem = replace(fp.load_problem("two_mass").problem, duration=0.05, measure_from=0.0)
    with pytest.warns(RuntimeWarning, match=message):
        run = fp.simulate(problem, Processor(command, deadline=0.5), seed=0)
    assert len(run.time) == cycles
    assert "not finite" in str(run.stop)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Processor("build/processor"), InvalidField, r"Processor.program: expected .* got the text"),
        (lambda: Processor([]), InvalidValue, r"such as \['build/processor'\], or a function that opens a port"),
        (lambda: Processor(["/no/such/program"]), OutputError, "'/no/such/program' cannot be started: No such file"),
        (lambda: Processor([sys.executable, "-c", ""]), OutputError, "the processor has ended; run its program alone"),
        (
            lambda: Processor([sys.executable, "-c", "print('h other 3 1')"]),
            OutputError,
            "expected 7 numbers a sample and 2 a command, got 3 numbers a sample and 1 a command; export the controller",
        ),
    ],
)
def test_a_wrong_program_is_named_before_the_run(make, error, message):
    problem = replace(fp.load_problem("two_mass").problem, duration=0.05, measure_from=0.0)
    with pytest.raises(error, match=message):
        fp.simulate(problem, make(), seed=0)


class Board:
    """A port of a board that leaves the sixth sample without an answer until it is opened again."""

    opened: ClassVar[list[Board]] = []

    def __init__(self) -> None:
        self.lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self.samples, self.closed = 0, False
        if self.opened:
            self.lines.put(ZEROS.encode() + b"\n")
        self.opened.append(self)

    def write(self, data: bytes, /) -> None:
        self.samples += data[:1] == b"s"
        answer = {b"h": "h arm 7 2", b"r": "r"}.get(data[:1], ZEROS).encode() + b"\n"
        if len(self.opened) > 1 or self.samples < 6:
            self.lines.put(answer)

    def flush(self) -> None: ...

    def readline(self) -> bytes:
        return self.lines.get()

    def close(self) -> None:
        self.closed = True
        self.lines.put(b"")


def test_a_port_is_closed_after_a_late_answer_and_the_next_run_opens_it_again(monkeypatch):
    """The answer that comes late is no answer to the next question."""
    monkeypatch.setattr(Board, "opened", [])
    problem = replace(fp.load_problem("two_mass").problem, duration=0.02, measure_from=0.0)
    controller = Processor(Board, deadline=0.2)
    with pytest.warns(RuntimeWarning, match="gave no answer in 0.2 s"):
        assert len(fp.simulate(problem, controller, seed=0).time) == 5
    assert len(fp.simulate(problem, controller, seed=0).time) == 20
    assert [port.closed for port in Board.opened] == [True, False]


def test_a_session_with_many_programs_leaves_few_of_them_running(monkeypatch):
    started = []

    class Noted(subprocess.Popen[bytes]):
        def __init__(self, *arguments: Any, **named: Any) -> None:
            super().__init__(*arguments, **named)
            started.extend([self] * (arguments[0][0] == sys.executable))  # a compiler is asked for its version too

    monkeypatch.setattr(subprocess, "Popen", Noted)
    monkeypatch.setattr(fpirhc.export.processor, "_MOST", 2)
    problem = replace(fp.load_problem("two_mass").problem, duration=0.005, measure_from=0.0)
    first, *others = (Processor(talking(cycles=100 + k)) for k in range(4))
    for controller in (first, *others):
        assert len(fp.simulate(problem, controller, seed=0).time) == 5
    assert [one.poll() is None for one in started] == [False, False, True, True]
    assert len(fp.simulate(problem, first, seed=0).time) == 5


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


@needs_compiler
def test_a_sample_that_a_sensor_loses_is_sent_as_its_last_one(tmp_path):
    """Nothing is estimated, and the program is given what the controller in this process is given."""
    sensors = {name: fp.Sensor(dropout=0.2) for name in ("q1", "q2'")}
    two_mass = fp.load_problem("two_mass")
    problem = replace(two_mass.problem, duration=0.3, measure_from=0.0, sensing=fp.Sensing(sensors))
    device = device_of(problem, two_mass.controllers["CTC+FPI (eq 6)"], "torque", name="arm", cycles=1, libm="own")
    write(device, target_called("c"), tmp_path)
    run, other = (fp.simulate(problem, one, seed=3) for one in (device.controller, Processor([program(tmp_path)])))
    np.testing.assert_allclose(other["command"], run["command"], rtol=1e-10, atol=1e-9)


@pytest.mark.slow
@needs_compiler
def test_an_export_is_checked_in_the_loop(tmp_path, capsys):
    """`--check` builds what was written, and says how far its run is from that of Python."""
    folder = tmp_path / "device"
    arguments = ["leaking_tanks", "RHC+FPI", "--out", str(folder), "--cycles", "1", "--check"]
    assert main(["export", *arguments]) == 0
    said = capsys.readouterr().out
    assert re.search(
        r"in the loop: 300 cycles, commands within \S+ of those of this run \(relative to the largest one\)", said
    )
    assert float(said.split("commands within ")[1].split()[0]) < 1e-10
    assert main(["export", *arguments[:3], str(tmp_path / "unit"), "--to", "fmu", "--check"]) == 2
    assert "--check is there for c, cortex-m" in capsys.readouterr().err
    assert not (tmp_path / "unit").exists()


# A Cortex-M without a board


@pytest.fixture
def tools() -> None:
    pytest.importorskip("ziglang", reason="zig is not installed: pip install 'fpirhc[cortex]'")
    pytest.importorskip("unicorn", reason="Unicorn is not installed: pip install 'fpirhc[cortex]'")


def emulated(image: Path) -> list[str]:
    return [sys.executable, "-m", "fpirhc.export.cortex", str(image)]


@pytest.mark.parametrize(
    ("arguments", "message"), [([], "usage: "), (["gone.elf"], "No such file"), (["half.elf"], "or not all of one")]
)
def test_a_board_without_an_image_is_told(arguments, message, tmp_path, monkeypatch):
    (tmp_path / "half.elf").write_bytes(b"\x7fELF\x01\x01".ljust(18, b"\0") + b"\x28\x00")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=message):
        cortex.main(arguments)


@pytest.mark.slow
@pytest.mark.usefixtures("tools")
@needs_compiler
@pytest.mark.parametrize("name", ["torque", "plan", "map"])
def test_a_cortex_m7_has_the_bits_of_this_machine(name, tmp_path):
    """140 cycles with faults; in float the commands are those of double to a thousandth, and their status is the same."""
    exported(name, tmp_path / "m", "cortex-m", cycles=140)
    exported(name, tmp_path / "c", "c", cycles=140)
    lines = lines_of(tmp_path / "m")
    here = answers([program(tmp_path / "c")], lines)
    assert answers(emulated(tmp_path / "m" / "arm_m7.elf"), lines) == here
    short = answers(emulated(tmp_path / "m" / "arm_m4f.elf"), lines)
    doubles, floats = (np.array([_numbers(line) for line in one[2:42]]) for one in (here, short))
    assert (doubles[:, 0] == floats[:, 0]).all()
    np.testing.assert_allclose(floats, doubles, rtol=1e-3, atol=1e-3 * np.abs(doubles).max())
    said = (tmp_path / "m" / "sizes.txt").read_text()
    for place, told in zip(("m7", "m4f"), re.findall(r"(\d+) of RAM, at most (\d+) of stack", said), strict=True):
        image = Image(tmp_path / "m" / f"arm_{place}.elf")
        board = cortex.Board(image, io.BytesIO(lines.encode()), io.BytesIO())
        board.run()
        assert board.stack() <= int(told[1]) + 200  # of the console
        assert image.size(0x20000000) == int(told[0])


def _numbers(line: str) -> list[float]:
    _, status, *words = line.split()
    return [float(status), *(struct.unpack(">d", bytes.fromhex(word))[0] for word in words)]


@pytest.mark.slow
@pytest.mark.usefixtures("tools")
def test_a_loop_with_an_emulated_processor_is_the_run(tmp_path):
    device = exported("plan", tmp_path, "cortex-m")
    run, other = (
        fp.simulate(device.problem, one, seed=0)
        for one in (device.controller, Processor(emulated(tmp_path / "arm_m7.elf")))
    )
    np.testing.assert_allclose(other["command"], run["command"], rtol=1e-10, atol=1e-9)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("qemu-system-arm") is None, reason="no QEMU (package qemu-system-arm)")
@needs_compiler
def test_a_loop_in_qemu_has_the_bits_of_this_machine(tmp_path):
    """500 cycles of plans with the plant in Python: the commands of a Cortex-M7 and of C here are the same."""
    pytest.importorskip("ziglang", reason="zig is not installed: pip install 'fpirhc[cortex]'")
    device = exported("plan", tmp_path / "m", "cortex-m")
    exported("plan", tmp_path / "c", "c")
    problem = replace(device.problem, duration=500 * device.problem.period, measure_from=0.0)
    board = "qemu-system-arm -M mps2-an500 -display none -serial none -monitor none -semihosting-config enable=on,target=native"
    emulator = [*board.split(), "-kernel", str(tmp_path / "m" / "arm_m7.elf")]
    there, here = (fp.simulate(problem, Processor(one), seed=0) for one in (emulator, [program(tmp_path / "c")]))
    np.testing.assert_array_equal(there["command"], here["command"])
    assert len(there.time) == 500


def test_what_is_no_image_is_named(tmp_path):
    file = tmp_path / "no.elf"
    file.write_bytes(b"\x7fELF\x02\x01" + bytes(80))
    with pytest.raises(InvalidValue, match=r"is no program for a Cortex-M, or not all of one: expected the .elf"):
        Image(file)


CMSIS = """
typedef struct { volatile unsigned DEMCR; } Core; typedef struct { volatile unsigned CTRL, CYCCNT; } Watch;
extern Core* CoreDebug; extern Watch* DWT; extern unsigned SystemCoreClock;
#define CoreDebug_DEMCR_TRCENA_Msk 1u
#define DWT_CTRL_CYCCNTENA_Msk 1u
unsigned SysTick_Config(unsigned ticks); void __WFI(void); void SysTick_Handler(void);
"""


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")
def test_the_example_for_boards_compiles_against_the_names_of_cmsis(tmp_path, monkeypatch):
    """The names that CMSIS declares stand in a header of the test; libraries are not built here."""
    monkeypatch.setattr("fpirhc.export.targets.cortex_m.arm_programs", lambda *_: ({}, {}))
    exported("torque", tmp_path, "cortex-m")
    (tmp_path / "cmsis.h").write_text(CMSIS)
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", '-DBOARD_HEADER="cmsis.h"']
    done = subprocess.run(
        ["gcc", *strict, "-c", str(tmp_path / "example.c"), "-o", str(tmp_path / "example.o")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    text = (tmp_path / "example.c").read_text()
    assert re.search(r"ARM_PERIOD, which is in s, ", text)


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
