"""The folders to which commands write their results."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fpirhc.cli.crash import interrupted

RESULTS = "results.json"  # what --json prints, beside every report


def results_folder(wanted: str | None, *default: str) -> Path:
    """Return the folder for results, created before anything runs.

    Args:
        wanted: path of the folder; None: `results/DEFAULT...`.
        default: parts of the default path.

    Raises:
        OutputError: the folder cannot be written.
    """
    return output_folder(Path(wanted) if wanted else Path("results", *default))


def output_folder(folder: Path) -> Path:
    """Create a folder for results before anything runs, so that a wrong path fails at once.

    Raises:
        OutputError: the folder cannot be written.
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


@contextmanager
def resumable(ledger: Path) -> Iterator[None]:
    """Print, after an interruption from the keyboard, where the finished results are."""
    try:
        yield
    except BaseException as error:
        if not interrupted(error):
            raise
        print(f"fpirhc: finished results are kept in {ledger}; the same command continues from them", file=sys.stderr)
        raise
