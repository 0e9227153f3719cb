"""A controller that runs in another program, over lines of text: processor in the loop.

The lines are those of `targets/processor.c`.
"""

from __future__ import annotations

import queue
import subprocess
import threading
import warnings
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Protocol, cast

import casadi as ca
import numpy as np

from fpirhc.controllers.base import commanding_blocks, like, reference_block
from fpirhc.controllers.contract import Response, Undeformed, given_response
from fpirhc.controllers.sensing_chain import given_states, raw_signal
from fpirhc.errors import InvalidValue, OutputError
from fpirhc.fields.kinds import Positive
from fpirhc.plant.chain import measured_signals
from fpirhc.plant.motion import time_signal
from fpirhc.status import Status
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, scalar
from fpirhc.task.problem import Problem

_ANSWER = "_answer_status"


class Port(Protocol):
    """A line of bytes in both directions, such as `serial.Serial("/dev/ttyACM0", 115200)`.

    One that has a method `close` is closed after an answer that is late or wrong, and opened again for the next run.
    """

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
        responses: method `response` of the controller that it has, where that is given others than the plant's controlled ones, as
            slots are; None: the plant's.

    Raises:
        InvalidValue: no program. In `blocks`, OutputError: it cannot be started, or has another controller.
    """

    program: Sequence[str] | Callable[[], Port] = field(metadata={"setting": False})
    deadline: Positive = 10.0
    responses: Callable[[Problem], Response | None] | None = field(default=None, metadata={"setting": False})

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

    def response(self, problem: Problem) -> Response | None:
        return None if self.responses is None else self.responses(problem)

    def _block(self, problem: Problem) -> Block:
        """Block (time, sample) -> command and status; the model's response to it stands beside, for readers of a log.

        Where something is estimated the sample is what the sensors show: the program has the estimators of its own.
        """
        plant, raw, own = problem.plant, raw_signal(problem), given_response(problem, self)
        seen = (*measured_signals(plant), plant.response_signal("realised") if own is None else own.signal)
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
        self._console = _Console(processor, given, commands)
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
                if self._console.closed:
                    self._console = _Console(self._processor, self._given, self._commands)
                self._console.ask("r")
            if not self._console.closed:
                return [ca.DM(self._answer(self._console, sample))]
        except OutputError as error:
            warnings.warn(f"at t = {sample[0]:g}: {error}", RuntimeWarning, stacklevel=2)
            self._console.close()
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
    """The program's lines, read by a thread of their own so that a program that hangs does not hang the loop.

    CasADi calls a controller as long as there is its loop, and nobody says when its last run has ended. So the latest few stay
    open, and a loop whose program was closed opens it again when its next run begins.
    """

    def __init__(self, processor: Processor, given: int, commands: int) -> None:
        self._deadline = float(processor.deadline)
        while len(_open) >= _MOST:
            _open[0].close()
        self._to, lines, stop = _opened(processor.program)
        self._stop = weakref.finalize(self, stop)
        self._lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        threading.Thread(target=_listen, args=(lines, self._lines.put), daemon=True).start()
        _open.append(self)
        try:
            self._greet(given, commands)
        except OutputError:
            self.close()
            raise

    @property
    def closed(self) -> bool:
        """Whether its program has ended, or its port is closed."""
        return not self._stop.alive

    def close(self) -> None:
        """End the program, or close the port."""
        self._stop()
        with suppress(ValueError):
            _open.remove(self)

    def _greet(self, given: int, commands: int) -> None:
        words = self.ask("h")
        while words[0] in ("s", "r"):  # a late answer to a sample from before the port was closed
            words = self._heard()
        if words[0] != "h" or words[2:] != [str(given), str(commands)]:
            sizes = (
                f"{words[2]} numbers a sample and {words[3]} a command" if len(words) == 4 else repr(" ".join(words))
            )
            raise OutputError(
                f"the processor has another controller: expected {given} numbers a sample and {commands} a command, got {sizes}; "
                "export the controller of this problem again, and or give that of slots as Processor(..., responses=slots.response)"
            )

    def ask(self, line: str) -> list[str]:
        """Return the words of the answer to a line."""
        with suppress(OSError, ValueError):  # it has ended, which the answer tells
            self._to.write(line.encode() + b"\n")
            self._to.flush()
        return self._heard()

    def _heard(self) -> list[str]:
        try:
            answer = self._lines.get(timeout=self._deadline).decode("ascii", "replace").split()
        except queue.Empty:
            raise OutputError(
                f"the processor gave no answer in {self._deadline:g} s; Processor(deadline=...) waits longer"
            ) from None
        if not answer:
            raise OutputError("the processor has ended; run its program alone to see why")
        return answer


_MOST = 8  # programs and ports at a time
_open: list[_Console] = []


def _listen(lines: Iterator[bytes], put: Callable[[bytes], None]) -> None:
    with suppress(Exception):  # of any class, by a port that is closed meanwhile
        for line in lines:
            put(line)
    put(b"")


def _opened(program: Sequence[str] | Callable[[], Port]) -> tuple[Port, Iterator[bytes], Callable[[], None]]:
    """Where lines go, where answers come from, and what ends both."""
    if callable(program):
        port = program()
        return port, iter(port.readline, b""), getattr(port, "close", lambda: None)
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
