"""A mock-up unit of FMI 3.0 for co-simulation."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping

from fpirhc.export.binaries import PLATFORMS
from fpirhc.export.mock_up_unit import STATUS, Interface, Variable, mock_up_unit
from fpirhc.export.target import Target


def _step(period: str) -> Mapping[str, str]:
    return {"fixedInternalStepSize": period, "canGetAndSetFMUState": "true"}


def _add(listed: ET.Element, number: int, one: Variable) -> None:
    kind = "Int32" if one is STATUS else "Float64"
    ET.SubElement(listed, kind, {**one.attributes(number), **one.facts})


def _structure(root: ET.Element, computed: list[int]) -> None:
    for tag in ("Output", "InitialUnknown"):
        for number in computed:
            ET.SubElement(root, tag, valueReference=str(number))


def _build(_: ET.Element, name: str, files: list[str]) -> Mapping[str, ET.Element]:
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=name)
    listed = ET.SubElement(
        configuration, "SourceFileSet", language="C99", compiler="gcc", compilerOptions="-ffp-contract=off"
    )
    for file in files:
        ET.SubElement(listed, "SourceFile", name=file)
    return {"sources/buildDescription.xml": root}


_FMI3 = Interface(
    version="3.0",
    code="fmi3.c",
    headers=("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
    token="instantiationToken",
    step=_step,
    add=_add,
    structure=_structure,
    build=_build,
    folders={platform: platform for platform in PLATFORMS},
)
TARGET = Target(
    "fmu",
    "FMI 3.0 unit for co-simulation, with sources and libraries",
    lambda one: mock_up_unit(one, _FMI3),
    told="sizes.txt",
)
