"""Where problem files are, without running one: the shipped ones by name, a user's one by its path."""

from __future__ import annotations

import ast
from difflib import get_close_matches
from importlib.util import find_spec
from os.path import exists, isdir, isfile
from pathlib import Path
from typing import Any

from fpirhc.errors import ProblemFileError

GROUPS = {"first examples": "", "gallery": "gallery", "plants of other packages": "outside"}  # title -> subfolder
_OFFERED = 4  # files of a folder that a message names


def shipped_folders() -> list[Path]:
    """Folders of shipped problems, inside the installed package or beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    return [folder for folder in (package / "_problems", package.parent / "problems") if folder.is_dir()]


def shipped_groups() -> dict[str, dict[str, Path]]:
    """Return the shipped problems by group, name -> path: first examples, the gallery, and those of other packages' plants."""
    groups: dict[str, dict[str, Path]] = {title: {} for title in GROUPS}
    for title, subfolder in GROUPS.items():
        for path in (path for folder in shipped_folders() for path in sorted((folder / subfolder).glob("[!_]*.py"))):
            groups[title].setdefault(path.stem, path)
    return groups


def shipped_problems() -> dict[str, Path]:
    """Return the shipped problems that need no other package: name -> path."""
    return {name: path for group in shipped_groups().values() for name, path in group.items() if not needed(path)}


def needed(path: Path) -> tuple[str, ...]:
    """Packages that a problem file needs, its line `needs = ("mujoco",)`, without running the file."""
    return tuple(map(str, stated(path, "needs", ())))


def stated(path: Path, name: str, without: Any) -> Any:
    """Literal value of a name of a problem file, such as `why`, without running the file; `without`: where there is none."""
    try:
        text = path.read_text(encoding="utf-8")
        body = ast.parse(text).body if f"\n{name} " in f"\n{text}" else []
        values = [s.value for s in body if isinstance(s, ast.Assign) and ast.unparse(s.targets[0]) == name]
        return ast.literal_eval(values[0]) if values else without
    except (OSError, SyntaxError, ValueError, TypeError):
        return without


def problem_files(folder: Path) -> list[Path]:
    """Return the files of a folder that define `controllers` outside every function, without running them."""
    every = (one for one in sorted(folder.glob("*.py")) if isfile(one))
    return [one for one in every if "\ncontrollers" in one.read_text(encoding="utf-8", errors="replace")]


def missing(path: Path) -> str:
    """Say which packages of a problem file are not installed, and how they are; empty where none is missing."""
    names = [name for name in needed(path) if find_spec(name) is None]
    return f"it needs {', '.join(names)}: pip install 'fpirhc[outside]'" if names else ""


def title_of(path: Path) -> str:
    """First line of a shipped problem's docstring, without running or parsing the file."""
    with path.open(encoding="utf-8") as file:
        quotes, _, rest = file.readline().strip().partition('"""')
    return "" if quotes else rest.removesuffix('"""')


def find_problem(name_or_path: str) -> Path:
    """Return the path of a shipped problem or of a user's file."""
    path = Path(name_or_path)
    shipped = {name: path for group in shipped_groups().values() for name, path in group.items()}
    if path.suffix == ".py" and isfile(path):  # not the path's own method, which raises for a name that is too long
        return path
    if name_or_path in shipped:
        return shipped[name_or_path]
    beside = [str(one) for one in sorted(path.parent.glob("*.py")) if isfile(one)]
    if exists(path):
        such = [*map(str, problem_files(path))] if isdir(path) else []
        what = "a folder" if isdir(path) else "not a Python file"
        first = f"; it has {len(such)}, such as {', '.join(such[:_OFFERED])}" if such else ""
        raise ProblemFileError(f"'{name_or_path}' is {what}; a problem file ends in .py{first}")
    is_path = path.suffix or path.parent != Path()
    named = f"no file at '{name_or_path}'" if is_path else f"problem '{name_or_path}' is unknown"
    near = get_close_matches(name_or_path, beside, n=1) if path.suffix else [n for n in beside if n == f"{path}.py"]
    near = near or get_close_matches(path.stem, shipped, n=1, cutoff=0.5)
    here = [] if near else [str(one) for one in problem_files(path.parent)[:_OFFERED]]
    hint = f" Did you mean '{near[0]}'?" if near else f" Problem files there: {', '.join(here)}." * bool(here)
    raise ProblemFileError(f"{named}.{hint} Give the path of a problem file, or a name from 'fpirhc list'")
