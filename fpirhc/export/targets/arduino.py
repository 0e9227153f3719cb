"""A library folder of the Arduino IDE, in float, with an example."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping

from fpirhc.errors import InvalidValue
from fpirhc.export.device import Device
from fpirhc.export.target import Target
from fpirhc.export.targets.c import IN_FLOAT, filled, layout_of, seconds, sources
from fpirhc.plant.motion import SECONDS

_SHORT_CALLS = "-Wl,--relax"  # calls of what is near take two bytes less
_ATANH = (
    "#include <math.h>\n#ifdef __AVR__\n#define atanh(x) (0.5f * log((1 + (x)) / (1 - (x)))) /* it has none */\n#endif"
)
# Numbers in four registers at once: avr-gcc would move them byte by byte, which takes a third more flash. Flags stay flags: as
# numbers of two bytes they wait in memory.
_NARROW = (
    '#if defined(__AVR__)\n#pragma GCC optimize("no-split-wide-types", "no-tree-forwprop", "no-ssa-phiopt")\n#endif\n'
)
_MEMBER = re.compile(r"^ *(?:casadi_real|\}) (\w+)(?:\[\d+\])?;", re.MULTILINE)


def _files(device: Device) -> Mapping[str, str | bytes]:
    if device.libm != "system":
        raise InvalidValue("the target arduino computes in float, and --libm own in double; leave --libm out")
    own = _own(device)
    sketch = filled(device, "arduino.ino", unit=device.problem.plant.time_unit, pace=_pace(device))
    return {
        "library.properties": _properties(device),
        **{f"src/{file}": text for file, text in own.items()},
        f"examples/{device.name}/{device.name}.ino": sketch,
        "layout.json": json.dumps(layout_of(device), indent=1),
        "clock.txt": _clock(device),
    }


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


TARGET = Target("arduino", "a library folder of the Arduino IDE, in float, with an example", _files)


def _in_float(text: str) -> str:
    """C whose numbers are float, and whose whole numbers are those of the processor."""
    text = text.replace("#define casadi_real double", "#define casadi_real float")
    text = text.replace("#define casadi_int long long int", "#define casadi_int int")
    return text.replace("#include <math.h>", _ATANH, 1) if re.search(r"\batanh\(", text) else text


def _properties(device: Device) -> str:
    return (
        f"name={device.name}\nversion=1.0.0\nauthor=fpirhc\nmaintainer=fpirhc\nsentence={device.title}\n"
        "paragraph=A controller written from its symbolic step.\ncategory=Signal Input/Output\nurl=\narchitectures=*\n"
        f"includes={device.name}.h\nldflags={_SHORT_CALLS}\n"
    )
