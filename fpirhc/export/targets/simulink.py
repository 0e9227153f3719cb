"""A level-2 S-function for Simulink."""

from __future__ import annotations

import json
from collections.abc import Mapping

from fpirhc.export.device import Device
from fpirhc.export.target import Target
from fpirhc.export.targets.c import filled, layout_of, sources


def _files(device: Device) -> Mapping[str, str | bytes]:
    name, own = device.name, sources(device)
    ports = [signal for signal in device.inputs.signals if signal.name != "time"]
    block = filled(
        device,
        "simulink.c",
        sources=" ".join(file for file in own if file.endswith(".c")),
        ports="; ".join(f"{one.name} ({', '.join(one.elements)})" for one in ports),
        settings=", ".join(device.bounds) or "none",
        count=str(len(ports)),
        live=str(len(device.bounds)),
        widths=", ".join(str(one.size) for one in ports),
        paths=", ".join(map(json.dumps, device.bounds)),
    )
    return {**own, f"{name}_sfun.c": block, "layout.json": json.dumps(layout_of(device), indent=1)}


TARGET = Target("simulink", "level-2 S-function for Simulink", _files)
