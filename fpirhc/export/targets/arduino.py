"""A library folder of the Arduino IDE, in float, with an example."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping

import casadi as ca
import numpy as np

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
# An estimate to about a third of what simavr counted for shipped controllers: microseconds of each kind of operation, see `_cost`.
_MICROSECONDS = (1.0, 5.0, 15.0, 100.0)
_SUMS = {ca.OP_ADD, ca.OP_SUB, ca.OP_MUL, ca.OP_SQ, ca.OP_TWICE}
_QUOTIENTS = {ca.OP_DIV, ca.OP_INV, ca.OP_SQRT}
_ELEMENTARY = {
    *(
        ca.OP_EXP,
        ca.OP_LOG,
        ca.OP_POW,
        ca.OP_CONSTPOW,
        ca.OP_SIN,
        ca.OP_COS,
        ca.OP_TAN,
        ca.OP_ASIN,
        ca.OP_ACOS,
        ca.OP_ATAN,
    ),
    *(
        ca.OP_ATAN2,
        ca.OP_SINH,
        ca.OP_COSH,
        ca.OP_TANH,
        ca.OP_ASINH,
        ca.OP_ACOSH,
        ca.OP_ATANH,
        ca.OP_ERF,
        ca.OP_LOG1P,
        ca.OP_EXPM1,
    ),
}
_MEMBER = re.compile(r"^ *(?:casadi_real|\}) (\w+)(?:\[\d+\])?;", re.MULTILINE)


def _files(device: Device) -> Mapping[str, str | bytes]:
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
    """How long a step takes beside the period, and for how long a time in float tells its cycle."""
    period, unit = float(device.problem.period), device.problem.plant.time_unit
    count = _cost(device.stepper.function)
    if count is None:
        step = "A plan takes an Uno a tenth of a second and more"
    else:
        took = float(count @ _MICROSECONDS) * 1e-6
        step = f"A step has {count.sum()} operations, which take an Uno of 16 MHz about {1e3 * took:.2g} ms"
        if took > period * SECONDS.get(unit, np.inf):
            step += ": TOO LONG"
    return (
        f"{step}. The period is {period:g} {unit}; the example prints the longest step beside it.\n"
        f"In float a time tells its cycle for {IN_FLOAT} cycles, {IN_FLOAT * period:.3g} {unit}: then the example begins anew.\n"
    )


def _cost(function: ca.Function) -> np.ndarray | None:
    """Numbers of moves and choices, of sums and products, of divisions, and of elementary functions; None of a plan."""
    if not function.is_a("SXFunction"):
        return None
    kinds = [function.instruction_id(k) for k in range(function.n_instructions())]
    counts = [sum(kind in some for kind in kinds) for some in (_SUMS, _QUOTIENTS, _ELEMENTARY)]
    return np.array([len(kinds) - sum(counts), *counts])


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
