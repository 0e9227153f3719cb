"""A device with Modbus TCP as the reality of a problem, by pymodbus.

    body = modbus_body("10.0.0.7", model, period=0.1, measures={"T": Register(30, "INT16", 0.1)}, inputs={"Q": Register(40)})

An exception response of the device is a bad answer. Modbus has no time stamps: `alive` names a register that the device counts up;
where it stands still for longer than `oldest`, the values are old.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from fpirhc.adapters.names import adapter, require
from fpirhc.adapters.real_time import RealTime, Setup, device
from fpirhc.errors import package
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import CountOrZero, Nonzero
from fpirhc.plant.plant import Plant
from fpirhc.task.external_plant import ExternalPlant


@dataclass(frozen=True)
class Register(Checked):
    """Where a value is: its first register, its type there (INT16, UINT16, INT32, ..., FLOAT64), and value = scale x register.

    `readonly` registers are those of the table of input registers.
    """

    address: CountOrZero
    type: Literal["INT16", "UINT16", "INT32", "UINT32", "INT64", "UINT64", "FLOAT32", "FLOAT64"] = "FLOAT32"
    scale: Nonzero = 1.0
    readonly: bool = False


@adapter
def modbus_body(
    host: str,
    model: Plant,
    *,
    period: float,
    measures: Mapping[str, Register],
    inputs: Mapping[str, Register],
    port: int = 502,
    unit: int = 1,
    alive: Register | None = None,
    oldest: float | None = None,
    holds: int = 0,
    clock: RealTime | None = None,
) -> ExternalPlant:
    """Return a device with Modbus TCP as a reality; it is connected to at the start of a run.

    Args:
        host: its address.
        model: the controller's model; scaled registers have its units.
        period: of the problem, s.
        measures: quantity of the model -> register that holds it.
        inputs: input of the model -> register that takes it; all inputs.
        port: of the server.
        unit: number of the device behind the address.
        alive: register that changes whenever the device has measured.
        oldest: time for which `alive` may stand still, s; None: any. It needs `alive`.
        holds: consecutive bad answers that are bridged; see `ExternalPlant`.
        clock: of the cycles; None: the clock on the wall.

    Raises:
        NotSupported: pymodbus is not installed.
        InvalidProblem: a quantity that the model does not have, an input without register, or `oldest` without `alive`.
    """
    told = "a register that the device counts up; Modbus has no time stamps"
    require(oldest is None or alive is not None, f"modbus_body: oldest={oldest} needs alive=Register(...), {told}")
    client = package("pymodbus.client", "outside").ModbusTcpClient(host, port=port)
    setup = Setup("modbus_body", period, oldest, holds, clock, "Register(40)")
    return device(setup, model, measures, inputs, lambda sent, read: _Unit(client, unit, sent, read), alive)


class _Unit:
    def __init__(self, client: Any, unit: int, sent: list[Register], read: list[Register]) -> None:
        self._client, self._unit, self._sent, self._read = client, unit, sent, read
        weakref.finalize(self, client.close)

    def open(self) -> None:
        """Connect anew."""
        self._client.close()
        require(self._client.connect(), f"no device answers at {self._client.comm_params.host}")

    def write(self, command: Iterable[float]) -> None:
        """Write the registers of every input."""
        for at, value in zip(self._sent, command, strict=True):
            kind, number = self._client.DATATYPE[at.type], float(value) / at.scale
            words = self._client.convert_to_registers(number if "FLOAT" in at.type else round(number), kind)
            self._good(self._client.write_registers(at.address, words, device_id=self._unit), at)

    def read(self) -> Iterator[tuple[float, float]]:
        """Values; their ages are not known."""
        for at in self._read:
            kind = self._client.DATATYPE[at.type]
            ask = self._client.read_input_registers if at.readonly else self._client.read_holding_registers
            words = self._good(ask(at.address, count=kind.value[1], device_id=self._unit), at).registers
            yield at.scale * float(self._client.convert_from_registers(words, kind)), 0.0

    def _good(self, answer: Any, at: Register) -> Any:
        require(not answer.isError(), f"register {at.address} answers {answer}")
        return answer
