"""Imports a problem file; an error of the file names its line, its cause, and what to write instead."""

from __future__ import annotations

import ast
import contextlib
import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from fpirhc.errors import ProblemFileError
from fpirhc.problem_files.every_mistake import MistakesOfFile, cause_of, message


def imported(path: Path) -> ModuleType:
    """Return the module of a problem file.

    Raises:
        ProblemFileError: the file raises an error, or is not Python; every mistake has its line.
    """
    module = _empty(path)
    try:
        with _neighbours(path):
            assert module.__spec__ is not None
            assert module.__spec__.loader is not None
            module.__spec__.loader.exec_module(module)
    except SyntaxError as error:
        source, name = (error.text or "").strip(), Path(error.filename or path).name
        raise ProblemFileError(f"{name}, line {error.lineno}: {error.msg}\n    {source}") from None
    except SystemExit as error:
        raise ProblemFileError(message(path, error, "the file ends the program; leave the exit out")) from None
    except Exception as error:  # noqa: BLE001 -- every error of a user's file is shown with its line
        with _neighbours(path):
            every = MistakesOfFile(path, _empty(path)).text()
        raise ProblemFileError(every or message(path, error, cause_of(error))) from None
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


def _empty(path: Path) -> ModuleType:
    """The module of a file before its first line."""
    spec = importlib.util.spec_from_file_location(f"fpirhc_problem_{path.stem}", path)
    if spec is None:
        raise ProblemFileError(f"'{path}' is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    return module


@contextlib.contextmanager
def _neighbours(path: Path) -> Iterator[None]:
    """Let a file import the modules beside it, as a program can; libraries come first.

    The modules are forgotten afterwards: another folder may have others of the same name.
    """
    folder, before = str(path.resolve().parent), set(sys.modules)
    sys.path.append(folder)
    try:
        yield
    finally:
        sys.path.remove(folder)
        for name in set(sys.modules) - before:
            file = getattr(sys.modules[name], "__file__", None)
            if file and Path(file).parent == Path(folder) and not name.startswith("fpirhc_problem_"):
                del sys.modules[name]
