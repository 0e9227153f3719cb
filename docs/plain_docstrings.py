"""A Sphinx extension for docstrings in plain text: indented formulas stay as they are, and no character is markup.

The docstrings of this project are written to be read in an editor. Before Napoleon reads their sections, this turns every indented
block into a literal one and escapes what reStructuredText would take for markup.
"""

from __future__ import annotations

import re
from typing import Any

_SECTION = re.compile(r"^(Args|Parameters|Raises|References|Returns|Yields|Note|Example|Examples):$")


def rewritten(lines: list[str]) -> list[str]:
    """Return the lines as reStructuredText in Napoleon's Google style."""
    out: list[str] = []
    literal = section = False
    for number, line in enumerate(lines):
        indent = len(line) - len(line.lstrip())
        if not line.strip():
            out.append("")
            continue
        if _SECTION.match(line.strip()) and indent == 0:
            section, literal = True, False
            out.append(line)
            continue
        if indent == 0:
            section = literal = False
        begins = number > 0 and not lines[number - 1].strip()
        if not section and indent >= 4 and (literal or begins):
            if not literal:
                out += ["::", ""]
            literal = True
            out.append(line)
            continue
        literal = False
        out.append(_escaped(line))
    return out


def _escaped(line: str) -> str:
    """Backquoted words become literals; everything else that could be markup is escaped."""
    parts = re.split(r"(`[^`]+`)", line)
    return "".join(f"`{p}`" if p.startswith("`") and len(p) > 2 else re.sub(r"([*|_\\])", r"\\\1", p) for p in parts)


def _process(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:  # noqa: ARG001
    lines[:] = rewritten(lines)


def setup(app: Any) -> dict[str, Any]:
    """Connect before Napoleon, whose priority is 500."""
    app.connect("autodoc-process-docstring", _process, priority=100)
    return {"parallel_read_safe": True}
