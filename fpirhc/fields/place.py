"""Where a user's own code called the library."""

from __future__ import annotations

import sys
from pathlib import Path
from types import FrameType

_PACKAGE = str(Path(__file__).resolve().parents[1])
_PROBLEMS = str(Path(_PACKAGE) / "_problems")  # shipped problems of an installed package are read as a user's files


def users_place() -> str:
    """Return "file.py, line 12" of the innermost call from outside the package; empty where there is none."""
    _, frame = _users_frame(sys._getframe(1))
    return f"{Path(frame.f_code.co_filename).name}, line {frame.f_lineno}" if frame else ""


def users_level() -> int:
    """Return the `stacklevel` with which a warning by the caller of this function stands at the user's line."""
    depth, frame = _users_frame(sys._getframe(1))
    return depth + 1 if frame else 1


def _users_frame(frame: FrameType | None) -> tuple[int, FrameType | None]:
    """The innermost frame of a user's code from this one on, and how many calls it is away."""
    depth = 0
    while frame is not None and not is_users(frame.f_code.co_filename):
        frame, depth = frame.f_back, depth + 1
    return depth, frame


def is_users(filename: str) -> bool:
    """Whether a file of code belongs neither to the package nor to the libraries around it."""
    if filename.startswith(_PACKAGE) and not filename.startswith(_PROBLEMS):
        return False
    return filename.endswith(".py") and not filename.startswith(_LIBRARIES)


_LIBRARIES = (str(Path(sys.prefix) / "lib"), str(Path(sys.base_prefix) / "lib"), "<")
