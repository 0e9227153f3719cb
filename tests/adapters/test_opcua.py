"""An OPC UA server of the test's own: a tank that moves by itself, and values that must not reach the controller."""

from __future__ import annotations

import dataclasses
import importlib
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
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
        return opcua_body(ADDRESS, TANK, period=PERIOD, clock=self.tank.clock, **(self.names | settings))


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


def test_a_value_without_the_sources_time_stamp_has_the_servers_or_is_a_bad_answer(server):
    """It counted as new for ever."""
    ua: Any = importlib.import_module("asyncua.ua")
    reality, loose = server.body(oldest=5.0), server.body()
    one = ua.DataValue(ua.Variant(1.0, ua.VariantType.Double))
    server.shown.write_value(one)  # the server stamps it
    assert reality.first(0) == loose.first(0) == [1.0]
    space = server.own.aio_obj.iserver.aspace
    attribute = space._nodes[server.shown.nodeid].attributes[ua.AttributeIds.Value]
    before = datetime.now(UTC) - timedelta(seconds=600)
    for stamped, words in (
        (dataclasses.replace(one, ServerTimestamp=before), "is 600 s old"),
        (one, "has no time stamp"),
    ):
        attribute.value = stamped
        mistake = reality._answer(reality.body._measured, "step", None).mistake
        assert f"h {words}, and the oldest that is used is 5 s" in mistake
        assert loose._answer(loose.body._measured, "step", None).values == [1.0]


def test_a_node_of_whole_numbers_is_rounded_to_and_one_of_a_text_is_told(server):
    """A valve in whole percent took no command, and the message was one of packing bytes."""
    ua: Any = importlib.import_module("asyncua.ua")
    objects, space = server.own.nodes.objects, server.own.register_namespace("test")
    valve = objects.add_variable(ua.NodeId("valve", space), "valve", 0, ua.VariantType.Int16)
    word = objects.add_variable(ua.NodeId("word", space), "word", "shut")
    valve.set_writable()
    bodies = [server.body(inputs={"q": node.nodeid.to_string()}) for node in (valve, word)]
    bodies[0].first(0)
    assert bodies[0].read(0.0, np.array([-2.7])).mistake == ""
    assert valve.read_value() == -3
    with pytest.raises(
        InvalidProblem, match=f"ns={space};s=word holds String; an input needs a node of floats or whole numbers"
    ):
        bodies[1].first(0)


def test_mistakes_are_named(server):
    with pytest.raises(InvalidProblem) as caught:
        opcua_body(ADDRESS, TANK, period=PERIOD, measures={"hh": "ns=2;i=2"}, inputs={})
    text = str(caught.value)
    assert "measures: quantity 'hh' is unknown. Did you mean 'h'?" in text
    assert "inputs: q has no address; add inputs={'q': 'ns=2;s=...'}" in text
