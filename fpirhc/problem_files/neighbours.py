"""Modules beside a problem file that it imports, and those that these import."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path


def neighbours(path: Path) -> dict[str, bytes]:
    """Return the content of the modules of a problem file's own folder that it imports, by name and in order of names.

    The statements are read and not run: what other problem files have imported does not count.
    """
    found: dict[str, bytes] = {}
    waiting = [path]
    while waiting:
        for name in _imported(waiting.pop()):
            file = _file(path.parent, name)
            if name not in found and file is not None and file != path:
                found[name] = file.read_bytes()
                waiting.append(file)
    return dict(sorted(found.items()))


def _imported(file: Path) -> Iterator[str]:
    """Names of modules, and of what is taken from them, which may be modules too."""
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.Import):
            for one in node.names:
                yield from _with_packages(one.name)
        elif isinstance(node, ast.ImportFrom):
            yield from _with_packages(node.module or "")
            yield from (f"{node.module}.{one.name}" for one in node.names)


def _with_packages(name: str) -> Iterator[str]:
    """A dotted name and the packages around it, all of which are run."""
    parts = name.split(".")
    yield from (".".join(parts[: k + 1]) for k in range(len(parts)) if parts[0])


def _file(folder: Path, name: str) -> Path | None:
    at = folder.joinpath(*name.split("."))
    return next((file for file in (at.with_suffix(".py"), at / "__init__.py") if file.is_file()), None)
