"""Random command lines, run in this process: an exit code as documented, one line for a mistake, and no traceback."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from attack.problems import LINE


@contextlib.contextmanager
def prepared(folder: Path) -> Iterator[None]:
    """A working folder with a good problem, a broken one and an empty one; commands find no compiler there."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "line.py").write_text(LINE, encoding="utf-8")
    (folder / "broken.py").write_text("plant = (", encoding="utf-8")
    (folder / "empty.py").write_text("", encoding="utf-8")
    (folder / "file").write_text("no folder", encoding="utf-8")
    before, compiler = Path.cwd(), os.environ.get("FPIRHC_CC")
    os.environ["FPIRHC_CC"] = "none"
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)
        if compiler is None:
            del os.environ["FPIRHC_CC"]
        else:
            os.environ["FPIRHC_CC"] = compiler
