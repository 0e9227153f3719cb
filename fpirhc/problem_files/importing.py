"""Imports a problem file; an error of the file names its line, its cause, and what to write instead."""

from __future__ import annotations

import ast
import importlib.util
import sys
import traceback
from pathlib import Path
from types import ModuleType

from fpirhc.errors import FpirhcError, InvalidField, ProblemFileError
from fpirhc.fields.user_code import explained


def imported(path: Path) -> ModuleType:
    """Return the module of a problem file.

    Raises:
        ProblemFileError: the file raises an error, or is not Python; the message has the line.
    """
    spec = importlib.util.spec_from_file_location(f"fpirhc_problem_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ProblemFileError(f"'{path}' is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        source = (error.text or "").strip()
        raise ProblemFileError(f"{path.name}, line {error.lineno}: {error.msg}\n    {source}") from None
    except SystemExit as error:
        raise ProblemFileError(f"{_own_line(path, error)}\n    the file ends the program; leave the exit out") from None
    except Exception as error:  # noqa: BLE001 -- every error of a user's file is shown with its line
        raise ProblemFileError(f"{_own_line(path, error)}\n    {_cause(error)}") from None
    return module


def line_of(module: ModuleType, name: str) -> str:
    """Return "line 12: " of the last assignment of a name in a module's file; empty where there is none."""
    try:
        tree = ast.parse(Path(module.__file__ or "").read_text(encoding="utf-8"))
    except (OSError, SyntaxError, ValueError):
        return ""
    lines = [
        target.lineno
        for node in tree.body
        for target in (node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)])
        if isinstance(target, ast.Name) and target.id == name
    ]
    return f"line {lines[-1]}: " if lines else ""


def _cause(error: Exception) -> str:
    if isinstance(error, InvalidField):
        return error.text.lstrip()
    if isinstance(error, FpirhcError):
        return str(error)
    cause = explained(error)
    if not cause.startswith(type(error).__name__):
        return cause
    # Python's own last line also has the nearest name that it knows.
    return "".join(traceback.TracebackException.from_exception(error).format_exception_only()).strip()


def _own_line(path: Path, error: BaseException) -> str:
    """The last line of the user's file in the traceback."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if Path(f.filename).resolve() == path.resolve()]
    if not frames:
        return path.name
    return f"{path.name}, line {frames[-1].lineno}: {frames[-1].line}"
