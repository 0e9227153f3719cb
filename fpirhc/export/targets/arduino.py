"""A library folder of the Arduino IDE, in float, with an example; where avr-gcc is installed, its size on two boards.

What fits no board is refused with the bytes that it lacks.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fpirhc.errors import CompileError, InvalidValue, NotSupported
from fpirhc.export.device import Device
from fpirhc.export.footprint import deepest, said_by_gcc
from fpirhc.export.target import Target, device_of
from fpirhc.export.targets.c import IN_FLOAT, filled, layout_of, seconds, sources
from fpirhc.plant.motion import SECONDS

_SHORT_CALLS = "-Wl,--relax"  # calls of what is near take two bytes less
_FLAGS = (
    "-std=gnu99",
    "-Os",
    "-ffunction-sections",
    "-fdata-sections",
    "-Wl,--gc-sections",
    _SHORT_CALLS,
    "-fstack-usage",
)
# Regions so large that all is counted.
_LARGE = ("-Wl,--defsym=__DATA_REGION_LENGTH__=0xfe00", "-Wl,--defsym=__TEXT_REGION_LENGTH__=0x800000")
_ATANH = (
    "#include <math.h>\n#ifdef __AVR__\n#define atanh(x) (0.5f * log((1 + (x)) / (1 - (x)))) /* it has none */\n#endif"
)
# Numbers in four registers at once: avr-gcc would move them byte by byte, which takes a third more flash. Flags stay flags: as
# numbers of two bytes they wait in memory.
_NARROW = (
    '#if defined(__AVR__)\n#pragma GCC optimize("no-split-wide-types", "no-tree-forwprop", "no-ssa-phiopt")\n#endif\n'
)
_MEMBER = re.compile(r"^ *(?:casadi_real|\}) (\w+)(?:\[\d+\])?;", re.MULTILINE)
_STARTED = 900  # bytes of flash of Arduino's own core, without what a sketch calls


@dataclass(frozen=True)
class _Board:
    """Memory of a board, less what its loader takes, in bytes, and the processor of its kind that has most flash.

    With that one what is too large for the board is measured too.
    """

    name: str
    processor: str
    flash: int
    ram: int


_BOARDS = (_Board("Uno", "atmega1284p", 32256, 2048), _Board("Mega 2560", "atmega2560", 253_952, 8192))


@dataclass(frozen=True)
class _Size:
    """What one controller takes of a board: bytes of flash, of static RAM, and of stack at its deepest."""

    flash: int
    ram: int
    stack: int

    def lacks(self, board: _Board) -> str:
        """What the board has too little of, empty where all fits."""
        over = {"flash": self.flash - board.flash, "RAM": self.ram + self.stack - board.ram}
        return " and ".join(f"{bytes_} bytes of {what}" for what, bytes_ in over.items() if bytes_ > 0)


def _files(device: Device) -> Mapping[str, str | bytes]:
    if device.libm != "system":
        raise InvalidValue("the target arduino computes in float, and --libm own in double; leave --libm out")
    own = _own(device)
    sizes = {board: size_on(own, device.name, board) for board in _BOARDS} if shutil.which("avr-gcc") else {}
    lacking = _lacking(sizes)
    if sizes and all(lacking.values()):
        least = "; ".join(f"{board} lacks {what}" for board, what in lacking.items())
        raise NotSupported(f"'{device.title}' fits no board: {least}. Use {_smaller(device)}")
    sketch = filled(device, "arduino.ino", unit=device.problem.plant.time_unit, pace=_pace(device))
    return {
        "library.properties": _properties(device),
        **{f"src/{file}": text for file, text in own.items()},
        f"examples/{device.name}/{device.name}.ino": sketch,
        "layout.json": json.dumps(layout_of(device), indent=1),
        "sizes.txt": "".join([*_sizes(sizes), _clock(device)]),
    }


def _sizes(sizes: Mapping[_Board, _Size]) -> list[str]:
    return [_line(board, size) for board, size in sizes.items()] or ["avr-gcc is not installed\n"]


def _clock(device: Device) -> str:
    last = f"{IN_FLOAT * float(device.problem.period):.3g} {device.problem.plant.time_unit}"
    return f"In float a time tells its cycle for {IN_FLOAT} cycles, {last}: then the example begins anew at time 0.\n"


def _pace(device: Device) -> str:
    """The line with the period in microseconds."""
    unit = device.problem.plant.time_unit
    if unit not in SECONDS:
        return f'#error "the period is in {unit}: write const unsigned long TICKS = ...; with its microseconds here"'
    ticks = round(1e6 * seconds(device, "the target arduino"))
    if not 1 <= ticks < 2**31:  # half of what the counter of microseconds holds
        raise InvalidValue(
            f"the period of {1e-6 * ticks:g} s is none that the clock of an Arduino counts: expected 1 us to 35 min"
        )
    return f"const unsigned long TICKS = {ticks};"


def _own(device: Device) -> dict[str, str]:
    return {
        file: _in_float(_NARROW + text if file.endswith(".c") else _without_macros(text))
        for file, text in sources(device).items()
    }


def _without_macros(header: str) -> str:
    """The header, which a sketch reads after Arduino's own ones: a number called B0, PI or PORTB there is no macro of theirs."""
    names = dict.fromkeys(n for n in _MEMBER.findall(header) if n.isupper() and n != "F")  # F("text") is another thing
    lines = "".join(f"#undef {name}\n" for name in names)
    return header.replace("#ifdef __cplusplus", f"{lines}\n#ifdef __cplusplus" if lines else "#ifdef __cplusplus", 1)


def _lacking(sizes: Mapping[_Board, _Size]) -> dict[str, str]:
    return {board.name: size.lacks(board) for board, size in sizes.items()}


def _smaller(device: Device) -> str:
    """What fits instead of a controller that fits no board; the one without its gate is tried."""
    others = "fewer stages, or --to cortex-m"
    if device.bare:
        return others
    bare = device_of(device.problem, device.controller, device.title, name=device.name, cycles=1, bare=True)
    lacking = _lacking({board: size_on(_own(bare), bare.name, board) for board in _BOARDS})
    fits = [board for board, lacks in lacking.items() if not lacks]
    if fits:
        return f"--bare, which fits the {fits[0]}, {others}"
    board, lacks = list(lacking.items())[-1]
    return f"{others}; with --bare the {board} still lacks {lacks}"


TARGET = Target("arduino", "a library folder of the Arduino IDE, in float, with an example", _files, told="sizes.txt")


def size_on(files: Mapping[str, str], name: str, board: _Board) -> _Size:
    """Return what one controller takes of a board."""
    main = f'#include "{name}.h"\n{name}_controller c; {name}_inputs in; {name}_command out;\n'
    main += f"int main(void) {{ {name}_init(&c); for (;;) {name}_step(&c, &in, &out); }}\n"
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for file, text in {**files, "main.c": main}.items():
            (folder / file).write_text(text, encoding="utf-8")
        texts = [file for file in (*files, "main.c") if file.endswith(".c")]
        for command in (
            ["avr-gcc", f"-mmcu={board.processor}", *_FLAGS, *_LARGE, "-o", "program", *texts, "-lm"],
            ["avr-size", "program"],
        ):
            done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
            if done.returncode:
                raise CompileError(f"no program for the board {board.name}: {done.stderr.strip()[-2000:]}")
        code, data, bss = (int(word) for word in done.stdout.splitlines()[1].split()[:3])
        return _Size(code + data + _STARTED, data + bss, deepest(said_by_gcc(folder), name) + 32)


def _in_float(text: str) -> str:
    """C whose numbers are float, and whose whole numbers are those of the processor."""
    text = text.replace("#define casadi_real double", "#define casadi_real float")
    text = text.replace("#define casadi_int long long int", "#define casadi_int int")
    return text.replace("#include <math.h>", _ATANH, 1) if re.search(r"\batanh\(", text) else text


def _line(board: _Board, size: _Size) -> str:
    lacks = size.lacks(board)
    verdict = f"does not fit: lacks {lacks}" if lacks else "fits"
    return (
        f"{board.name}: {size.flash} of {board.flash} bytes of flash, {size.ram} + {size.stack} of stack of {board.ram} bytes "
        f"of RAM: {verdict}\n"
    )


def _properties(device: Device) -> str:
    return (
        f"name={device.name}\nversion=1.0.0\nauthor=fpirhc\nmaintainer=fpirhc\nsentence={device.title}\n"
        "paragraph=A controller written from its symbolic step.\ncategory=Signal Input/Output\nurl=\narchitectures=*\n"
        f"includes={device.name}.h\nldflags={_SHORT_CALLS}\n"
    )
