"""Where problem files are, without running one: the shipped ones by name, a user's one by its path."""

from __future__ import annotations

import ast
from difflib import get_close_matches
from pathlib import Path

from fpirhc.errors import ProblemFileError

_OFFERED = 4  # files of a folder that a message names


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
    path, shipped = Path(name_or_path), shipped_problems()
    if path.suffix == ".py" and path.is_file():
        return path
    if name_or_path in shipped:
        return shipped[name_or_path]
    if path.exists():
        what = "a folder" if path.is_dir() else "not a Python file"
        raise ProblemFileError(f"'{name_or_path}' is {what}; a problem file ends in .py{_files_in(path)}")
    if path.with_suffix(".py").is_file():
        raise ProblemFileError(f"problem '{name_or_path}' is unknown; for the file write '{path.with_suffix('.py')}'")
    beside = [str(one) for one in sorted(path.parent.glob("*.py"))] if path.suffix == ".py" else []
    what = (
        f"no file at '{name_or_path}'"
        if path.suffix or path.parent != Path()
        else f"problem '{name_or_path}' is unknown"
    )
    near = get_close_matches(name_or_path, beside, n=1) or get_close_matches(path.stem, shipped, n=1, cutoff=0.5)
    hint = f" Did you mean '{near[0]}'?" if near else ""
    raise ProblemFileError(f"{what}.{hint} Give the path of a problem file, or a name from 'fpirhc list'")


def _files_in(folder: Path) -> str:
    """Python files of a folder, as an offer."""
    files = [str(one) for one in sorted(folder.glob("*.py"))][:_OFFERED] if folder.is_dir() else []
    return f", such as {', '.join(files)}" if files else ""
