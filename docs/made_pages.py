"""Pages that are made of the package when the site is built: the API, the command line, and the table of all problems."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import all_problems
import typer
from typer.testing import CliRunner

import fpirhc as fp
from fpirhc.cli import opt
from fpirhc.members import FAMILIES, member_classes

DOCS = Path(__file__).resolve().parent
SECTIONS = {
    "Plants and problems": ("plant", "task", "problem_files", "symbolic"),
    "Sensing and learning": ("sensing", "learning"),
    "Controllers": ("controllers", "tracking", "contraction"),
    "Deformations": ("deformation",),
    "Horizons and optimisers": ("horizon", "optimisers"),
    "Running and measuring": ("simulation", "status", "errors"),
    "Review, studies and reports": ("review", "probing", "studies", "report", "baselines", "certificate"),
}
BESIDE = ("fpirhc.conformance", "fpirhc.contraction.spectrum")  # imported from the module
MEMBERS = {"Run", "Stepper", "Simulator", "Plant", "Problem", "Plan", "figures"}  # shown with all that they have


def api() -> str:
    """The API page: every public name and every member of a family once, by section."""
    names = {*fp.__all__, *(c.__name__ for family in FAMILIES for c in member_classes(family))}
    homes: dict[str, list[str]] = {}
    for name in sorted(names, key=str.lower):
        one = getattr(fp, name)
        home = (one.__name__ if isinstance(one, ModuleType) else one.__module__).split(".")[1]
        homes.setdefault(home, []).append(name)
    lines = [
        "API",
        "===",
        "",
        "Names are imported from ``fpirhc``; docstrings give equations, shapes, units and sources.",
        "",
    ]
    for title, packages in SECTIONS.items():
        lines += [title, "-" * len(title), ""]
        lines += [line for package in packages for name in homes.pop(package, []) for line in _entry(name)]
    if homes:
        raise KeyError(f"no section of the API page has {', '.join(homes)}")
    lines += ["Beside the top level", "--------------------", ""]
    return "\n".join(lines + [line for name in BESIDE for line in (f".. automodule:: {name}", "   :members:", "")])


def _entry(name: str) -> list[str]:
    one = getattr(fp, name)
    if isinstance(one, ModuleType):
        return [f".. automodule:: {one.__name__}", *(["   :members:"] if name in MEMBERS else []), ""]
    kind = "class" if isinstance(one, type) else "function"
    return [f".. auto{kind}:: fpirhc.{name}", *(["   :members:"] if name in MEMBERS else []), ""]


def commands() -> dict[str, Any]:
    """The commands by name."""
    group: Any = typer.main.get_command(opt.app)
    return dict(group.commands)


def command_line() -> str:
    """The page of all commands with their options."""
    lines = ["# The command line", ""]
    for name in ("", *commands()):
        text = CliRunner().invoke(opt.app, [*name.split(), "--help"], prog_name="fpirhc").output.strip()
        lines += [f"## fpirhc {name}".strip(), "", "```text", text, "```", ""]
    return "\n".join(lines)


def write() -> None:
    """Write all of them."""
    pages = {"api.rst": api(), "command_line.md": command_line(), "all_problems.inc": all_problems.table()}
    for name, text in pages.items():
        (DOCS / name).write_text(text, encoding="utf-8")
