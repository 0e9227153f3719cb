"""C99: a header with named structs, the controller, its layout, a replay of recorded cycles, and a CMake file.

No heap, no files, no globals: the caller owns one struct, and several of them run side by side.
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Mapping
from importlib import resources

import numpy as np

from fpirhc.controllers.gate import HELD, MISSING, MOST_MISSING, SKIPPED
from fpirhc.errors import InvalidValue, NotInstalled
from fpirhc.export import Device, Target, identifiers, in_comment, literal, shared_library
from fpirhc.plant.motion import SECONDS
from fpirhc.simulation.replay import CLOCK_MEMORY, LONGEST
from fpirhc.simulation.simulate import simulate
from fpirhc.status import Status
from fpirhc.symbolic.driver import OF_TYPE, SIGNATURE, of_type
from fpirhc.symbolic.layout import Layout
from fpirhc.symbolic.native import why_no_compiler
from fpirhc.symbolic.open import SETTINGS
from fpirhc.task.limits import Interval

_FEW = 12  # entries of a signal that are named in C; longer ones are arrays
_WIDTH = 120
IN_FLOAT = 2**22  # cycles from time 0 on, in float: a time is known to an eighth of a period
_TYPES = """#ifndef casadi_real
#define casadi_real double
#endif
#ifndef casadi_int
#define casadi_int long long int
#endif
"""


def sources(device: Device) -> dict[str, str]:
    """Return the header and the C files of a controller by name."""
    name = device.name
    before = f"/* {device.title}. Made by fpirhc from its symbolic step. */\n"
    steps = {f"{name}_step{k or ''}.c": before + body for k, body in enumerate(device.sources)}
    return {f"{name}.h": _header(device), f"{name}.c": _controller(device), **steps}


def _files(device: Device) -> Mapping[str, str | bytes]:
    own = sources(device)
    return {
        **own,
        "layout.json": json.dumps(layout_of(device), indent=1),
        "samples.bin": recorded(device),
        "main.c": filled(device, "main.c"),
        "CMakeLists.txt": filled(device, "CMakeLists.txt", sources=" ".join(n for n in own if n.endswith(".c"))),
    }


def filled(device: Device, file: str, **more: str) -> str:
    """Return a template with the words of a controller and these between @ filled in."""
    return template(file, {"name": device.name, "NAME": device.name.upper(), "title": device.title, **more})


def template(file: str, words: Mapping[str, str]) -> str:
    """Return a template with its words between @ filled in."""
    text = resources.files(__package__).joinpath("templates", file).read_text(encoding="utf-8")
    return re.sub(r"@(\w+)@", lambda m: words[m[1]], text)


def _header(device: Device) -> str:
    name, upper, stepper = device.name, device.name.upper(), device.stepper
    memory, trace, sizes = stepper.memory, stepper.signals, device.sizes
    command = Layout((trace["command"],))
    structs = {"inputs": device.inputs, **data_of(device), "memory": memory, "command": command, "trace": trace}
    counts = {
        "INPUTS": device.inputs.size,
        "COMMANDS": command.size,
        "MEMORY": memory.size,
        "TRACE": trace.size,
        "STATUSES": max(Status) + 1,
    }
    own = [f"  {name}_{part} {part};" for part in ("memory", *data_of(device), "trace")]
    lines = [
        f"/* {device.title}. Made by fpirhc; names and units are those of layout.json.",
        "",
        f"   {name}_init(&c) begins; {name}_step(&c, &in, &out) is one control cycle and returns its status; {name}_reset(&c)",
        "   forgets the past and keeps parameters and settings. A struct serves one thread. */",
        "",
        f"#ifndef {upper}_H",
        f"#define {upper}_H",
        "",
        _TYPES,
        "#ifdef __cplusplus",
        'extern "C" {',
        "#endif",
        "",
        f"#define {upper}_PERIOD {float(device.problem.period)!r} /* {in_comment(device.problem.plant.time_unit)} */",
        f"/* Cycles from time 0 on, beyond which a time in float no longer tells its cycle: {name}_reset, and time 0, before. */",
        f"#define {upper}_CYCLES (sizeof(casadi_real) == sizeof(float) ? {IN_FLOAT}UL : 4294967294UL)",
        *[f"#define {upper}_{key} {value} /* numbers */" for key, value in counts.items()],
        "",
        f"typedef enum {{\n{_list(f'{upper}_{s.name} = {int(s)}' for s in Status)}\n}} {name}_status;",
        "",
        *[_struct(f"{name}_{part}", layout) for part, layout in structs.items()],
        "/* Members before `next` may be read, and data written, between two steps; those from `next` on are the step's own. */",
        "typedef struct {",
        *own,
        f"  {name}_memory next;",
        f"  const casadi_real* arg[{sizes['arg']}];",
        f"  casadi_real* res[{sizes['res']}];",
        f"  casadi_int iw[{sizes['iw']}];",
        f"  casadi_real w[{sizes['w']}];",
        f"}} {name}_controller;",
        "",
        f"void {name}_init({name}_controller* c);",
        f"void {name}_reset({name}_controller* c);",
        f"{name}_status {name}_step({name}_controller* c, const {name}_inputs* in, {name}_command* out);",
        *_set_declaration(device),
        "",
        "#ifdef __cplusplus",
        "}",
        "#endif",
        "#endif",
    ]
    return "\n".join(lines) + "\n"


def _set_declaration(device: Device) -> list[str]:
    name, upper, paths = device.name, device.name.upper(), list(device.stepper.bounds())
    if not paths:
        return []
    items = [f"{upper}_SET_{one.upper()}" for one in identifiers(paths)]
    return [
        "",
        f"typedef enum {{\n{_list(items)}\n}} {name}_setting;",
        "",
        "/* Put a number in force from the next step on, and return 1. Return 0 where it is not finite, outside its bounds, or",
        "   on the wrong side of the other end of its interval: then the old number stays. */",
        f"int {name}_set({name}_controller* c, {name}_setting setting, casadi_real value);",
    ]


def data_of(device: Device) -> dict[str, Layout]:
    """Return the structs of what stays until somebody changes it, by name; none is empty."""
    return {s.name: Layout((s,)) for s in device.data.signals if s.size and (s.elements or s.units)}


def checks_of(device: Device) -> dict[str, tuple[str, list[Interval]]]:
    """Return for a struct of data that is written through a check: that C function (controller, entry, value), and all bounds."""
    bounds = device.stepper.bounds()
    return {SETTINGS: (f"{device.name}_set", list(bounds.values()))} if bounds else {}


def _struct(name: str, layout: Layout) -> str:
    """A struct of numbers without gaps, in the order of the layout."""
    signals, lines = layout.signals, []
    names = identifiers([s.name for s in signals])
    alone = len(signals) == 1 and bool(signals[0].elements)
    for own, signal in zip(names, signals, strict=True):
        each = [in_comment(unit) or "as in the problem file" for unit in signal.entry_units]
        units = ", ".join(dict.fromkeys(each))
        entries = identifiers(signal.elements)
        if not entries:
            lines.append(f"  casadi_real {own}; /* {units} */")
        elif alone:
            lines += [f"  casadi_real {e}; /* {u} */" for e, u in zip(entries, each, strict=True)]
        elif len(entries) <= _FEW:
            lines += [
                "  struct {",
                *[f"    casadi_real {e}; /* {u} */" for e, u in zip(entries, each, strict=True)],
                f"  }} {own};",
            ]
        else:
            lines.append(f"  casadi_real {own}[{len(entries)}]; /* {units} */")
    return "typedef struct {\n" + "\n".join(lines) + f"\n}} {name};\n"


def _list(items: object) -> str:
    return ",\n".join(f"  {one}" for one in items)  # type: ignore[attr-defined]


def _controller(device: Device) -> str:
    name, stepper = device.name, device.stepper
    memory, trace = stepper.memory, stepper.signals
    lower, upper = device.problem.limits.input_bounds(device.problem.plant)
    tables = {"START": stepper.start(), "LEAST": lower, "MOST": upper}
    for part, layout in data_of(device).items():
        tables[part.upper()] = layout.start()
    texts = [_table(key, values) for key, values in tables.items()]
    words = {
        "declaration": f"int {name}_raw{SIGNATURE};",
        "status": str(trace.slice("status").start),
        "command": str(trace.slice("command").start),
        "bind": "\n".join(_bound(device)),
        "init": "\n".join(f"  memcpy(&c->{part}, {part.upper()}, sizeof {part.upper()});" for part in data_of(device)),
        "set": _setter(device),
    }
    texts += [
        f"#define PERIOD ((casadi_real){literal(device.problem.period)})",
        f"#define LONGEST ((casadi_real){LONGEST})",
        *_replay(device),
    ]
    return filled(
        device,
        "controller.c",
        tables=of_type("\n".join(texts)),
        before=str(memory.slice(CLOCK_MEMORY.name).start),
        held=str(memory.slice(HELD).start),
        skipped=str(memory.slice(f"{SKIPPED}_before").start),
        missing=str(memory.slice(MISSING.name).start),
        skipped_now=str(trace.slice(SKIPPED).start),
        fails=str(int(not stepper.function.is_a("SXFunction"))),
        changes=str(int(bool(stepper.bounds()))),
        **words,
    )


def _replay(device: Device) -> list[str]:
    """Numbers and places of what `fpirhc.simulation.replay` needs."""
    replay, inputs = device.stepper.replay, device.inputs
    samples = len(next(iter(replay.good.values())))
    good = np.full((samples, inputs.size), -1)
    for name, places in replay.good.items():
        good[:, inputs.slice(name)] = places
    tables = {"GOOD": good.ravel(), "KEPT": replay.kept, "STAYS": replay.stays}
    numbers = {
        "BRIDGED": replay.bridged,
        "FILLS": replay.fills,
        "SAMPLES": samples,
        "KEPTS": replay.kept.size,
        "STAY": replay.stays.size,
    }
    return [
        f"enum {{ {', '.join(f'{name} = {value}' for name, value in numbers.items())} }};",
        f"#define MOST_MISSING ((casadi_real){literal(MOST_MISSING)})",
        "/* places in the memory */",
        *(f"static const int {name}[] = {{{', '.join(map(str, values))}}};" for name, values in tables.items()),
    ]


def _bound(device: Device) -> list[str]:
    """Lines that tell the Function where its arguments are, in its order."""
    lines, data = ["  c->arg[0] = (const casadi_real*)&c->memory;"], data_of(device)
    for k, signal in enumerate(device.stepper.reads.signals, start=1):
        if signal.name in device.inputs:
            place = f"(const casadi_real*)in + {device.inputs.slice(signal.name).start}"
        else:
            place = f"(const casadi_real*)&c->{signal.name}" if signal.name in data else "0"
        lines.append(f"  c->arg[{k}] = {place};")
    return lines


def _setter(device: Device) -> str:
    """The function that checks a setting before it is in force; empty where nothing is live."""
    bounds = device.stepper.bounds()
    if not bounds:
        return ""
    paths = list(bounds)
    other = [_other_end(path, paths) for path in paths]
    low, high = (np.array([ends[k] for ends in bounds.values()]) for k in (0, 1))
    tables = of_type("\n".join([_table("LOWEST", low), _table("HIGHEST", high)])).replace(OF_TYPE, "")
    # Of an interval the sign of the other end's number + 1 says on which side it stands.
    return f"""
{tables}
static const int OTHERS[] = {{{", ".join(map(str, other))}}};  /* k + 1: setting k must be above; -k - 1: below; 0: no interval */

int {device.name}_set({device.name}_controller* c, {device.name}_setting setting, casadi_real value) {{
  casadi_real* settings = (casadi_real*)&c->settings;
  int which = (int)setting, other;
  if (which < 0 || which >= {len(paths)} || !(fabs(value) <= FINITE)) return 0;
  if (!(value >= LOWEST[which] && value <= HIGHEST[which])) return 0;
  other = OTHERS[which];
  if (other > 0 && !(value < settings[other - 1])) return 0;
  if (other < 0 && !(value > settings[-other - 1])) return 0;
  settings[which] = value;
  return 1;
}}
"""


def _other_end(path: str, paths: list[str]) -> int:
    """K + 1 for the lower end of limits whose upper end is setting k, -k - 1 for the upper end, else 0."""
    owner, _, end = path.rpartition(".")
    other = f"{owner}.{1 - int(end)}" if path.startswith("limits.") and end in ("0", "1") else ""
    return 0 if other not in paths else (paths.index(other) + 1) * (1 if end == "0" else -1)


def _table(name: str, values: np.ndarray) -> str:
    """A table of numbers; infinite ones are beyond every finite one."""
    texts = [literal(v) if np.isfinite(v) else "-10 * FINITE" if v < 0 else "10 * FINITE" for v in values]
    lines: list[str] = []
    line = " "
    for text in texts:
        if len(line) + len(text) + 2 > _WIDTH:
            lines, line = [*lines, line], " "
        line += f" {text},"
    return "\n".join([f"static const casadi_real {name}[] = {{", *lines, line.rstrip(","), "};"])


def layout_of(device: Device) -> dict[str, object]:
    """Return names, units, start values and bounds of everything."""
    stepper = device.stepper
    command = Layout((stepper.signals["command"],))
    layouts = {
        "inputs": device.inputs,
        **data_of(device),
        "memory": stepper.memory,
        "command": command,
        "trace": stepper.signals,
    }
    return {
        "name": device.name,
        "of": device.title,
        "period": float(device.problem.period),
        "time_unit": device.problem.plant.time_unit,
        "status": {s.name: int(s) for s in Status},
        "work": device.sizes,
        **{part: _columns(layout) for part, layout in layouts.items()},
        "bounds": {path: [e if np.isfinite(e) else None for e in ends] for path, ends in stepper.bounds().items()},
    }


def _columns(layout: Layout) -> list[dict[str, object]]:
    rows = zip(layout.columns, layout.units, layout.start().tolist(), strict=True)
    return [{"name": column, "unit": unit, "start": start} for column, unit, start in rows]


def _library_files(device: Device) -> Mapping[str, str | bytes]:
    name = device.name
    change = f"  return {name}_set(({name}_controller*)controller, ({name}_setting)setting, value);"
    nothing = "  (void)controller, (void)setting, (void)value;\n  return 0;"
    own = {
        **sources(device),
        f"{name}_library.c": filled(device, "library.c", change=change if device.stepper.bounds() else nothing),
        "README.md": filled(
            device,
            "library.md",
            sample=_listed(device.inputs),
            command=_listed(Layout((device.stepper.signals["command"],))),
            settings=", ".join(device.stepper.bounds()) or "none",
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


_OFFSET, _PRIME, _MASK = 0xCBF29CE484222325, 0x100000001B3, (1 << 64) - 1
_NAN = 0x7FF8000000000000
_CYCLES = 2000  # of a record


def recorded(device: Device) -> bytes:
    """Return the file: a head of four 32-bit numbers (cycles, numbers given, commands, whether bits count), and the cycles.

    Bits do not count where there is no compiler and a plan was solved by the virtual machine, which rounds in another order.

    Samples are those of a run, again from its beginning where it is too short; a plant outside is not run, but its model is.
    """
    stepper = device.stepper
    rows = _with_faults(_samples(device), device.problem.period)
    exact = stepper.compiled or stepper.function.is_a("SXFunction")
    head = struct.pack("<4i", len(rows), rows.shape[1], device.problem.plant.input.size, exact)
    memory, parts = stepper.start(), [head]
    for k, row in enumerate(rows):
        damaged = memory.size - 3 if k == _DAMAGED else -1
        if damaged >= 0:
            memory = memory.copy()
            memory[damaged] = np.nan
        command, memory = stepper.step_measured(row[0], row[1:], memory)
        trace = np.concatenate([value.ravel() for value in stepper.trace().values()])
        hashes = struct.pack("<2Q", _digest(memory), _digest(trace))
        parts += [row.tobytes(), struct.pack("<d", damaged), command.tobytes(), hashes]
    return b"".join(parts)


_GAPS = ((150, 3), (220, 30), (300, 700))  # first cycle behind a gap, and the number of missing ones
_DAMAGED = 95  # cycle before which an entry of the memory becomes NaN


def _with_faults(rows: np.ndarray, period: float) -> np.ndarray:
    """Samples with what a device meets: no numbers, outliers, a plant that jumped, and cycles that are missing.

    Behind a gap the samples are those of its end, as the reference is: others would keep the commands at their limits.
    """
    place = np.arange(_CYCLES)
    for first, missing in _GAPS:
        place[first:] += missing
    rows = rows[place % len(rows)]
    rows[:, 0] = period * place
    # main.c knows the first outlier, that of cycle 40.
    faults: dict[int, tuple[int, float]] = {
        20: (1, np.nan), 25: (-1, np.inf), 30: (-1, -np.inf), 35: (0, np.nan), 40: (1, 1e9), 41: (1, 1e9), 42: (1, 1e9),
        50: (-1, 1e200), 52: (0, 1e18), 53: (1, -np.inf),
    }  # fmt: skip
    for k, (entry, value) in faults.items():
        rows[k, entry] = value
    rows[60:85, 1] += 1e4
    rows[350, 0] = rows[349, 0]  # a cycle twice
    return rows


def _digest(values: np.ndarray) -> int:
    """FNV-1a of the bits of the numbers, eight bytes at a time."""
    bits = np.where(np.isnan(values), np.uint64(_NAN), values.view(np.uint64))
    total = _OFFSET
    for one in bits.tolist():
        total = ((total ^ one) * _PRIME) & _MASK
    return total


def _samples(device: Device) -> np.ndarray:
    """What the step is given in a run."""
    run = simulate(device.problem.of_equations, device.controller, seed=0)
    parts = (run.time if name == "time" else run[name] for name in device.inputs.names)
    return np.hstack([np.asarray(part, dtype=float).reshape(len(run.time), -1) for part in parts])


_ATANH = (
    "#include <math.h>\n#ifdef __AVR__\n#define atanh(x) (0.5f * log((1 + (x)) / (1 - (x)))) /* it has none */\n#endif"
)
_MEMBER = re.compile(r"^ *(?:casadi_real|\}) (\w+)(?:\[\d+\])?;", re.MULTILINE)


def _arduino_files(device: Device) -> Mapping[str, str | bytes]:
    name, unit = device.name, device.problem.plant.time_unit
    return {
        "library.properties": f"name={name}\nversion=1.0.0\nauthor=fpirhc\nmaintainer=fpirhc\nsentence={device.title}\n"
        "paragraph=A controller written from its symbolic step.\ncategory=Signal Input/Output\nurl=\narchitectures=*\n"
        f"includes={name}.h\n",
        **{f"src/{file}": _in_float(text, file.endswith(".h")) for file, text in sources(device).items()},
        f"examples/{name}/{name}.ino": filled(device, "arduino.ino", unit=unit, pace=_pace(device, unit)),
        "layout.json": json.dumps(layout_of(device), indent=1),
    }


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


TARGETS = Target("c", _files), Target("library", _library_files), Target("arduino", _arduino_files)
