"""Devices on a CAN bus as the reality of a problem, by python-can.

A value is that of the newest message of its identifier, standard or extended, and its age that of the message's time stamp. Error
frames are bad answers; remote frames, which ask for a value, are none.
"""

from __future__ import annotations

import struct
import time as wall
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from fpirhc.adapters.names import InMessage, adapter, in_format, require, require_methods
from fpirhc.adapters.real_time import RealTime, Setup, device
from fpirhc.errors import InvalidProblem, package
from fpirhc.fields.kinds import CountOrZero, Nonzero
from fpirhc.plant.plant import Plant
from fpirhc.task.external_plant import ExternalPlant


@dataclass(frozen=True)
class Field(InMessage):
    """Where a value is: the identifier of its message, its format (see `struct`) at a byte, and value = scale x number.

    Raises:
        InvalidValue: a format of no number, or of several; an identifier of too many bits.
    """

    identifier: CountOrZero
    format: str = "<f"
    byte: CountOrZero = 0
    scale: Nonzero = 1.0
    extended: bool = False


@adapter
def can_body(
    bus: Any,
    model: Plant,
    *,
    period: float,
    measures: Mapping[str, Field],
    inputs: Mapping[str, Field],
    oldest: float | None = None,
    holds: int = 0,
    clock: RealTime | None = None,
) -> ExternalPlant:
    """Return what hangs on a CAN bus as a reality.

        bus = can.Bus(interface="socketcan", channel="can0")
        speed, torque = Field(0x181, "<h", scale=0.1), Field(0x201, "<f")
        body = can_body(bus, model, period=2e-3, measures={"w": speed}, inputs={"M": torque}, oldest=5e-3)

    Args:
        bus: `can.Bus(...)`.
        model: the controller's model; scaled numbers have its units.
        period: of the problem, s.
        measures: quantity of the model -> field of the message that holds it.
        inputs: input of the model -> field of the message that takes it; fields of one identifier go in one message.
        oldest: age of a message beyond which its values are bad, s; None: any age.
        holds: consecutive bad answers that are bridged; see `ExternalPlant`.
        clock: of the cycles; None: the clock on the wall.

    Raises:
        NotSupported: python-can is not installed.
        InvalidProblem: a quantity that the model does not have, or an input without field.
    """
    require_methods("can_body(bus=...)", bus, ("send", "recv"), 'can.Bus(interface="socketcan", channel="can0")')
    can, setup = package("can", "outside"), Setup("can_body", period, oldest, holds, clock, "Field(0x201)")
    return device(setup, model, measures, inputs, lambda sent, read: _Traffic(can, bus, sent, read))


class _Traffic:
    """The newest messages of a bus."""

    def __init__(self, can: Any, bus: Any, sent: list[Field], read: list[Field]) -> None:
        self._can, self._bus, self._sent, self._read = can, bus, sent, read

    def open(self) -> None:
        """Forget what came before the last message of every identifier that waits."""
        self._newest: dict[tuple[int, bool, bool], Any] = {}  # identifier, extended, remote

    def write(self, command: Iterable[float]) -> None:
        """Send one message per identifier."""
        data: dict[tuple[int, bool], bytearray] = {}
        for at, value in zip(self._sent, command, strict=True):
            content = data.setdefault((at.identifier, at.extended), bytearray())
            content.extend(bytes(max(at.byte + struct.calcsize(at.format) - len(content), 0)))
            struct.pack_into(at.format, content, at.byte, in_format(at.format, float(value) / at.scale))
        for (identifier, wide), content in data.items():
            self._bus.send(self._can.Message(arbitration_id=identifier, data=content, is_extended_id=wide))

    def read(self) -> Iterator[tuple[float, float]]:
        """Values of the newest messages, and their ages."""
        while (message := self._bus.recv(timeout=0)) is not None:
            require(not message.is_error_frame, "the bus has an error frame")
            self._newest[message.arbitration_id, message.is_extended_id, message.is_remote_frame] = message
        for at in self._read:
            if (newest := self._newest.get((at.identifier, at.extended, False))) is None:
                raise InvalidProblem(f"no message 0x{at.identifier:X} has arrived")
            enough = len(newest.data) >= at.byte + struct.calcsize(at.format)
            require(enough, f"message 0x{at.identifier:X} has {len(newest.data)} bytes, too few for its field")
            yield at.scale * struct.unpack_from(at.format, newest.data, at.byte)[0], wall.time() - newest.timestamp
