"""A tank on a virtual CAN bus, and messages that must not reach the controller."""

from __future__ import annotations

import struct
import time
from typing import Any

import numpy as np
import pytest
from tank import PERIOD, TANK, Tank, errors

from fpirhc.adapters.can_bus import Field, can_body
from fpirhc.errors import InvalidProblem

can: Any = pytest.importorskip("can", reason="it needs the extra fpirhc[outside]")
LEVEL, INFLOW = Field(0x181, "<i", byte=2, scale=1e-6), Field(0x201, "<f", byte=1)


class Buses:
    """Both ends of the bus, and the tank at the other one."""

    def __init__(self) -> None:
        self.own, self.other = (can.Bus(interface="virtual", channel="tank") for _ in range(2))
        self.tank, self.sent = Tank(self.inflow, self.show), 0.0

    def inflow(self) -> float:
        while (message := self.other.recv(timeout=0)) is not None:
            (self.sent,) = struct.unpack_from("<f", message.data, 1)
        return self.sent

    def show(self, level: float, age: float = 0.0, **message: Any) -> None:
        data = bytes(2) + struct.pack("<i", round(1e6 * level))
        stamp = {"arbitration_id": 0x181, "data": data, "is_extended_id": False, "timestamp": time.time() - age}
        self.other.send(can.Message(**(stamp | message)))

    def body(self, **settings: Any) -> Any:
        every: dict[str, Any] = {"measures": {"h": LEVEL}, "inputs": {"q": INFLOW}, "clock": self.tank.clock} | settings
        return can_body(self.own, TANK, period=PERIOD, **every)


@pytest.fixture
def buses():
    both = Buses()
    yield both
    both.own.shutdown()
    both.other.shutdown()


def test_adaptation_pays_on_a_bus(buses):
    plain, adapted = errors(buses.tank, buses.body())
    assert adapted < 0.5 * plain


def test_fields_of_one_identifier_go_in_one_message(buses):
    body = buses.body().body
    body._link._sent = [
        Field(0x300, "<h", byte=4, scale=0.5),
        Field(0x300, "<f"),
        Field(0x1ABCDEF, "<B", extended=True),
    ]
    body._link.write(np.array([-3.0, 0.25, 7.0]))
    first, second = (buses.other.recv(timeout=1) for _ in range(2))
    assert bytes(first.data) == struct.pack("<fh", 0.25, -6)
    assert (first.arbitration_id, first.is_extended_id) == (0x300, False)
    assert (bytes(second.data), second.arbitration_id, second.is_extended_id) == (b"\x07", 0x1ABCDEF, True)


def test_bad_traffic_is_a_bad_answer(buses):
    reality = buses.body(oldest=0.5)
    with pytest.raises(InvalidProblem, match="no message 0x181 has arrived"):
        reality.first(0)
    buses.show(1.5)
    assert reality.first(0) == pytest.approx([1.5])

    def mistake() -> str:
        return str(reality._answer(reality.body._measured, "step", None).mistake)

    buses.show(1.6, data=b"\x00\x01")
    assert "message 0x181 has 2 bytes, too few for its field" in mistake()
    buses.show(1.6, is_error_frame=True)
    assert "error frame" in mistake()
    link = reality.body._link
    buses.show(1.7)
    assert mistake() == ""
    link._newest[0x181, False, False].timestamp -= 2.0
    assert "h is 2 s old, and the oldest that is used is 0.5 s" in mistake()


def test_an_extended_identifier_and_a_remote_frame_are_no_message_of_a_standard_one(buses):
    """A number is two identifiers, one of each kind, and a remote frame asks for the value that it replaced."""
    wide = Field(0x181, "<i", byte=2, scale=1e-6, extended=True)
    reality, other = buses.body(), can_body(buses.own, TANK, period=PERIOD, measures={"h": wide}, inputs={"q": INFLOW})
    buses.show(1.5)
    buses.show(-99.0, is_extended_id=True)
    buses.show(0.0, is_remote_frame=True, data=None, dlc=6)
    assert reality.first(0) == pytest.approx([1.5])
    buses.show(-99.0, is_extended_id=True)
    assert other.first(0) == pytest.approx([-99.0])


def test_mistakes_are_named(buses):
    with pytest.raises(InvalidProblem) as caught:
        buses.body(measures={"hh": LEVEL}, inputs={})
    assert "measures: quantity 'hh' is unknown. Did you mean 'h'?" in str(caught.value)
    assert "inputs: q has no address; add inputs={'q': Field(0x201)}" in str(caught.value)
