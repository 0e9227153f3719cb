"""Families and values: members are found by looking and do not know each other, and values do not change under who holds them."""

import ast
import importlib
import inspect
import pkgutil
from dataclasses import is_dataclass
from pathlib import Path

import pytest

import fpirhc as fp
from fpirhc.conformance import FAMILIES, examples, member_classes

PACKAGE = Path(fp.__file__).parent
WRITERS = "adapters", "export", "problem_files", "symbolic"  # packages whose dataclasses may collect something
# Who may ask an object for its class: a theorem about two maps, in a room that nothing else imports.
THEOREM = {"certificate/__init__.py": {"Affine", "ModelReferenced"}}


def imported(path: Path) -> set[str]:
    """Modules that a file imports, also inside functions."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names = {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.module}
    return names | {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}


@pytest.mark.parametrize("family", FAMILIES)
def test_members_do_not_know_each_other(family):
    """A member imports its contract and no other member of its family: each can be deleted alone, and is found as `fp.NAME`."""
    classes = member_classes(family)
    homes = {one.__module__: Path(str(inspect.getsourcefile(one))) for one in classes}
    contract = FAMILIES[family].type.__module__  # which has the member that changes nothing
    for name, path in homes.items():
        assert not imported(path) & (set(homes) - {name, contract}), name
    assert [one for one in classes if getattr(fp, one.__name__) is not one] == []


def test_examples_of_wrappers_need_something_inside():
    """Without an inner map only maps that stand alone are given."""
    alone = examples("deformations")
    assert {type(m).__name__ for m in alone}.isdisjoint({"Paired", "ModelReferenced"})
    assert {type(m).__name__ for m in examples("deformations", alone[0])} >= {"Paired", "ModelReferenced"}


def asked_classes(tree: ast.AST) -> set[str]:
    """Names of classes in isinstance, issubclass, `type(x) is` and class patterns."""
    asked: list[ast.AST] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("isinstance", "issubclass"):
            asked.append(node.args[1])
        elif isinstance(node, ast.MatchClass):
            asked.append(node.cls)
        elif isinstance(node, ast.Compare) and getattr(getattr(node.left, "func", None), "id", "") == "type":
            asked += node.comparators
    return {n.id for one in asked for n in ast.walk(one) if isinstance(n, ast.Name)}


def test_nobody_is_asked_for_his_class():
    """A user's own member is treated as a shipped one: no isinstance and no pattern on a member of a family, in any file."""
    assert asked_classes(ast.parse("isinstance(m, RFPT | Rotation) or type(m) is Affine")) == {
        "RFPT",
        "Rotation",
        "Affine",
    }
    members = {one.__name__ for family in FAMILIES for one in member_classes(family)}
    files = {path.relative_to(PACKAGE).as_posix(): path for path in PACKAGE.rglob("*.py")}
    ladders = {
        name: asked_classes(ast.parse(path.read_text(encoding="utf-8"))) & members for name, path in files.items()
    }
    assert {name: found for name, found in ladders.items() if found} == THEOREM


def test_values_are_frozen():
    """What is a key of a cache, or is shared by loops, must not change under them."""
    modules = [m.name for m in pkgutil.walk_packages(fp.__path__, "fpirhc.") if not m.name.endswith("__main__")]
    values = {
        f"{module}.{value.__name__}": value
        for module in modules
        if module.split(".")[1] not in WRITERS
        for value in vars(importlib.import_module(module)).values()
        if inspect.isclass(value) and value.__module__ == module and is_dataclass(value)
    }
    assert len(values) > 150
    assert [name for name, value in values.items() if not getattr(value, "__dataclass_params__").frozen] == []  # noqa: B009
