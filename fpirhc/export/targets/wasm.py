"""A WebAssembly module with its wrapper in JavaScript and a replay for Node."""

from __future__ import annotations

import json
from collections.abc import Mapping

from fpirhc.export.device import Device, Target, recorded, web_module
from fpirhc.export.targets.c import data_of, filled, layout_of, sources


def _files(device: Device) -> Mapping[str, str | bytes]:
    name, layout, structs = device.name, layout_of(device), data_of(device)
    calls = [f'EXPORT("{part}") void* get_{part}(void) {{ return &c.{part}; }}' for part in structs]
    if device.bounds:
        calls.append(
            f'EXPORT("set") int put(int which, double value) {{ return {name}_set(&c, ({name}_setting)which, value); }}'
        )
    files = {**sources(device), f"{name}_wasm.c": filled(device, "wasm.c", data="\n".join(calls))}
    text = json.dumps(layout, indent=1)
    return {
        f"{name}.wasm": web_module(files),
        f"{name}.mjs": filled(device, "wasm.mjs", layout=text, data=json.dumps(list(structs))),
        "layout.json": text,
        "samples.bin": recorded(device),
        "replay.mjs": filled(device, "wasm_replay.mjs"),
    }


TARGET = Target("wasm", _files)
