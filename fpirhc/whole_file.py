"""Files that are complete or not there: reports, results, baselines, runs; and folders that hold something or are not there."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from fpirhc.errors import OutputError


def write_whole(content: str | bytes, path: Path, what: str) -> None:
    """Write a file, atomically: a write that fails leaves what was there.

    `content`: text, written as UTF-8 with the line ends that it has, or bytes. `what`: what it is, for the error: "report".
    """
    with whole_file(path, what) as file:
        file.write(content.encode() if isinstance(content, str) else content)


@contextmanager
def whole_file(path: Path, what: str) -> Iterator[IO[bytes]]:
    """Open a file that takes the place of what was there when all of it is written; links and modes stay.

    The file beside it has a name that no other process meets: the number of a process comes again in containers.
    """
    target = path.resolve() if path.is_symlink() else path
    beside = target.with_name(f".{target.name[:40]}.{secrets.token_hex(8)}")
    try:
        handle = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        try:
            with suppress(FileNotFoundError):
                beside.chmod(target.stat().st_mode & 0o7777)
            with os.fdopen(handle, "wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            beside.replace(target)
        except BaseException:
            beside.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise OutputError(f"cannot write the {what} to '{path}': {error.strerror}") from None


def missing_folders(folder: Path) -> list[Path]:
    """Return those of a folder and its parents that are not there, the innermost first."""
    return [one for one in (folder, *folder.parents) if not one.exists()]


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove the folders that are empty, the innermost first."""
    for folder in folders:
        with suppress(OSError):  # it is not there, or holds something
            folder.rmdir()
