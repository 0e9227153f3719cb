"""Files that are complete or not there: reports, results, baselines, runs."""

from __future__ import annotations

import os
from pathlib import Path

from fpirhc.errors import OutputError


def write_whole(content: str | bytes, path: Path, what: str) -> None:
    """Write a file, atomically: a write that fails leaves what was there.

    `content`: text, written as UTF-8 with the line ends that it has, or bytes. `what`: what it is, for the error: "report".
    """
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        handle = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
                file.flush()
                os.fsync(file.fileno())
            beside.replace(path)
        except BaseException:
            beside.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise OutputError(f"cannot write the {what} to '{path}': {error.strerror}") from None
