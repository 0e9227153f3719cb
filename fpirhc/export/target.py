"""The contract of a target, how targets are found, and how one is written.

A target is a module of `fpirhc.export.targets` with a value `TARGET`. It turns a `Device` into files; an addition is one file.
"""

from __future__ import annotations

import queue
import struct
import subprocess
import threading
import warnings
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Protocol, cast

import casadi as ca
import numpy as np

from fpirhc.controllers.base import commanding_blocks, like, reference_block
from fpirhc.controllers.contract import Controller, Undeformed
from fpirhc.controllers.sensing_chain import given_states, raw_signal
from fpirhc.errors import InvalidName, InvalidValue, NotSupported, OutputError, nearest, not_writable
from fpirhc.export.device import BareStep, Device, check_name, default_name
from fpirhc.fields.kinds import Positive
from fpirhc.members import within
from fpirhc.plant.chain import measured_signals
from fpirhc.plant.motion import time_signal
from fpirhc.simulation.simulate import simulate
from fpirhc.simulation.stepper import Stepper
from fpirhc.status import Status
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, scalar
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
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise OutputError(
                f"'{folder}' is not an empty folder, and nothing in it is replaced; choose another one with --out"
            )
        contents = target.files(device)
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in contents.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    except OSError as error:
        if isinstance(error, OutputError):
            raise
        raise not_writable(folder, error, "--out") from None
    return [folder / name for name in contents]


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
    outside = Processor(processor_of(target)(folder, device.name))
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


_ANSWER = "_answer_status"


class Port(Protocol):
    """A line of bytes in both directions, such as `serial.Serial("/dev/ttyACM0", 115200)`."""

    def readline(self) -> bytes:
        """Return the next line with its end; nothing where there is no more."""

    def write(self, data: bytes, /) -> Any:
        """Send bytes."""

    def flush(self) -> None:
        """Send what waits."""


@dataclass(frozen=True)
class Processor(Undeformed):
    """A controller that runs in another program: u^N and the status of the cycle are its answers to the samples.

    Compare it with the controller that it was exported from: commands have the same bits where the functions of libm have. Lines
    are those of `processor.c` of an export, with numbers as the 16 hexadecimal digits of a double. A run ends early where the
    program ends, answers late or answers something else, and a warning says why.

    Args:
        program: the program with its arguments, or a function that opens a port.
        deadline: longest wall time of an answer, s.

    Raises:
        InvalidValue: no program. In `blocks`, OutputError: it cannot be started, or has another controller.
    """

    program: Sequence[str] | Callable[[], Port] = field(metadata={"setting": False})
    deadline: Positive = 10.0

    def __post_init__(self) -> None:
        if callable(self.program):
            return
        if isinstance(self.program, str) or not self.program or not all(isinstance(one, str) for one in self.program):
            raise InvalidValue(
                "Processor: expected a program with its arguments, such as ['build/processor'], or a function that opens a port, "
                f"got {self.program!r}"
            )
        object.__setattr__(self, "program", tuple(self.program))

    def blocks(self, problem: Problem) -> tuple[list[Block], list[Delay]]:
        closing, delays = commanding_blocks(problem, [scalar(_ANSWER)])
        return [reference_block(problem), self._block(problem), *closing], delays

    def _block(self, problem: Problem) -> Block:
        """Block (time, sample) -> command and status; the model's response to it stands beside, for readers of a log.

        Where something is estimated the sample is what the sensors show: the program has the estimators of its own.
        """
        plant, raw = problem.plant, raw_signal(problem)
        seen = (*measured_signals(plant), plant.response_signal("realised"))
        sample = Layout((time_signal(plant), *(seen if raw is None else (*given_states(problem), raw))))
        answers = _answers(self, sample.size, len(plant.inputs))
        response = plant.equations.controlled_response

        def step(s: Signals) -> dict[str, Expression]:
            answer = answers(ca.vertcat(*(getattr(s, name) for name in sample.names)))
            command = answer[1:]
            return {
                "nominal": s._reference_response,
                "desired": s._reference_response,
                "command_unclipped": command,
                "_deformed_unclipped": response(s.state, command, s.parameters),
                _ANSWER: answer[0],
            }

        responses = [plant.response_signal(name) for name in ("nominal", "desired", "_deformed_unclipped")]
        reads = {s.name: s for s in (*sample.signals, plant.state, plant.parameter)}
        writes = Layout((*responses, like(plant.input, "command_unclipped"), scalar(_ANSWER)))
        wanted = plant.response_signal("_reference_response")
        return Block("processor", Layout((*reads.values(), wanted)), writes, step, opaque=True)


@cache  # CasADi does not keep what it calls
def _answers(processor: Processor, given: int, commands: int) -> _Answers:
    return _Answers(processor, given, commands)


class _Answers(ca.Callback):
    """Function (time, sample) -> (status, command). The program begins anew where time does not go on."""

    def __init__(self, processor: Processor, given: int, commands: int) -> None:
        super().__init__()
        self._processor, self._given, self._commands = processor, given, commands
        self._console: _Console | None = _Console(processor, given, commands)
        self._time = np.inf
        self.construct("fpirhc_processor", {})

    def get_sparsity_in(self, _: int) -> ca.Sparsity:
        """Return the shape of a sample."""
        return ca.Sparsity.dense(self._given, 1)

    def get_sparsity_out(self, _: int) -> ca.Sparsity:
        """Return the shape of an answer."""
        return ca.Sparsity.dense(1 + self._commands, 1)

    def eval(self, arg: Sequence[ca.DM]) -> list[ca.DM]:
        """Ask the program; after a failure there is no command, which ends the run, and the next one starts the program again."""
        sample = arg[0].full().ravel()
        begins, self._time = not sample[0] > self._time, sample[0]
        try:
            if begins:
                self._console = self._console or _Console(self._processor, self._given, self._commands)
                self._console.ask("r")
            if self._console is not None:
                return [ca.DM(self._answer(self._console, sample))]
        except OutputError as error:
            warnings.warn(f"at t = {sample[0]:g}: {error}", RuntimeWarning, stacklevel=2)
            self._console = None
        return [ca.DM(np.array([int(Status.SOLVER_FAILED), *[np.nan] * self._commands]))]

    def _answer(self, console: _Console, sample: np.ndarray) -> np.ndarray:
        words = console.ask("s " + " ".join(f"{w:016x}" for w in sample.view(np.uint64).tolist()))
        try:
            status, bits = int(words[1]), [int(one, 16) for one in words[2:]]
            command = np.array(bits, dtype=np.uint64).view(float)
        except (ValueError, IndexError, OverflowError):
            command = np.empty(0)
        if words[0] != "s" or len(command) != self._commands:
            raise OutputError(
                f"the processor answered '{' '.join(words)}'; expected s, a status and {self._commands} numbers"
            )
        return np.array([status, *command])


class _Console:
    """The program's lines, read by a thread of their own so that a program that hangs does not hang the loop."""

    def __init__(self, processor: Processor, given: int, commands: int) -> None:
        self._deadline = float(processor.deadline)
        self._to, lines, stop = _opened(processor.program)
        weakref.finalize(self, stop)
        self._lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        threading.Thread(target=_listen, args=(lines, self._lines.put), daemon=True).start()
        words = self.ask("h")
        if words[0] != "h" or words[2:] != [str(given), str(commands)]:
            sizes = (
                f"{words[2]} numbers a sample and {words[3]} a command" if len(words) == 4 else repr(" ".join(words))
            )
            raise OutputError(
                f"the processor has another controller: expected {given} numbers a sample and {commands} a command, got {sizes}; "
                "export the controller of this problem again"
            )

    def ask(self, line: str) -> list[str]:
        """Return the words of the answer to a line."""
        try:
            self._to.write(line.encode() + b"\n")
            self._to.flush()
            answer = self._lines.get(timeout=self._deadline).decode("ascii", "replace").split()
        except queue.Empty:
            raise OutputError(
                f"the processor gave no answer in {self._deadline:g} s; Processor(deadline=...) waits longer"
            ) from None
        except (OSError, ValueError):
            answer = []
        if not answer:
            raise OutputError("the processor has ended; run its program alone to see why")
        return answer


def _listen(lines: Iterator[bytes], put: Callable[[bytes], None]) -> None:
    for line in lines:
        put(line)
    put(b"")


def _opened(program: Sequence[str] | Callable[[], Port]) -> tuple[Port, Iterator[bytes], Callable[[], None]]:
    """Where lines go, where answers come from, and what ends both."""
    if callable(program):
        port = program()
        return port, iter(port.readline, b""), lambda: None
    try:
        started = subprocess.Popen(list(program), stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    except OSError as error:
        raise OutputError(f"the processor's program '{program[0]}' cannot be started: {error.strerror}") from None
    to, answers = cast(Port, started.stdin), cast(Any, started.stdout)
    return to, iter(answers.readline, b""), lambda: _stop(started)


def _stop(started: subprocess.Popen[bytes]) -> None:
    started.kill()
    started.wait()
    for stream in (started.stdin, started.stdout):
        with suppress(OSError):  # a line that nobody reads any more
            cast(Any, stream).close()


_OFFSET, _PRIME, _MASK = 0xCBF29CE484222325, 0x100000001B3, (1 << 64) - 1
_NAN = 0x7FF8000000000000


def recorded(device: Device) -> bytes:
    """Return the file: a head of four 32-bit numbers (cycles, numbers given, commands, whether bits count), and the cycles.

    Bits do not count where exp, sin and the like are the target's own, and where there is no compiler and a plan was solved by the
    virtual machine, which rounds in another order.

    Samples are those of a run, again from its beginning where it is too short; a plant outside is not run, but its model is.
    """
    stepper, rows = device.stepper, _samples(device)
    if not device.bare:  # there nothing catches them
        rows = with_faults(rows, device.problem)
    exact = device.libm == "system" and (stepper.compiled or stepper.function.is_a("SXFunction"))
    head = struct.pack("<4i", len(rows), rows.shape[1], device.problem.plant.input.size, exact)
    memory, parts = stepper.start(), [head]
    for k, row in enumerate(rows):
        damaged = memory.size - 3 if k == _DAMAGED and not device.bare else -1
        if damaged >= 0:
            memory = memory.copy()
            memory[damaged] = np.nan
        command, memory = stepper.step_measured(row[0], row[1:], memory)
        trace = np.concatenate([value.ravel() for value in stepper.trace().values()])
        parts += [
            row.tobytes(),
            struct.pack("<d", damaged),
            command.tobytes(),
            struct.pack("<2Q", digest(memory), digest(trace)),
        ]
    return b"".join(parts)


_DAMAGED = 95  # cycle before which an entry of the memory becomes NaN


def with_faults(rows: np.ndarray, problem: Problem) -> np.ndarray:
    """Return samples with what a device meets: no numbers, outliers, a plant that jumped, and cycles that are missing."""
    rows = rows.copy()
    faults: dict[int, tuple[int, float]] = {
        20: (1, np.nan), 25: (-1, np.inf), 30: (-1, -np.inf), 35: (0, np.nan), 40: (1, 1e9), 41: (1, 1e9), 42: (1, 1e9),
        50: (-1, 1e200), 52: (0, 1e18), 53: (1, -np.inf),
    }  # fmt: skip
    for k, (entry, value) in faults.items():
        rows[k : k + 1, entry] = value
    rows[60:85, 1] += 1e4
    for first, missing in ((150, 3), (220, 30), (300, 700)):
        rows[first:, 0] += missing * problem.period
    rows[350:351, 0] = rows[349:350, 0]  # a cycle twice
    return rows


def digest(values: np.ndarray) -> int:
    """Return FNV-1a of the bits of the numbers, eight bytes at a time."""
    bits = np.where(np.isnan(values), np.uint64(_NAN), values.view(np.uint64))
    total = _OFFSET
    for one in bits.tolist():
        total = ((total ^ one) * _PRIME) & _MASK
    return total


def _samples(device: Device) -> np.ndarray:
    """What the step is given in a run, with times that go on where it is repeated."""
    problem = device.problem
    run = simulate(problem.of_equations, device.controller, seed=0)
    parts = (run.time if name == "time" else run[name] for name in device.inputs.names)
    rows = np.hstack([np.asarray(part, dtype=float).reshape(len(run.time), -1) for part in parts])
    rows = np.vstack([rows] * -(-device.cycles // len(rows)))[: device.cycles]
    rows[:, 0] = device.problem.period * np.arange(len(rows))
    return rows
