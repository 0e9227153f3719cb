"""A folder whose files may be run: the user's own, and writable by nobody else.

A compiled library is code. In a folder that others may write to, such as one of mode 1777, another user could leave a library with
a fitting checksum. So the folder must belong to the user and is closed to others. It is a folder of our own inside the one that the
user named, whose mode is nobody's business here; a file in it counts only where it is a regular
file of the user that nobody else may write to.
"""

from __future__ import annotations

import os
import shutil
import stat
import time
from pathlib import Path

BUILDING = "building-"  # beginning of the names of folders in which something is being compiled
_ABANDONED = 3600.0  # s; no compilation takes that long, so its process was killed


def private_folder(folder: Path) -> Path:
    """Create the folder where needed, close it to others, and remove what killed processes left behind.

    Raises:
        OSError: it cannot be made, or it belongs to another user.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    facts = folder.stat()
    if not _is_own(facts) or not _is_own(folder.lstat()):  # a link of a stranger leads to what is not meant
        raise PermissionError(f"'{folder}' belongs to another user")
    if os.name == "posix" and stat.S_IMODE(facts.st_mode) & 0o077:
        folder.chmod(0o700)
    _remove_abandoned(folder)
    return folder


def own_name() -> str:
    """Return the name of the user's folder in a folder that several users may share."""
    return f"fpirhc-{os.geteuid()}" if os.name == "posix" else "fpirhc"


def read_own(path: Path) -> bytes:
    """Return the contents of a file that nobody else can have written.

    Raises:
        OSError: it is missing, no regular file, a link, of another user, or writable by others.
    """
    # Without O_NONBLOCK the opening of a FIFO would wait for a writer.
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    with os.fdopen(os.open(path, flags), "rb") as file:
        facts = os.fstat(file.fileno())
        shared = os.name == "posix" and stat.S_IMODE(facts.st_mode) & 0o022
        if not stat.S_ISREG(facts.st_mode) or not _is_own(facts) or shared:
            raise PermissionError(f"'{path}' is no file of the user's own, or others may write to it")
        return file.read()


def _is_own(facts: os.stat_result) -> bool:
    return os.name != "posix" or facts.st_uid == os.geteuid()


def _remove_abandoned(folder: Path) -> None:
    for path in folder.glob(f"{BUILDING}*"):
        try:
            facts = path.lstat()
        except OSError:
            continue  # another process has just removed it
        if stat.S_ISDIR(facts.st_mode) and _is_own(facts) and time.time() - facts.st_mtime > _ABANDONED:
            shutil.rmtree(path, ignore_errors=True)
