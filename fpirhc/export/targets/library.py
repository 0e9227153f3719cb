"""A shared library whose functions take arrays: for LabVIEW, MATLAB, Python's ctypes, C#, Rust."""

from __future__ import annotations

import json
from collections.abc import Mapping

from fpirhc.errors import NotInstalled
from fpirhc.export.device import Device, Target, shared_library
from fpirhc.export.targets.c import filled, layout_of, sources
from fpirhc.symbolic.layout import Layout
from fpirhc.symbolic.native import why_no_compiler


def _files(device: Device) -> Mapping[str, str | bytes]:
    name = device.name
    change = f"  return {name}_set(({name}_controller*)controller, ({name}_setting)setting, value);"
    nothing = "  (void)controller, (void)setting, (void)value;\n  return 0;"
    own = {
        **sources(device),
        f"{name}_library.c": filled(device, "library.c", change=change if device.bounds else nothing),
        "README.md": filled(
            device,
            "library.md",
            sample=_listed(device.inputs),
            command=_listed(Layout((device.stepper.signals["command"],))),
            settings=", ".join(device.bounds) or "none",
        ),
    }
    made = shared_library(own)
    if made is None:
        raise NotInstalled(
            f"a shared library needs a C compiler: {why_no_compiler()}; install gcc or clang, or pip install 'fpirhc[compiler]'"
        )
    return {
        **own,
        f"{name}_{made.platform}{made.ending}": made.content,
        "layout.json": json.dumps(layout_of(device), indent=1),
    }


def _listed(layout: Layout) -> str:
    """Names and units in their order."""
    return ", ".join(f"`{name}` [{unit}]" for name, unit in zip(layout.columns, layout.units, strict=True))


TARGET = Target("library", _files)
