"""Writes a bill of materials of this package and everything that it needs: CycloneDX 1.6, JSON.

    python scripts/sbom.py dist/fpirhc.cdx.json

It describes the installed versions: run it where the release was tested. Nothing in it depends on the time or the machine.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

ROOT = "fpirhc"
_NAME = re.compile(r"^[A-Za-z0-9._-]+")


def bill() -> dict[str, object]:
    """Return the bill of materials of ROOT."""
    packages = dict(sorted(_closure(ROOT).items()))
    graph = [
        {"ref": _purl(package), "dependsOn": sorted(_purl(packages[n]) for n in set(_needs(package)) if n in packages)}
        for package in packages.values()
    ]
    own = packages.pop(ROOT)
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": {**_component(own), "type": "application"}},
        "components": [_component(package) for package in packages.values()],
        "dependencies": graph,
    }


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
