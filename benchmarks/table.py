"""Prints a benchmark's table, and writes it into a page of docs/ when asked with --write."""

from __future__ import annotations

import platform
import re
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

PAGE = Path(__file__).resolve().parents[1] / "docs" / "performance.md"


def write_table(name: str, heads: Sequence[str], rows: Sequence[Sequence[str]], path: Path = PAGE) -> None:
    """Print the table; with --write, replace the part of the page between the marks of this name."""
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    packages = {name: version(name) for name in ("fpirhc", "casadi", "numpy", "scipy")}
    versions = {**packages, "python": platform.python_version(), "machine": platform.machine()}
    lines += ["", f"{_processor()}; " + ", ".join(f"{k} {v}" for k, v in versions.items()) + "."]
    text = "\n".join(lines)
    print(text)
    if "--write" in sys.argv:
        begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
        page = path.read_text(encoding="utf-8")
        pattern = re.compile(re.escape(begin) + ".*?" + re.escape(end), re.DOTALL)
        if not pattern.search(page):
            sys.exit(f"{path} has no marks '{begin}' ... '{end}'")
        path.write_text(pattern.sub(lambda _: f"{begin}\n{text}\n{end}", page), encoding="utf-8")


def _processor() -> str:
    facts = Path("/proc/cpuinfo")
    named = re.search(r"model name\s*: (.+)", facts.read_text(encoding="utf-8")) if facts.exists() else None
    return named[1] if named else platform.processor() or platform.machine()
