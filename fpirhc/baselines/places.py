"""Paths of baselines: `baselines/NAME.json` beside the problem file NAME.py, and the problems that need one.

They stand beside the problem, so that both change in the same review and move together. The file `unchecked.toml` in a folder
`baselines` names the problems without a baseline, each with the reason: `chain_of_masses = "takes a minute"`.
"""

from __future__ import annotations

import ast
import tomllib
from pathlib import Path

from fpirhc.errors import BaselineError, OutputError
from fpirhc.problem_files.shipped import missing

FOLDER, UNCHECKED = "baselines", "unchecked.toml"


def baseline_path(problem: Path, folder: Path | None = None) -> Path:
    """Return the path of the baseline of a problem file; `folder` replaces the folder `baselines` beside it."""
    return (folder or problem.parent / FOLDER) / f"{problem.stem}.json"


def problems_here(folder: Path, baselines: Path | None = None) -> tuple[list[Path], dict[str, str]]:
    """Return the problem files to check, and the names of those that are left out on purpose, with their reasons.

    The files are those of `folder/problems` and of the folders in it if there is such a folder, else of `folder` itself. A file
    that defines `problem` and `controllers` counts, and every name of a baseline, so that a problem that vanished is noticed.
    """
    place = folder / "problems" if (folder / "problems").is_dir() else folder
    places = [place, *(_inner(place) if place != folder else ())]
    folders = [baselines] if baselines else [p / FOLDER for p in places]
    named: dict[str, Path] = {}
    for path in (f for p in places for f in sorted(p.glob("*.py")) if _is_problem(f)):
        named.setdefault(path.stem, path)
    for path in (f for h in folders for f in sorted(h.glob("*.json"))):
        named.setdefault(path.stem, (place if baselines else path.parents[1]) / f"{path.stem}.py")
    listed = {name: reason for h in folders for name, reason in _unchecked(h / UNCHECKED).items()}
    for name in listed:
        if name not in named:
            raise BaselineError(f"{UNCHECKED} names '{name}', which is no problem in '{place}'; take it out")
        if baseline_path(named[name], baselines).exists():
            raise BaselineError(f"{UNCHECKED} names '{name}', which has a baseline; take it out")
    unchecked = {name: why for name, path in named.items() if (why := missing(path))} | listed
    to_check = [path for name, path in sorted(named.items()) if name not in unchecked]
    if not to_check:
        raise BaselineError(f"no problem to check in '{place}'; name one, or go to the folder that has 'problems'")
    return to_check, unchecked


def _inner(place: Path) -> list[Path]:
    """Folders in a folder of problems that hold problems themselves."""
    return [f for f in sorted(place.iterdir()) if f.is_dir() and any(_is_problem(p) for p in f.glob("*.py"))]


def _is_problem(path: Path) -> bool:
    """Whether the file defines problem and controllers, judged without running it; a file with a mistake counts."""
    try:
        body = ast.parse(path.read_text(encoding="utf-8")).body
    except (OSError, SyntaxError, ValueError):
        return True
    inside = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    nodes = [node for s in body if not isinstance(s, inside) for node in ast.walk(s)]
    defined = {n.id for n in nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    defined |= {n.asname or n.name for n in nodes if isinstance(n, ast.alias)}
    return {"problem", "controllers"} <= defined


def _unchecked(path: Path) -> dict[str, str]:
    try:
        facts = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise BaselineError(f"'{path}' cannot be read: {error}") from None
    for name, reason in facts.items():
        if not isinstance(reason, str) or not reason.strip():
            raise BaselineError(f"'{path}': '{name}' needs a reason in quotes")
    return facts


def check_inside(path: Path, working: Path) -> None:
    """Raise unless `path` lies in the project: the nearest folder above `working` with .git or pyproject.toml, or `working`."""
    working = working.resolve()
    marks = (".git", "pyproject.toml")
    root = next((f for f in (working, *working.parents) if any((f / m).exists() for m in marks)), working)
    if not path.resolve().is_relative_to(root):
        raise OutputError(
            f"'{path}' lies outside of the project '{root}' and is not written; "
            "go to the problem's own project, or give --baselines FOLDER"
        )
    there = next(one for one in path.resolve().parents if one.exists())
    if not there.is_dir():
        raise OutputError(f"cannot write '{path}': '{there}' is a file; give another folder by --baselines")
