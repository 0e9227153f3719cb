"""An OPC UA server, such as that of a programmable logic controller, as the reality of a problem, by asyncua.

    body = opcua_body("opc.tcp://10.0.0.5:4840", model, period=1.0, measures={"T": "ns=2;s=TT101"}, inputs={"Q": "ns=2;s=HV7"})
    problem = fp.Problem(plant=model, reality=body, ...)

A value with a bad status, and one that is too old, are bad answers: they are held or end the run, and never reach the controller.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from math import inf
from typing import Any

from fpirhc.adapters.names import adapter, require
from fpirhc.adapters.real_time import RealTime, Setup, device
from fpirhc.errors import InvalidValue, package
from fpirhc.plant.plant import Plant
from fpirhc.task.external_plant import ExternalPlant

_FLOATS = ("Float", "Double")
_WHOLE = ("SByte", "Byte", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64")


@adapter
def opcua_body(
    address: str,
    model: Plant,
    *,
    period: float,
    measures: Mapping[str, str],
    inputs: Mapping[str, str],
    oldest: float | None = None,
    holds: int = 0,
    clock: RealTime | None = None,
) -> ExternalPlant:
    """Return an OPC UA server as a reality; it is connected to at the start of a run.

    Args:
        address: of the server.
        model: the controller's model; the nodes have its units.
        period: of the problem, s.
        measures: quantity of the model -> node that holds it.
        inputs: input of the model -> node that takes it, a float or a whole number, to which values are rounded; all inputs.
        oldest: age beyond which a value is bad, s, by its source's time stamp, or by the server's where the source gives none;
            a value without both is bad. None: any age.
        holds: consecutive bad answers that are bridged; see `ExternalPlant`.
        clock: of the cycles; None: the clock on the wall.

    Raises:
        NotSupported: asyncua is not installed.
        InvalidValue: another kind of address.
        InvalidProblem: a quantity that the model does not have, or an input without node.
    """
    if not address.startswith("opc.tcp://"):
        raise InvalidValue(f"opcua_body: expected an address such as 'opc.tcp://10.0.0.5:4840', got {address!r}")
    sync = package("asyncua.sync", "outside")
    setup = Setup("opcua_body", period, oldest, holds, clock, "'ns=2;s=...'")
    return device(setup, model, measures, inputs, lambda sent, read: _Session(sync, address, sent, read))


class _Session:
    """A session with the server. `sync`: the package's module."""

    def __init__(self, sync: Any, address: str, sent: list[str], read: list[str]) -> None:
        self._sync, self._address, self._names = sync, address, (sent, read)
        self._client: Any = None

    def open(self) -> None:
        """Connect; the loop of a session that nobody ends must not keep the process alive."""
        if self._client is not None:
            self._client.disconnect()
        loop = self._sync.ThreadLoop()
        loop.daemon = True
        loop.start()
        self._client = self._sync.Client(self._address, tloop=loop)
        self._client.connect()
        self._sent, self._read = ([self._client.get_node(name) for name in names] for names in self._names)
        self._types = [node.read_data_type_as_variant_type() for node in self._sent]
        for name, kind in zip(self._names[0], self._types, strict=True):
            require(
                kind.name in _FLOATS + _WHOLE,
                f"{name} holds {kind.name}; an input needs a node of floats or whole numbers",
            )

    def write(self, command: Iterable[float]) -> None:
        """Write every node, as the type that it has."""
        for node, kind, value in zip(self._sent, self._types, command, strict=True):
            node.write_value(float(value) if kind.name in _FLOATS else round(float(value)), kind)

    def read(self) -> Iterator[tuple[float, float]]:
        """Values with a good status, and their ages."""
        for node, name in zip(self._read, self._names[1], strict=True):
            value = node.read_data_value(raise_on_bad_status=False)
            require(value.StatusCode.is_good(), f"{name} has the status {value.StatusCode.name}")
            stamp = value.SourceTimestamp or value.ServerTimestamp
            yield float(value.Value.Value), (datetime.now(UTC) - stamp).total_seconds() if stamp else inf
