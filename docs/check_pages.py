"""What pages say is so: their code runs as printed, their commands are those of the command line, links lead somewhere."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import made_pages

DOCS = Path(__file__).resolve().parent
MADE = {"command_line.md"}  # when the site is built
PAGES = [page for page in sorted(DOCS.glob("*.md")) if page.name not in MADE]
TEXTS = [*PAGES, *(DOCS.parent / name for name in ("README.md", "CONTRIBUTING.md"))]


def blocks(page: Path) -> list[str]:
    """The blocks of Python on a page."""
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


def run_code(page: Path) -> None:
    """Run the blocks of a page one after the other, as a reader would paste them, in an empty folder.

    Where a block has `from NAME import *`, the blocks since the last file are NAME.py.
    """
    pasted: list[str] = []
    names: dict[str, object] = {"__name__": "__main__"}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()):
        sys.path.insert(0, folder)
        for block in blocks(page):
            for name in re.findall(r"^from (\w+) import \*$", block, re.MULTILINE):
                if not Path(f"{name}.py").exists():
                    Path(f"{name}.py").write_text("\n".join(pasted), encoding="utf-8")
                    pasted = []
            pasted.append(block)
            exec(compile(block, str(page), "exec"), names)
        sys.path.remove(folder)


def wrong_commands(page: Path) -> Iterator[str]:
    """Lines of `fpirhc` whose command, options or arguments are not there."""
    commands = made_pages.commands()
    for line in re.findall(r"^ {4}(?:\.venv/bin/)?fpirhc (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE):
        name, *words = shlex.split(line, comments=True)
        try:
            commands[name].make_context(name, words)
        except Exception as error:  # noqa: BLE001 -- of whatever kind, it is a mistake of the page
            yield f"{page.name}: fpirhc {line}: {error}"


def wrong_links(page: Path) -> Iterator[str]:
    """Relative links to files and headings that are not there; the gallery is made of its scripts."""
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text(encoding="utf-8")):
        path, _, place = target.partition("#")
        if "://" in target or path in MADE:
            continue
        file = page.parent / path if path else page
        if not file.exists() and not (DOCS / "gallery_src" / f"{Path(path).name}.py").exists():
            yield f"{page.name}: {target}"
        elif place:
            heads = re.findall(r"^#+ (.+)$", file.read_text(encoding="utf-8"), re.MULTILINE)
            if place not in {re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads}:
                yield f"{page.name}: {target}"


def main() -> int:
    """Check all pages; the exit code is 1 where one is wrong."""
    wrong = [text for page in TEXTS for text in (*wrong_commands(page), *wrong_links(page))]
    architecture = (DOCS / "architecture.md").read_text(encoding="utf-8")
    files = re.findall(r"`(fpirhc/[\w/]*\.py)`", architecture)
    wrong += [f"architecture.md: {file}" for file in files if not (DOCS.parent / file).is_file()]
    for page in TEXTS:
        run_code(page)
    print(*wrong, sep="\n")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
