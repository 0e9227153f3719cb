"""Writes a bill of materials of this package and everything that it needs: CycloneDX 1.6, JSON.

    python scripts/sbom.py dist/fpirhc.cdx.json

It describes the installed versions: run it where the release was tested. Beside the packages stand what lies in the package itself
(uPlot) and what the wheel is built with. Nothing in it depends on the time or the machine.
"""

from __future__ import annotations

import json
import re
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

ROOT = "fpirhc"
PROJECT = Path(__file__).resolve().parents[1]
_NAME = re.compile(r"^[A-Za-z0-9._-]+")


def bill() -> dict[str, object]:
    """Return the bill of materials of ROOT."""
    packages = dict(sorted(_closure(ROOT).items()))
    graph = [
        {"ref": _purl(package), "dependsOn": sorted(_purl(packages[n]) for n in set(_needs(package)) if n in packages)}
        for package in packages.values()
    ]
    own = packages.pop(ROOT)
    inside, builders = _uplot(), _builders()
    graph[[p["ref"] for p in graph].index(_purl(own))]["dependsOn"].append(inside["bom-ref"])
    graph += [{"ref": component["bom-ref"], "dependsOn": []} for component in (inside, *builders)]
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": {**_component(own), "type": "application"}},
        "components": [*(_component(package) for package in packages.values()), inside, *builders],
        "dependencies": graph,
    }


def _uplot() -> dict[str, object]:
    """The library that draws a report's charts, which lies in the package."""
    text = (PROJECT / "fpirhc" / "report" / "assets" / "uPlot.iife.min.js").read_text(encoding="utf-8")
    version = re.match(r"/\*! \S+ \(v([0-9.]+)\)", text)
    if version is None:
        raise ValueError("uPlot.iife.min.js: the first line names no version; expected '/*! ADDRESS (v1.2.3) */'")
    return _listed("uPlot", version[1], f"pkg:npm/uplot@{version[1]}", license="MIT")


def _builders() -> list[dict[str, object]]:
    """What the wheel is built with, in the versions that pyproject.toml fixes."""
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text(encoding="utf-8"))
    pairs = [requirement.split("==") for requirement in project["build-system"]["requires"]]
    return [_listed(name, version, f"pkg:pypi/{name}@{version}", scope="excluded") for name, version in pairs]


def _listed(name: str, version: str, purl: str, license: str = "", scope: str = "required") -> dict[str, object]:
    facts: dict[str, object] = {"type": "library", "bom-ref": purl, "name": name, "version": version, "purl": purl}
    facts["scope"] = scope
    return {**facts, "licenses": [{"license": {"id": license}}]} if license else facts


def _closure(root: str) -> dict[str, Distribution]:
    """The installed packages that `root` needs, directly or not, by name, with `root` itself."""
    packages, waiting = dict[str, Distribution](), [root]
    while waiting:
        name = waiting.pop()
        if name in packages:
            continue
        try:
            packages[name] = distribution(name)
        except PackageNotFoundError:
            continue  # needed on another system or Python only
        waiting += _needs(packages[name])
    return packages


def _needs(package: Distribution) -> Iterator[str]:
    for requirement in package.requires or []:
        match = _NAME.match(requirement)
        if match and "extra ==" not in requirement:
            yield _normal(match[0])


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _purl(package: Distribution) -> str:
    return f"pkg:pypi/{_normal(package.metadata['Name'])}@{package.version}"


def _component(package: Distribution) -> dict[str, object]:
    facts: dict[str, object] = {
        "type": "library",
        "bom-ref": _purl(package),
        "name": package.metadata["Name"],
        "version": package.version,
        "purl": _purl(package),
    }
    text = package.metadata.get("License-Expression") or package.metadata.get("License") or ""
    if text and "\n" not in text and len(text) < 80:
        facts["licenses"] = [{"license": {"name": text}}]
    return facts


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(json.dumps(bill(), indent=2) + "\n", encoding="utf-8")
