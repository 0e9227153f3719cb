"""What a release carries: a bill of materials that names everything that is needed."""

from __future__ import annotations

import importlib.util
import json
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

SCRIPT = Path(__file__).parents[1] / "scripts" / "sbom.py"


def bill() -> Any:
    spec = importlib.util.spec_from_file_location("sbom", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.bill()


def test_bill_of_materials_names_what_is_needed():
    """Every direct dependency with its installed version, and no package of an extra; the graph closes; twice the same."""
    document = bill()
    assert (document["bomFormat"], document["specVersion"]) == ("CycloneDX", "1.6")
    versions = {c["name"].lower().replace("_", "-"): c["version"] for c in document["components"]}
    for name in ("casadi", "numpy", "scipy", "osqp", "control", "matplotlib", "pandas", "rich", "lazy-loader"):
        assert versions[name] == distribution(name).version
    assert "sphinx" not in versions
    references = {c["bom-ref"] for c in (*document["components"], document["metadata"]["component"])}
    assert len(references) == len(document["components"]) + 1
    assert {d["ref"] for d in document["dependencies"]} == references
    assert {n for d in document["dependencies"] for n in d["dependsOn"]} <= references
    assert json.dumps(bill()) == json.dumps(document)
