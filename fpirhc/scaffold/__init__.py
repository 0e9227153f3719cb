"""Writes a problem file and its test under a new name."""

from __future__ import annotations

import keyword
import re
import sys
from importlib.machinery import PathFinder
from importlib.resources import files as resources
from pathlib import Path

from fpirhc.errors import InvalidName, OutputError, not_writable
from fpirhc.problem_files.shipped import shipped_problems

_LONGEST = 60  # characters of a name
_BETWEEN = "# ---- its test ----\n"  # of templates.txt


def create_problem(name: str, folder: Path) -> tuple[Path, Path]:
    """Write NAME.py and test_NAME.py into the folder, which is created where it is missing, and return their paths."""
    check_name(name)
    template = resources("fpirhc.scaffold").joinpath("templates.txt").read_text(encoding="utf-8")
    parts = template.replace("NAME", name).split(_BETWEEN)
    texts = dict(zip((folder / f"{name}.py", folder / f"test_{name}.py"), parts, strict=True))
    for path in texts:
        if path.exists() or path.is_symlink():
            raise OutputError(f"'{path}' exists already and is kept; choose another name or --dir")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, text in texts.items():
            path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise not_writable(folder, error, "--dir") from None
    return folder / f"{name}.py", folder / f"test_{name}.py"


def check_name(name: str) -> None:
    """Raise unless a problem can have this name."""
    usable = _usable(name)
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise InvalidName(
            f"{name[:_LONGEST]!a} is no name for a problem: it must begin with a letter and go on with letters, digits and "
            f"underscores. Try '{usable}'; a folder is given by --dir"
        )
    if len(name) > _LONGEST:
        raise InvalidName(f"a name of {len(name)} characters is too long: at most {_LONGEST}. Try '{usable}'")
    if reason := _taken(name):
        raise InvalidName(f"'{name}' cannot be the name of a problem: {reason}. Try '{usable}'")


def _taken(name: str) -> str:
    """Reason why a well-formed name cannot be used; empty for a usable name."""
    if keyword.iskeyword(name) or keyword.issoftkeyword(name):
        return "it is a word of Python"
    if re.fullmatch(r"test_.*|.*_test|test|conftest", name.lower()):
        return "pytest would take the problem file for a test"
    # Without the current folder: a problem file in it is not an installed module.
    installed = [p for p in sys.path if p and Path(p).resolve() != Path.cwd()]
    if name in sys.stdlib_module_names or PathFinder.find_spec(name, installed):
        return "a module of that name is installed, which the file would hide from everything beside it"
    if name in shipped_problems():
        return "a shipped problem has it (see 'fpirhc list')"
    return ""


def _usable(name: str) -> str:
    """A name like the given one that can be used."""
    plain = re.sub(r"[^A-Za-z0-9]+", "_", name.removesuffix(".py")).strip("_")[: _LONGEST - 8].lower()
    if not plain:
        return "my_plant"
    candidate = re.sub(r"(^|_)test$", r"\1plant", plain if plain[0].isalpha() else f"plant_{plain}")
    return f"my_{candidate}" if _taken(candidate) else candidate
