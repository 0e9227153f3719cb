"""Libraries that another user may have planted in the cache: none of them is run."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import casadi as ca
import numpy as np

from fpirhc.symbolic import native as module
from fpirhc.symbolic.native import native


def _open_file(path: Path) -> None:
    path.chmod(0o777)


def _open_group(path: Path) -> None:
    path.chmod(0o775)


def _open_sum(path: Path) -> None:
    path.with_suffix(".sha256").chmod(0o666)


def _link(path: Path) -> None:
    hidden = path.with_name("elsewhere")
    path.rename(hidden)
    path.symlink_to(hidden)


def _linked_sum(path: Path) -> None:
    checksum = path.with_suffix(".sha256")
    hidden = checksum.with_name("elsewhere.sha256")
    checksum.rename(hidden)
    checksum.symlink_to(hidden)


def _pipe(path: Path) -> None:
    path.with_suffix(".sha256").unlink()
    os.mkfifo(path.with_suffix(".sha256"))


def _owner(path: Path) -> None:
    if os.geteuid() == 0:  # only root can give a file away
        os.chown(path, 65534, 65534)
    else:
        path.chmod(0o777)


WAYS: dict[str, Callable[[Path], None]] = {
    "library writable by all": _open_file,
    "library writable by the group": _open_group,
    "checksum writable by all": _open_sum,
    "library is a link": _link,
    "checksum is a link": _linked_sum,
    "checksum is a pipe": _pipe,
    "library of another user": _owner,
}


def planted_and_run(folder: Path) -> dict[str, bool]:
    """Whether the code of a stranger ran, by the way in which it was planted."""
    return {way: _runs(folder / str(k), change) for k, (way, change) in enumerate(WAYS.items())}


def _runs(cache: Path, change: Callable[[Path], None]) -> bool:
    with _cache(cache):
        for factor in (7.0, 8.0):
            assert native(_model(factor)).compiled
        mine, stranger = sorted(cache.rglob("*.so"), key=lambda p: p.stat().st_mtime_ns)
        mine.unlink()
        mine.write_bytes(stranger.read_bytes())
        mine.with_suffix(".sha256").write_bytes(stranger.with_suffix(".sha256").read_bytes())
        change(mine)
        module._loaded.clear()
        result = native(_model(7.0)).function(np.ones(3)).full()
    return not np.array_equal(result, _model(7.0)(np.ones(3)).full())


def _model(factor: float) -> ca.Function:
    x = ca.SX.sym("x", 3)
    return ca.Function("fpirhc_planted", [x], [factor * x])


@contextmanager
def _cache(folder: Path) -> Iterator[None]:
    before = os.environ.get("FPIRHC_CACHE")
    os.environ["FPIRHC_CACHE"] = str(folder)
    module._loaded.clear()
    try:
        yield
    finally:
        module._loaded.clear()
        if before is None:
            del os.environ["FPIRHC_CACHE"]
        else:
            os.environ["FPIRHC_CACHE"] = before
