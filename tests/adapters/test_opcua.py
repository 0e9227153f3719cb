"""An OPC UA server of the test's own: a tank that moves by itself, and values that must not reach the controller."""

from __future__ import annotations

import importlib
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from tank import PERIOD, TANK, Tank, errors

import fpirhc as fp
from fpirhc.adapters.opcua import opcua_body
from fpirhc.errors import InvalidProblem

pytest.importorskip("asyncua", reason="it needs the extra fpirhc[outside]")
pytestmark = pytest.mark.filterwarnings("ignore")  # of the package itself

ADDRESS = "opc.tcp://127.0.0.1:48411/tank/"


class Server:
    """The tank behind two nodes."""

    def __init__(self) -> None:
        from asyncua.sync import Server as Own

        self.own = Own()
        self.own.set_endpoint(ADDRESS)
        space = self.own.register_namespace("test")
        tank = self.own.nodes.objects.add_object(space, "tank")
        self.shown, self.sent = tank.add_variable(space, "level", 1.0), tank.add_variable(space, "inflow", 0.0)
        self.sent.set_writable()
        level, inflow = (node.nodeid.to_string() for node in (self.shown, self.sent))
        self.tank = Tank(self.sent.read_value, self.shown.write_value)
        self.names: dict[str, Any] = {"measures": {"h": level}, "inputs": {"q": inflow}}

    def body(self, **settings) -> fp.ExternalPlant:
        return opcua_body(ADDRESS, TANK, period=PERIOD, clock=self.tank.clock, **self.names, **settings)


@pytest.fixture(scope="module")
def server():
    one = Server()
    one.own.start()
    yield one
    one.own.stop()


def test_adaptation_pays_on_a_server(server):
    plain, adapted = errors(server.tank, server.body())
    assert adapted < 0.5 * plain


def test_a_bad_status_and_an_old_value_are_bad_answers(server):
    ua: Any = importlib.import_module("asyncua.ua")
    reality = server.body(oldest=5.0)
    reality.first(0)
    value = ua.Variant(1.0, ua.VariantType.Double)
    server.shown.write_value(ua.DataValue(value, ua.StatusCode(ua.StatusCodes.BadSensorFailure)))
    assert "has the status BadSensorFailure" in reality._answer(reality.body._measured, "step", None).mistake
    before = datetime.now(UTC) - timedelta(seconds=60)
    server.shown.write_value(ua.DataValue(value, SourceTimestamp=before))
    assert "s old, and the oldest that is used is 5 s" in reality._answer(reality.body._measured, "step", None).mistake
    server.shown.write_value(1.0)
    assert reality._answer(reality.body._measured, "step", None).values == [1.0]


def test_mistakes_are_named(server):
    with pytest.raises(InvalidProblem) as caught:
        opcua_body(ADDRESS, TANK, period=PERIOD, measures={"hh": "ns=2;i=2"}, inputs={})
    text = str(caught.value)
    assert "measures: quantity 'hh' is unknown. Did you mean 'h'?" in text
    assert "inputs: q has no address; add inputs={'q': 'ns=2;s=...'}" in text
