"""Families and names: members are found by looking and do not know each other, and a former name leads to the present one."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import fpirhc as fp
from fpirhc import errors
from fpirhc.errors import InvalidName
from fpirhc.members import FAMILIES, examples, member_classes, member_modules


def imported(path: Path) -> set[str]:
    """Modules that a file imports, also inside functions."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names = {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.module}
    return names | {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}


@pytest.mark.parametrize("family", FAMILIES)
def test_members_do_not_know_each_other(family):
    """A member imports its contract and shared parts, no other member of its family: each can be deleted alone."""
    members = {m.__name__: Path(str(m.__file__)) for m in member_modules(family)}
    contract = FAMILIES[family].type.__module__  # which has the member that changes nothing
    for name, path in members.items():
        assert not imported(path) & (set(members) - {name, contract}), name


@pytest.mark.parametrize("family", FAMILIES)
def test_every_member_is_a_public_name(family):
    """Also one that no list names: by the name of its file, or as a name of the package."""
    for member in member_classes(family):
        assert getattr(fp, member.__name__) is member


def test_a_wrong_name_is_answered_with_the_nearest():
    with pytest.raises(InvalidName, match="Did you mean 'Sigmoid'"):
        getattr(fp, "Sigmid")  # noqa: B009 -- a type checker knows that it is not there


def test_names_that_tools_look_for_cost_nothing(monkeypatch):
    """Every test module has them looked for; to find the nearest of 160 names took a fifth of the time to collect the tests."""
    monkeypatch.setattr(errors, "nearest", None)
    assert not hasattr(fp, "__wrapped__")
    assert not hasattr(fp, "_pytestfixturefunction")


def test_examples_of_wrappers_need_something_inside():
    """Without an inner map only maps that stand alone are given."""
    alone = examples("deformations")
    assert {type(m).__name__ for m in alone}.isdisjoint({"Paired", "ModelReferenced"})
    around = examples("deformations", alone[0])
    assert {type(m).__name__ for m in around} >= {"Paired", "ModelReferenced"}
