"""A library folder of the Arduino IDE, in float, with an example that tells the longest step beside the period."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping

from fpirhc.errors import InvalidValue
from fpirhc.export.device import Device, Target
from fpirhc.export.targets.c import filled, layout_of, sources
from fpirhc.plant.motion import SECONDS

_ATANH = (
    "#include <math.h>\n#ifdef __AVR__\n#define atanh(x) (0.5f * log((1 + (x)) / (1 - (x)))) /* it has none */\n#endif"
)
_MEMBER = re.compile(r"^ *(?:casadi_real|\}) (\w+)(?:\[\d+\])?;", re.MULTILINE)


def _files(device: Device) -> Mapping[str, str | bytes]:
    name, unit = device.name, device.problem.plant.time_unit
    return {
        "library.properties": f"name={name}\nversion=1.0.0\nauthor=fpirhc\nmaintainer=fpirhc\nsentence={device.title}\n"
        "paragraph=A controller written from its symbolic step.\ncategory=Signal Input/Output\nurl=\narchitectures=*\n"
        f"includes={name}.h\n",
        **{f"src/{file}": _in_float(text, file.endswith(".h")) for file, text in sources(device).items()},
        f"examples/{name}/{name}.ino": filled(device, "arduino.ino", unit=unit, pace=_pace(device, unit)),
        "layout.json": json.dumps(layout_of(device), indent=1),
    }


TARGET = Target("arduino", _files)


def _pace(device: Device, unit: str) -> str:
    """The line with the period in microseconds."""
    if unit not in SECONDS:
        return f'#error "the period is in {unit}: write const unsigned long TICKS = ...; with its microseconds here"'
    ticks = round(1e6 * float(device.problem.period) * SECONDS[unit])
    if not 1 <= ticks < 2**31:  # half of what the counter of microseconds holds
        raise InvalidValue(
            f"the period of {1e-6 * ticks:g} s is none that the clock of an Arduino counts: expected 1 us to 35 min"
        )
    return f"const unsigned long TICKS = {ticks};"


def _in_float(text: str, header: bool) -> str:
    """C whose numbers are float, and whose whole numbers are those of the processor.

    A sketch reads the header after Arduino's own ones: a number called B0, PI or PORTB there is no macro of theirs.
    """
    text = text.replace("#define casadi_real double", "#define casadi_real float")
    text = text.replace("#define casadi_int long long int", "#define casadi_int int")
    names = dict.fromkeys(
        n for n in _MEMBER.findall(text) if header and n.isupper() and n != "F"
    )  # F("text") is another thing
    undefined = "".join(f"#undef {name}\n" for name in names)
    text = text.replace("#ifdef __cplusplus", f"{undefined}\n#ifdef __cplusplus", 1)
    return text.replace("#include <math.h>", _ATANH, 1) if re.search(r"\batanh\(", text) else text
