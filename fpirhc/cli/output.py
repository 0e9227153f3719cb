"""Where a command writes its results."""

from __future__ import annotations

from pathlib import Path


def results_folder(wanted: str | None, *default: str) -> Path:
    """Return the folder for results, `results/DEFAULT...` when none is wanted, made before anything runs.

    Raises:
        OutputError: it cannot be written.
    """
    return output_folder(Path(wanted) if wanted else Path("results", *default))


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
