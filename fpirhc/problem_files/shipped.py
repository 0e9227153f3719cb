"""Where problem files are, without running one: the shipped ones by name, a user's one by its path."""

from __future__ import annotations

import ast
from pathlib import Path

from fpirhc.errors import ProblemFileError, nearest


def shipped_folders() -> list[Path]:
    """Folders of shipped problems, inside the installed package or beside it in a checkout, each with its gallery."""
    package = Path(__file__).resolve().parents[1]
    places = (package / "_problems", package.parent / "problems")
    return [f for place in places for f in (place, place / "gallery") if f.is_dir()]


def shipped_problems() -> dict[str, Path]:
    """Return the shipped problems: name -> path."""
    paths: dict[str, Path] = {}
    for folder in shipped_folders():
        for path in sorted(folder.glob("*.py")):
            if not path.name.startswith("_"):
                paths.setdefault(path.stem, path)
    return paths


def title_of(path: Path) -> str:
    """First line of a problem file's docstring, without running the file."""
    try:
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
    except (OSError, SyntaxError, ValueError):
        return ""
    return (text or "").strip().partition("\n")[0]


def find_problem(name_or_path: str) -> Path:
    """Return the path of a shipped problem or of a user's file.

    Raises:
        ProblemFileError: there is no such file or problem; the nearest shipped name is offered.
    """
    path = Path(name_or_path)
    if path.suffix == ".py" or path.parent != Path():
        if path.is_file():
            return path
        raise ProblemFileError(
            f"no file at '{name_or_path}'; give the path of a problem file, or a name from 'fpirhc list'"
        )
    shipped = shipped_problems()
    if name_or_path in shipped:
        return shipped[name_or_path]
    raise ProblemFileError(f"problem '{name_or_path}' is unknown.{nearest(name_or_path, shipped)}")
