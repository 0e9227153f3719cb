"""An OPC UA server, such as that of a programmable logic controller, as the reality of a problem, by asyncua.

    body = opcua_body("opc.tcp://10.0.0.5:4840", model, period=1.0, measures={"T": "ns=2;s=TT101"}, inputs={"Q": "ns=2;s=HV7"})
    problem = fp.Problem(plant=model, reality=body, ...)

A value with a bad status, and one that is too old, are bad answers: they are held or end the run, and never reach the controller.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import numpy as np

from fpirhc.adapters.real_time import RealTime
from fpirhc.errors import InvalidProblem, Mistakes, package
from fpirhc.plant.plant import Plant
from fpirhc.task.external_plant import ExternalPlant, quantities


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
        inputs: input of the model -> node that takes it; all inputs.
        oldest: age of a source time stamp beyond which a value is bad, s; None: any age.
        holds: consecutive bad answers that are bridged; see `ExternalPlant`.
        clock: of the cycles; None: the clock on the wall.

    Raises:
        NotSupported: asyncua is not installed.
        InvalidProblem: a quantity that the model does not have, or an input without node.
    """
    package("asyncua", "outside")
    units, mistakes = quantities(model), Mistakes("opcua_body")
    mistakes.unknown("measures: quantity", measures, units)
    mistakes.unknown("inputs: input", inputs, model.inputs)
    for name in (name for name in model.inputs if name not in inputs):
        mistakes.add(f"inputs: {name} has no node; add inputs={{'{name}': 'ns=2;s=...'}}")
    mistakes.raise_if_any()
    sent = [inputs[name] for name in model.inputs]
    body = _Body(address, sent, list(measures.values()), period, oldest, clock or RealTime())
    return ExternalPlant(body, measures={name: units[name] for name in measures}, holds=holds)


class _Body:
    """A session with the server.

    Args:
        address: of the server.
        sent: nodes of the inputs.
        read: nodes of the measurements.
        period: s.
        oldest: age of a value, s.
        clock: of the cycles.
    """

    def __init__(
        self, address: str, sent: list[str], read: list[str], period: float, oldest: float | None, clock: RealTime
    ) -> None:
        self._address, self._names, self._period, self._oldest, self._clock = (
            address,
            (sent, read),
            period,
            oldest,
            clock,
        )
        self._client: Any = None

    def reset(self, seed: int) -> np.ndarray:
        """Connect, and measure."""
        del seed
        if self._client is not None:
            self._client.disconnect()
        sync = package("asyncua.sync", "outside")
        loop = sync.ThreadLoop()
        loop.daemon = True  # a session that nobody ends must not keep the process alive
        loop.start()
        self._client = sync.Client(self._address, tloop=loop)
        self._client.connect()
        self._sent, self._read = ([self._client.get_node(name) for name in names] for names in self._names)
        self._types = [node.read_data_type_as_variant_type() for node in self._sent]
        self._clock.begin()
        return self._measured()

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        """Write the command, and read at the end of the cycle."""
        for node, kind, value in zip(self._sent, self._types, command, strict=True):
            node.write_value(float(value), kind)
        self._clock.wait_until(time + self._period)
        return self._measured()

    def _measured(self) -> np.ndarray:
        return np.array([self._good(node, name) for node, name in zip(self._read, self._names[1], strict=True)])

    def _good(self, node: Any, name: str) -> float:
        value = node.read_data_value(raise_on_bad_status=False)
        if not value.StatusCode.is_good():
            raise InvalidProblem(f"{name} has the status {value.StatusCode.name}")
        age = (datetime.now(UTC) - value.SourceTimestamp).total_seconds() if value.SourceTimestamp else 0.0
        if self._oldest is not None and age > self._oldest:
            raise InvalidProblem(f"{name} is {age:.3g} s old, and the oldest that is used is {self._oldest:g} s")
        return float(value.Value.Value)
