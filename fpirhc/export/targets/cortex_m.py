"""Static libraries for Cortex-M7 (double) and Cortex-M4F (float), an example for CMSIS, and programs that run without a board.

The programs answer lines over semihosting, see `processor.c`: in QEMU, in a debugger, or in `fpirhc.export.cortex`.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from fpirhc.export.binaries import arm_programs
from fpirhc.export.cortex import Image
from fpirhc.export.device import Device
from fpirhc.export.footprint import deepest, said_by_clang
from fpirhc.export.samples import recorded
from fpirhc.export.target import Target
from fpirhc.export.targets.c import filled, layout_of, seconds, sources
from fpirhc.plant.motion import SECONDS


def _files(device: Device) -> Mapping[str, str | bytes]:
    name = device.name
    own, script = sources(device), filled(device, "board.ld")
    around = {file: filled(device, file) for file in ("processor.c", "board.c")}
    made, said = arm_programs(own, around, script)
    return {
        **own,
        **around,
        "board.ld": script,
        "example.c": filled(device, "example.c", unit=device.problem.plant.time_unit, pace=_pace(device)),
        "layout.json": json.dumps(layout_of(device), indent=1),
        "samples.bin": recorded(device),
        "sizes.txt": "".join(
            _size(Image(made[f"{place}.elf"]), what, deepest(said_by_clang(said[place]), name))
            for place, what in (("m7", "Cortex-M7, double"), ("m4f", "Cortex-M4F, float"))
            if place in said
        ),
        **{(f"{name}_{file}" if file.endswith(".elf") else f"lib{name}_{file}"): data for file, data in made.items()},
    }


def _size(image: Image, what: str, stack: int) -> str:
    return (
        f"{what}: {image.size(0)} bytes of flash with exp and the like and the console of processor.c, "
        f"{image.size(0x20000000)} of RAM, at most {stack} of stack\n"
    )


def _pace(device: Device) -> str:
    """Lines with the system ticks of a period, each of at most a millisecond, and the length of one."""
    unit = device.problem.plant.time_unit
    if unit not in SECONDS:
        return f'#error "the period is in {unit}: define TICKS, the system ticks in a period, and TICK, the seconds of one"'
    ticks = max(1, math.ceil(1e3 * seconds(device, "the target cortex-m") * (1 - 1e-9)))
    return f"#define TICKS {ticks}UL\n#define TICK {seconds(device, 'the target cortex-m') / ticks!r}"


def _processor(folder: Path, name: str) -> Sequence[str]:
    return [sys.executable, "-m", "fpirhc.export.cortex", str(folder / f"{name}_m7.elf")]


TARGET = Target(
    "cortex-m",
    "libraries for Cortex-M7 and M4F, and programs that run in QEMU or Unicorn",
    _files,
    libm="own",
    processor=_processor,
    told="sizes.txt",
)
