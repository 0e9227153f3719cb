"""A level-2 S-function for Simulink."""

from __future__ import annotations

import json
from collections.abc import Mapping

from fpirhc.export.device import Device, identifiers
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
        number=_NUMBER if device.bounds else "",
        set=_set(device),
    )
    return {**own, f"{name}_sfun.c": block, "layout.json": json.dumps(layout_of(device), indent=1)}


_NUMBER = """/* A parameter of the block; NaN, which no setting takes, where it is no number. */
static double number(SimStruct* S, int k) {
  const mxArray* p = ssGetSFcnParam(S, k);
  int one = mxIsDouble(p) && !mxIsComplex(p) && !mxIsSparse(p) && mxGetNumberOfElements(p) == 1;
  return one ? *mxGetPr(p) : mxGetNaN();
}

"""
TARGET = Target("simulink", "level-2 S-function for Simulink", _files)


def _set(device: Device) -> str:
    items = [f"{device.name.upper()}_SET_{one.upper()}" for one in identifiers(list(device.bounds))]
    return "".join(
        f"  if (!{device.name}_set(&b->c, {item}, number(S, {k})))\n"
        f'    ssSetErrorStatus(S, "{device.name}: {path} is no number, or outside its bounds");\n'
        for k, (path, item) in enumerate(zip(device.bounds, items, strict=True))
    )
