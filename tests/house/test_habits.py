"""What contributors rely on: the same gates everywhere, a quick lane of tests that exist."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import re
import runpy
import tomllib
from functools import cache
from pathlib import Path

import fpirhc

ROOT = Path(__file__).resolve().parents[2]
LANES = (ROOT / "tests" / "lanes.txt").read_text(encoding="utf-8").splitlines()


def text(path: str) -> str:
    return (ROOT / path).read_text(encoding="utf-8")


def test_pre_commit_has_the_gates_of_ci():
    """The same tools with the same arguments; ruff is given the files instead of a dot."""
    gates = [line.replace('"$bin/', "").replace('"', "").removesuffix(" .") for line in text(".ci/gates").splitlines()]
    commands = [line for line in gates if re.match(r"(ruff|mypy|lint-imports)\b", line)]
    hooks = re.findall(r"entry: \.venv/bin/(.+)", text(".pre-commit-config.yaml"))
    assert len(hooks) >= 4
    assert hooks == commands


def test_workflow_runs_what_contributors_run():
    """Scripts of the repository that exist and may be executed."""
    scripts = re.findall(r"run: (\./\S+)", text(".github/workflows/ci.yml"))
    assert {"./.ci/gates", "./.ci/run"} <= set(scripts)
    assert all((ROOT / script).stat().st_mode & 0o111 for script in scripts)
    assert "./.ci/gates" in text(".ci/run")


def test_folders_of_contributing_are_there():
    for folder in re.findall(r"`((?:fpirhc|problems|tests|docs)/[\w/.]+)`", text("CONTRIBUTING.md")):
        assert "NAME" in folder or (ROOT / folder).exists(), folder


def test_the_quick_lane_leaves_out_tests_that_exist():
    """A test that was renamed would silently come back into the quick lane; write the list anew with './scripts/test measure'."""
    places = [line.split()[1].split("::") for line in LANES if line[:1].isdigit()]
    there = cache(lambda file: text(f"tests/{file}") if (ROOT / "tests" / file).exists() else "")
    assert ["::".join(place) for place in places if f"def {place[-1]}(" not in there(place[0])] == []


def test_no_problem_is_loaded_before_the_first_test(loaded_while_collecting):
    """Every process of a run collects all tests: names are enough for that, and `tasks` loads a problem where a test reads it."""
    assert loaded_while_collecting == []


def test_faults_are_made_in_modules_that_exist_and_in_each_once():
    """A module that was renamed would silently have no score."""
    targets = tomllib.loads(text("scripts/mutation.toml"))["target"]
    modules = [module for target in targets for module in target["modules"]]
    assert [module for module in modules if not list(ROOT.glob(module))] == []
    assert len(modules) == len(set(modules))
    tests = [test.partition("::")[0] for target in targets for test in target["tests"]]
    assert [test for test in tests if not (ROOT / test).exists()] == []


def test_what_overrides_nothing_documented_has_a_docstring_of_its_own():
    """Ruff cannot see what a method inherits; where it inherits nothing, nobody would learn what it does."""
    classes = {
        value
        for module in pkgutil.walk_packages(fpirhc.__path__, "fpirhc.")
        if not module.name.endswith("__main__")
        for value in vars(importlib.import_module(module.name)).values()
        if inspect.isclass(value) and value.__module__ == module.name and value.__name__[0] != "_"
    }
    public = {
        f"{c.__module__}.{c.__name__}.{name}": getattr(c, name)
        for c in classes
        for name in vars(c)
        if name[0] != "_" and name not in vars(c).get("__annotations__", {})
    }
    described = {name: inspect.isfunction(value) or isinstance(value, property) for name, value in public.items()}
    assert sum(described.values()) > 1000
    assert sorted(name for name in public if described[name] and not inspect.getdoc(public[name])) == []


def test_a_file_says_its_idea_in_at_most_six_lines():
    """A reader comes to the contract at once; what is longer is theory, and has a page."""
    texts = {one.relative_to(ROOT): one.read_text(encoding="utf-8") for one in (ROOT / "fpirhc").rglob("*.py")}
    headers = {name: ast.get_docstring(ast.parse(text), clean=False) for name, text in texts.items()}
    assert [name for name, header in headers.items() if not header or len(header.splitlines()) > 6] == []


def test_an_adapter_has_at_most_sixty_lines_of_code():
    """It is a translation (decision 0075): more would be a simulator or a bus of our own. What several need stands beside them.

    `control.py` has two, one for each direction.
    """
    lines = runpy.run_path(str(ROOT / "scripts" / "code_lines.py"))["code_lines"]
    files = {one.name: one.read_text(encoding="utf-8") for one in (ROOT / "fpirhc" / "adapters").glob("*.py")}
    shared = {"names.py", "real_time.py", "__init__.py"}
    sizes = {
        name: len(lines(text)) / len(re.findall(r"^def [a-z]", text, re.M))
        for name, text in files.items()
        if name not in shared
    }
    assert {"fmu.py", "can_bus.py", "environment.py", "urdf.py"} <= set(sizes)
    assert {name: size for name, size in sizes.items() if size > 60} == {}
