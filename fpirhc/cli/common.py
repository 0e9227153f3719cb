"""What commands share."""

from __future__ import annotations

from pathlib import Path


def output_folder(folder: Path) -> Path:
    """Create a folder for results before anything runs, so that a wrong path fails at once.

    Raises:
        OutputError: it cannot be written.
    """
    from fpirhc.errors import OutputError

    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".fpirhc-probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise OutputError(
            f"cannot write to the folder '{folder}': {error.strerror}; choose another with --out"
        ) from None
    return folder
