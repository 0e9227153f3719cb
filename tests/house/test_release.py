"""What a release carries: a bill of materials that names everything that is needed."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "sbom.py"


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
    for name in (
        "casadi",
        "numpy",
        "scipy",
        "osqp",
        "control",
        "matplotlib",
        "pandas",
        "rich",
        "jinja2",
        "lazy-loader",
    ):
        assert versions[name] == distribution(name).version
    assert "sphinx" not in versions
    references = {c["bom-ref"] for c in (*document["components"], document["metadata"]["component"])}
    assert len(references) == len(document["components"]) + 1
    assert {d["ref"] for d in document["dependencies"]} == references
    assert {n for d in document["dependencies"] for n in d["dependsOn"]} <= references
    assert json.dumps(bill()) == json.dumps(document)


AUDIT = Path(__file__).parents[2] / "scripts" / "audit_answer.py"
UNKNOWN = {"name": "casadi", "skip_reason": "Dependency not found on PyPI"}


@pytest.mark.parametrize(
    ("packages", "code", "words"),
    [
        ([{"name": "numpy", "version": "2", "vulns": []}, UNKNOWN], 0, "no known vulnerabilities in 1 of 2 packages"),
        ([{"name": "numpy", "version": "2", "vulns": [{"id": "CVE-1"}]}], 1, "numpy has known vulnerabilities: CVE-1"),
        (
            [UNKNOWN, {"name": "pip", "version": "1", "vulns": []}],
            0,
            "skipped, the data that pip-audit reached knows neither",
        ),
        (None, 0, "skipped, pip-audit gave no answer: ConnectionError: no route"),
    ],
)
def test_an_audit_that_reached_no_data_is_no_answer(packages, code, words, tmp_path):
    """pip-audit finds nothing where its data knows no package."""
    found, said = tmp_path / "found.json", tmp_path / "said.txt"
    said.write_text("ConnectionError: no route to host")
    if packages is not None:
        found.write_text(json.dumps({"dependencies": packages}))
    done = subprocess.run(
        [sys.executable, str(AUDIT), str(found), str(said)], capture_output=True, text=True, check=False
    )
    assert done.returncode == code
    assert words in done.stdout + done.stderr
