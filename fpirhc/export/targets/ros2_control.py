"""A package of ros2_control: the controller as a plugin of the controller manager."""

from __future__ import annotations

import json
from collections.abc import Mapping
from xml.sax.saxutils import escape

from fpirhc.errors import InvalidValue
from fpirhc.export.device import Device
from fpirhc.export.target import Target
from fpirhc.export.targets.c import filled, layout_of, seconds, sources
from fpirhc.plant.motion import SECONDS

_DERIVATIVES = ("position", "velocity", "acceleration", "jerk")


def _files(device: Device) -> Mapping[str, str | bytes]:
    name, own = device.name, sources(device)
    _check_rate(seconds(device, "ros2_control"))
    states, commands = _states(device), [f"{one}/effort" for one in device.problem.plant.inputs]
    controller = filled(
        device,
        "ros2_control.cpp",
        states=_texts(states),
        commands=_texts(commands),
        declared=_declared(device),
        live=str(len(device.bounds)),
        paths=_texts(list(device.bounds)),
        given=str(len(states)),
        sent=str(len(commands)),
        seconds=repr(SECONDS[device.problem.plant.time_unit]),
    )
    words = {"sources": " ".join(file for file in own if file.endswith(".c")), "text": escape(device.title)}
    return {
        **own,
        f"{name}_controller.cpp": controller,
        f"{name}_plugin.xml": filled(device, "ros2_plugin.xml", **words),
        "package.xml": filled(device, "ros2_package.xml", **words),
        "CMakeLists.txt": filled(device, "ros2_CMakeLists.txt", **words),
        "layout.json": json.dumps(layout_of(device), indent=1),
    }


TARGET = Target("ros2_control", "package with a plugin of the controller manager", _files)


def _check_rate(period: float) -> None:
    """Raise for a period that no update rate of a controller manager has: a whole number of cycles per second."""
    rate = max(1, round(1 / period))
    if abs(rate * period - 1) > 1e-6:
        raise InvalidValue(
            f"ros2_control updates a whole number of times per second, and the period is {period:g} s: the nearest one is "
            f"{1 / rate:.6g} s"
        )


def _states(device: Device) -> list[str]:
    """Default names of the interfaces: q1' is q1/velocity, a response of order 2 is q1/acceleration."""
    orders, names = device.problem.plant.response_orders, []
    for signal in device.inputs.signals:
        if signal.name == "time":
            continue
        for element in signal.elements:
            base = element.rstrip("'")
            order = orders.get(element, 0) if signal.name == "realised" else len(element) - len(base)
            names.append(f"{base}/{_DERIVATIVES[order] if order < len(_DERIVATIVES) else f'derivative_{order}'}")
    return names


def _texts(names: list[str]) -> str:
    return ", ".join(json.dumps(name) for name in names)


def _declared(device: Device) -> str:
    numbers = device.stepper.numbers
    return "".join(f'    auto_declare<double>("{path}", {float(numbers[path])!r});\n' for path in device.bounds)
