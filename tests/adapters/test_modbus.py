"""A tank behind a Modbus server of the test's own, and answers that must not reach the controller."""

from __future__ import annotations

import socket
import threading
from typing import Any

import pytest
from tank import PERIOD, TANK, Tank, errors

from fpirhc.adapters.modbus import Register, modbus_body
from fpirhc.errors import InvalidProblem

pytest.importorskip("pymodbus", reason="it needs the extra fpirhc[outside]")
pytestmark = pytest.mark.filterwarnings("ignore")  # of the package itself
LEVEL, INFLOW, ALIVE = Register(2, "INT32", scale=1e-6), Register(6), Register(9, "UINT16")


class Served:
    """The server in a thread, and the tank with a client of its own."""

    def __init__(self) -> None:
        from pymodbus.client import ModbusTcpClient
        from pymodbus.datastore import ModbusDeviceContext, ModbusSequentialDataBlock, ModbusServerContext
        from pymodbus.server import StartTcpServer

        with socket.socket() as one:
            one.bind(("127.0.0.1", 0))
            self.port = one.getsockname()[1]
        registers = ModbusDeviceContext(hr=ModbusSequentialDataBlock(1, [0] * 20))
        context, where = ModbusServerContext(registers), ("127.0.0.1", self.port)
        threading.Thread(target=lambda: StartTcpServer(context, address=where), daemon=True).start()
        self.client = ModbusTcpClient("127.0.0.1", port=self.port, retries=20, timeout=1)
        while not self.client.connect():
            pass
        self.tank, self.count = Tank(self.inflow, self.show), 0

    def inflow(self) -> float:
        words = self.client.read_holding_registers(6, count=2).registers
        value: Any = self.client.convert_from_registers(words, self.client.DATATYPE.FLOAT32)
        return float(value)

    def show(self, level: float) -> None:
        self.count += 1
        words = self.client.convert_to_registers(round(1e6 * level), self.client.DATATYPE.INT32)
        self.client.write_registers(2, words)
        self.client.write_registers(9, [self.count])

    def body(self, **settings: Any) -> Any:
        every: dict[str, Any] = {"measures": {"h": LEVEL}, "inputs": {"q": INFLOW}, "clock": self.tank.clock} | settings
        return modbus_body("127.0.0.1", TANK, period=PERIOD, port=self.port, **every)


@pytest.fixture(scope="module")
def served():
    from pymodbus.server import ServerStop

    one = Served()
    yield one
    one.client.close()
    ServerStop()


def test_adaptation_pays_on_a_device(served):
    plain, adapted = errors(served.tank, served.body(alive=ALIVE, oldest=0.5))
    assert adapted < 0.5 * plain


def test_an_exception_response_and_a_counter_that_stands_still_are_bad_answers(served):
    with pytest.raises(InvalidProblem, match="register 300 answers ExceptionResponse"):
        served.body(measures={"h": Register(300)}).first(0)
    reality = served.body(alive=ALIVE, oldest=0.5)
    served.tank.begin()
    assert reality.first(0) == pytest.approx([1.0])
    served.tank.now += 0.7  # nothing is measured meanwhile
    assert "h is 0.7 s old, and the oldest" in reality._answer(reality.body._measured, "step", None).mistake
    served.show(1.2)
    assert reality._answer(reality.body._measured, "step", None).values == pytest.approx([1.2])


def test_an_oldest_age_needs_a_counter(served):
    """Without one every value counted as new, and the statement as kept."""
    with pytest.raises(InvalidProblem, match=r"^modbus_body: oldest=0.5 needs alive=Register\(...\), a register that"):
        served.body(oldest=0.5)


def test_mistakes_are_named(served):
    with pytest.raises(InvalidProblem) as caught:
        served.body(measures={"hh": LEVEL}, inputs={})
    assert "measures: quantity 'hh' is unknown. Did you mean 'h'?" in str(caught.value)
    assert "inputs: q has no address; add inputs={'q': Register(40)}" in str(caught.value)
