"""Where a user's own code called the library."""

from __future__ import annotations

import sys
from pathlib import Path
from types import FrameType

_PACKAGE = str(Path(__file__).resolve().parents[1])
_PROBLEMS = str(Path(_PACKAGE) / "_problems")  # shipped problems of an installed package are read as a user's files


def users_place() -> str:
    """Return "file.py, line 12" of the innermost call from outside the package; empty where there is none."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        if is_users(frame.f_code.co_filename):
            return f"{Path(frame.f_code.co_filename).name}, line {frame.f_lineno}"
        frame = frame.f_back
    return ""


def is_users(filename: str) -> bool:
    """Whether a file of code belongs neither to the package nor to the libraries around it."""
    if filename.startswith(_PACKAGE) and not filename.startswith(_PROBLEMS):
        return False
    return filename.endswith(".py") and not filename.startswith(_LIBRARIES)


_LIBRARIES = (str(Path(sys.prefix) / "lib"), str(Path(sys.base_prefix) / "lib"), "<")
