"""A mock-up unit of FMI 2.0 for co-simulation, which most tools import."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping

from fpirhc.export.mock_up_unit import STATUS, Interface, Variable, mock_up_unit
from fpirhc.export.target import Target


def _step(_: str) -> Mapping[str, str]:
    return {"canGetAndSetFMUstate": "true"}


def _add(listed: ET.Element, number: int, one: Variable) -> None:
    scalar = ET.SubElement(listed, "ScalarVariable", one.attributes(number))
    ET.SubElement(scalar, "Integer" if one is STATUS else "Real", one.facts)


def _structure(root: ET.Element, computed: list[int]) -> None:
    for tag in ("Outputs", "InitialUnknowns"):
        unknowns = ET.SubElement(root, tag)
        for number in computed:
            ET.SubElement(unknowns, "Unknown", index=str(number + 1))


def _build(described: ET.Element, _: str, files: list[str]) -> Mapping[str, ET.Element]:
    unit = described.find("CoSimulation")
    assert unit is not None
    listed = ET.SubElement(unit, "SourceFiles")
    for file in files:
        ET.SubElement(listed, "File", name=file)
    return {}


_FMI2 = Interface(
    version="2.0",
    code="fmi2.c",
    headers=("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
    token="guid",
    step=_step,
    add=_add,
    structure=_structure,
    build=_build,
    folders={"x86_64-linux": "linux64", "x86_64-windows": "win64", "x86_64-darwin": "darwin64"},
)
TARGET = Target("fmu2", "FMI 2.0 unit for co-simulation", lambda one: mock_up_unit(one, _FMI2))
