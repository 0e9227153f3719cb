"""A mock-up unit of FMI 2.0 for co-simulation: variables, the archive, and how a controller answers a master.

A command is computed from the inputs of its own cycle when it is read (feed-through). A master that exchanges values
after each step alone delays the command by one period, as a dead time of the plant would.
"""

from __future__ import annotations

import io
import re
import uuid
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fpirhc.errors import package
from fpirhc.export import Device, Target, shared_library
from fpirhc.export.c import checks_of, data_of, filled, sources
from fpirhc.symbolic.layout import Layout


@dataclass(frozen=True)
class Variable:
    """A number that a master sees."""

    name: str  # with derivatives as der(name, n), as FMI spells them
    unit: str  # empty where there is none
    causality: str  # by which FMI says who writes it
    variability: str = "discrete"  # by which FMI says when it changes
    start: float | None = None  # None where it is computed
    bounds: tuple[float, float] = (-np.inf, np.inf)

    @property
    def facts(self) -> dict[str, str]:
        """The attributes of XML that every number has."""
        ends = {key: end for key, end in zip(("min", "max"), self.bounds, strict=True) if np.isfinite(end)}
        numbers = ends if self.start is None else {**ends, "start": self.start}
        return {**({"unit": self.unit} if self.unit else {}), **{key: repr(float(v)) for key, v in numbers.items()}}


STATUS = Variable("status", "", "output")  # a whole number
_HEADERS = ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h")
_FOLDERS = {"x86_64-linux": "linux64", "x86_64-windows": "win64", "x86_64-darwin": "darwin64"}  # of libraries


def _files(device: Device) -> Mapping[str, str | bytes]:
    folder = Path(package("fmpy", "fmu", "the target fmu2").__file__).parent / "c-code"
    headers = {name: (folder / name).read_text(encoding="utf-8") for name in _HEADERS}
    variables, own = _variables(device), sources(device)
    text = filled(device, "fmi2.c", **_words(device))
    token = f"{{{uuid.uuid5(uuid.NAMESPACE_URL, ''.join([text, *own.values()]))}}}"
    unit = f'#define TOKEN "{token}"\n\n{text}\n{_unused(text, "".join(headers.values()))}'
    files = {**own, f"{device.name}_fmu.c": unit}
    described = _described(device, token, variables, [name for name in files if name.endswith(".c")])
    contents: dict[str, str | bytes] = {"modelDescription.xml": described}
    contents |= {f"sources/{name}": text for name, text in {**files, **headers}.items()}
    library = shared_library({**files, **headers})
    if library and library.platform in _FOLDERS:
        contents[f"binaries/{_FOLDERS[library.platform]}/{device.name}{library.ending}"] = library.content
    return {f"{device.name}.fmu": _archive(contents)}


TARGETS = (Target("fmu2", _files),)


# Variables and their numbers: the time, what is written in every cycle, commands, status, and the rest


def _variables(device: Device) -> list[Variable]:
    """The numbers in the order of their references; `_words` counts in the same order."""
    stepper = device.stepper
    listed = [Variable("time", device.problem.plant.time_unit, "independent", "continuous")]
    listed += _numbers(device.inputs, "input")[1:]
    checks, given = checks_of(device), [signal.name for signal in device.problem.given_signals]
    for part, layout in data_of(device).items():
        rows = _numbers(layout, "input") if part in given else _numbers(layout, "parameter", "tunable")
        bounds = checks[part][1] if part in checks else [row.bounds for row in rows]
        listed += [replace(row, bounds=ends) for row, ends in zip(rows, bounds, strict=True)]
    listed += [replace(one, start=None) for one in _numbers(Layout((stepper.signals["command"],)), "output")]
    listed.append(STATUS)
    trace = zip(stepper.signals.columns, stepper.signals.units, strict=True)
    return listed + [Variable(_structured(f"trace.{name}"), unit, "local") for name, unit in trace]


def _numbers(layout: Layout, causality: str, variability: str = "discrete") -> list[Variable]:
    rows = zip(layout.columns, layout.units, layout.start().tolist(), strict=True)
    return [Variable(_structured(name), unit, causality, variability, start) for name, unit, start in rows]


def _structured(name: str) -> str:
    """The structured name of FMI: q1'' is der(q1,2), and the end 0 of an interval Q1 is Q1[0]."""
    base = name.rstrip("'")
    order = len(name) - len(base)
    parts = [part if re.fullmatch(r"[A-Za-z_]\w*|\d+", part, re.ASCII) else f"'{part}'" for part in base.split(".")]
    text = re.sub(r"\.(\d+)(?=\.|$)", r"[\1]", ".".join(parts))
    return text if not order else f"der({text})" if order == 1 else f"der({text},{order})"


def _words(device: Device) -> dict[str, str]:
    """Where the shared functions find a number, by its reference; references count the variables in their order."""
    places = [("&s->in + 1", "", device.inputs.size - 1)]
    places += [(f"&s->c.{part}", part, one.size) for part, one in data_of(device).items()]
    rows, checked, checks, at = [], [], checks_of(device), 1
    for place, part, size in places:
        inside = f"  if (r >= {at} && r < {at + size})"
        rows.append(f"{inside} return (casadi_real*){place} + (r - {at});")
        if part in checks:
            answer = f"return {checks[part][0]}(&s->c, r - {at}, (casadi_real)value) ? DONE : REFUSED;"
            checked.append(f"{inside} {{\n    s->fresh = 0;\n    {answer}\n  }}")
        at += size
    status = at + device.stepper.signals["command"].size
    return {
        "references": f"enum {{ TIME, COMMANDS = {at}, STATUS = {status}, TRACE = {status + 1} }};",
        "written": "\n".join(rows),
        "checked": "\n".join(checked),
    }


# Texts


def _described(device: Device, token: str, variables: list[Variable], files: list[str]) -> str:
    kind = {"fmiVersion": "2.0", "generationTool": "fpirhc", "variableNamingConvention": "structured"}
    root = ET.Element("fmiModelDescription", {**kind, "modelName": device.title, "guid": token})
    facts = {"modelIdentifier": device.name, "canHandleVariableCommunicationStepSize": "false"}
    unit = ET.SubElement(root, "CoSimulation", facts)
    listed = ET.SubElement(unit, "SourceFiles")
    for file in files:
        ET.SubElement(listed, "File", name=file)
    units = ET.SubElement(root, "UnitDefinitions")
    for name in sorted({one.unit for one in variables if one.unit}):
        ET.SubElement(units, "Unit", name=name)
    period, end = (repr(float(v)) for v in (device.problem.period, device.problem.duration))
    ET.SubElement(root, "DefaultExperiment", startTime="0", stopTime=end, stepSize=period)
    listed = ET.SubElement(root, "ModelVariables")
    for k, one in enumerate(variables):
        own = {"name": one.name, "valueReference": str(k), "causality": one.causality, "variability": one.variability}
        scalar = ET.SubElement(listed, "ScalarVariable", own)
        ET.SubElement(scalar, "Integer" if one is STATUS else "Real", one.facts)
    structure = ET.SubElement(root, "ModelStructure")
    for tag in ("Outputs", "InitialUnknowns"):
        unknowns = ET.SubElement(structure, tag)
        for k, one in enumerate(variables):
            if one.causality == "output":
                ET.SubElement(unknowns, "Unknown", index=str(k + 1))
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _unused(text: str, headers: str) -> str:
    """Functions of the standard that a controller does not have: an importer looks for all of them, and each returns an error."""
    made = []
    for result, name, given in re.findall(r"typedef\s+([\w\s*]+?)\s+(fmi2\w+)TYPE\s*\(([^;]*?)\);", headers):
        if re.search(rf"\b{name}\(", text):
            continue
        names = re.findall(r"(\w+)\s*(?:\[\])?\s*(?:,|$)", given)
        ignored = " ".join(f"(void){one};" for one in names if one != "void")
        answer = "0" if "Status" not in result else "fmi2Error"
        made.append(f"{result} {name}({given}) {{ {ignored} return {answer}; }}")
    return "\n".join(made) + "\n"


def _archive(contents: Mapping[str, str | bytes]) -> bytes:
    """A zip of the contents without dates: the same controller gives the same bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in contents.items():
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()
