"""What a release carries: a bill of materials that names everything that is needed."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
import tarfile
import tomllib
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
PROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def script(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def bill() -> Any:
    return script("sbom").bill()


def test_bill_of_materials_names_what_is_needed():
    """Every direct dependency with its installed version, and no package of an extra; the graph closes; twice the same."""
    document = bill()
    assert (document["bomFormat"], document["specVersion"]) == ("CycloneDX", "1.6")
    versions = {c["name"].lower().replace("_", "-"): c["version"] for c in document["components"]}
    needed = "casadi numpy scipy osqp control matplotlib pandas rich jinja2 lazy-loader"
    for name in needed.split():
        assert versions[name] == distribution(name).version
    assert "sphinx" not in versions
    inside = (ROOT / "fpirhc" / "report" / "assets" / "uPlot.iife.min.js").read_text(encoding="utf-8")
    assert f"(v{versions['uplot']})" in inside.splitlines()[0]
    assert [f"hatchling=={versions['hatchling']}"] == tomllib.loads(PROJECT)["build-system"]["requires"]
    references = {c["bom-ref"] for c in (*document["components"], document["metadata"]["component"])}
    assert len(references) == len(document["components"]) + 1
    assert {d["ref"] for d in document["dependencies"]} == references
    assert {n for d in document["dependencies"] for n in d["dependsOn"]} <= references
    assert json.dumps(bill()) == json.dumps(document)


def test_the_oldest_versions_are_those_that_are_declared():
    lines = script("oldest").oldest(PROJECT)
    assert {"casadi==3.8.2", "numpy==1.26", "pytest==8"} <= set(lines)
    with pytest.raises(ValueError, match="numpy: expected 'name>=version'"):
        script("oldest").oldest(PROJECT.replace('"numpy>=1.26"', '"numpy"'))


def test_the_conda_recipe_needs_what_the_package_needs():
    """conda-forge has matplotlib without its graphical parts as matplotlib-base."""
    project = tomllib.loads(PROJECT)["project"]
    recipe = (ROOT / "scripts" / "conda" / "recipe.yaml").read_text(encoding="utf-8")
    assert f"  version: {project['version']}\n" in recipe
    run = recipe.partition("  run:\n")[2].partition("\ntests:")[0]
    needs = {"matplotlib" if n == "matplotlib-base" else n: v for n, v in re.findall(r"- (\S+) >=(\S+)", run)}
    declared = dict(requirement.split(">=") for requirement in project["dependencies"])
    assert needs == {"python": project["requires-python"].removeprefix(">="), **declared}
    assert f"- {tomllib.loads(PROJECT)['build-system']['requires'][0].replace('==', ' ==')}\n" in recipe


def test_a_source_distribution_carries_what_its_checks_need(tmp_path):
    pytest.importorskip("hatchling", reason="the builder is in an environment of its own where it was not asked for")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", str(tmp_path)], cwd=ROOT, check=True
    )
    (archive,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(archive) as contents:
        names = {name.partition("/")[2] for name in contents.getnames()}
    assert {"SECURITY.md", "CODE_OF_CONDUCT.md", ".ci/run", ".ci/gates", "scripts/setup.sh", "tests/lanes.txt"} <= names


AUDIT = ROOT / "scripts" / "audit_answer.py"
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
    found, said = tmp_path / "found.json", tmp_path / "said.txt"
    said.write_text("ConnectionError: no route to host")
    if packages is not None:
        found.write_text(json.dumps({"dependencies": packages}))
    done = subprocess.run(
        [sys.executable, str(AUDIT), str(found), str(said)], capture_output=True, text=True, check=False
    )
    assert done.returncode == code
    assert words in done.stdout + done.stderr
