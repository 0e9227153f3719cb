"""A WebAssembly module with its wrapper in JavaScript, types, and a replay for Node."""

from __future__ import annotations

import json
from collections.abc import Mapping

from fpirhc.export.binaries import web_module
from fpirhc.export.device import Device, identifiers
from fpirhc.export.samples import recorded
from fpirhc.export.target import Target
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
        f"{name}.d.ts": _types(device, list(structs)),
        "layout.json": text,
        "samples.bin": recorded(device),
        "replay.mjs": filled(device, "wasm_replay.mjs"),
    }


TARGET = Target("wasm", "WebAssembly with a wrapper in JavaScript and types", _files)


def _types(device: Device, structs: list[str]) -> str:
    settings = " | ".join(json.dumps(path) for path in device.bounds) or "never"
    rows = "\n".join(f"    {name}: Float64Array;" for name in identifiers(structs))
    return f"""// {device.title}. Made by fpirhc.
export interface Column {{ name: string; unit: string; start: number; }}
export const layout: {{
  name: string; of: string; period: number; time_unit: string;
  status: Record<string, number>;
  bounds: Record<string, [number | null, number | null]>;
  inputs: Column[]; command: Column[]; memory: Column[]; trace: Column[];
}};
export type Setting = {settings};
export class Controller {{
  readonly inputs: Float64Array;
  readonly command: Float64Array;
  readonly memory: Float64Array;
  readonly trace: Float64Array;
  readonly data: {{
{rows}
  }};
  step(sample: ArrayLike<number>): number;
  reset(): void;
  set(path: Setting, value: number): boolean;
}}
export function load(source: BufferSource | Response): Promise<Controller>;
"""
