"""The file of a saved run: a zip of the log and its facts, written at once or not at all, and read with a schema.

The log is a numpy array and the facts are JSON, so that reading a file of somebody else never runs its code.
"""

from __future__ import annotations

import io
import json
import os
import stat
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fpirhc.errors import FpirhcError, OutputError
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Positive
from fpirhc.simulation.common_columns import with_common_columns
from fpirhc.simulation.log import Log
from fpirhc.symbolic.layout import Layout, Signal
from fpirhc.whole_file import write_whole

FORMAT = 1
MOST = 2**34  # bytes of an unpacked file; a small file that unpacks to more is no run
LARGEST_FACTS = 2**26  # bytes of the facts


@dataclass(frozen=True, eq=False)
class Facts(Checked):
    """What a file says about its run besides the log; the fields are those of `Run`, the signals (name, elements, units)."""

    format: int
    problem: str
    controller: str
    seed: int
    period: Positive
    stop: str | None
    compiled: bool
    settings: Mapping[str, object]
    signals: Sequence[tuple[str, Sequence[str], Sequence[str]]]


def save(run: Log, path: Path) -> None:
    """Write the file: beside its place first, then under its name, so that a broken write leaves an earlier file as it was.

    Raises:
        OutputError: the place cannot be written, or is a symbolic link or no ordinary file.
    """
    facts = {
        "format": FORMAT,
        "problem": run.problem,
        "controller": run.controller,
        "seed": run.seed,
        "period": run.period,
        "stop": run.stop,
        "compiled": run.compiled,
        "settings": run.settings,
        "signals": [[s.name, list(s.elements), list(s.units)] for s in run.layout.signals],
    }
    content = io.BytesIO()
    np.savez_compressed(content, log=run.log, facts=np.array(json.dumps(facts)))
    if path.is_symlink() or (path.exists() and not path.is_file()):
        raise OutputError(f"cannot write the run to '{path}': it is a link or no ordinary file; give another path")
    write_whole(content.getvalue(), path, "run")


def read(path: Path) -> tuple[Facts, Layout, np.ndarray]:
    """Return facts, layout and log of a file, with columns that a file of an older version lacks.

    Raises:
        OutputError: the file is missing, damaged, of another format, or no file of a run.
    """
    try:
        log, stored = _parts(path)
        facts = _facts(stored)
        layout, log = with_common_columns(_layout(facts, log), log)
    except OutputError as error:
        raise OutputError(f"cannot read a run from '{path}': {error}") from None
    except FpirhcError as error:
        raise OutputError(f"cannot read a run from '{path}': {getattr(error, 'text', error)}") from None
    except (Exception, MemoryError) as error:  # noqa: BLE001 -- a hostile file can raise anything in the readers of zip and JSON
        text = str(getattr(error, "strerror", None) or error).partition("\n")[0][:200]
        raise OutputError(f"cannot read a run from '{path}': {text or type(error).__name__}") from None
    log.setflags(write=False)
    return facts, layout, log


def _parts(path: Path) -> tuple[np.ndarray, object]:
    """The log and the facts of a file, every byte of them checked against the sums of the zip."""
    # A pipe would wait for ever to be opened.
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    with os.fdopen(handle, "rb") as file:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise OutputError("it is no ordinary file")
        with zipfile.ZipFile(file) as stored:
            sizes = {one.filename: one.file_size for one in stored.infolist()}
            for name, most in (("log.npy", MOST), ("facts.npy", LARGEST_FACTS)):
                if name not in sizes:
                    raise OutputError(f"it has no '{name}'")
                if sizes[name] > most:
                    raise OutputError(f"'{name}' unpacks to {sizes[name]} bytes")
            log, facts = (_array(stored.read(name)) for name in ("log.npy", "facts.npy"))
    if facts.dtype.kind != "U" or facts.ndim != 0:
        raise OutputError("its facts are no text")
    return log, json.loads(str(facts))


def _array(content: bytes) -> np.ndarray:
    return np.asarray(np.lib.format.read_array(io.BytesIO(content), allow_pickle=False))


def _facts(stored: object) -> Facts:
    if not isinstance(stored, dict):
        raise OutputError("its facts are no mapping")
    if stored.get("format") != FORMAT:
        raise OutputError(f"it has format {stored.get('format')!r}, this version reads {FORMAT}")
    return Facts(**stored)


def _layout(facts: Facts, log: np.ndarray) -> Layout:
    layout = Layout(tuple(Signal(name, tuple(elements), tuple(units)) for name, elements, units in facts.signals))
    if log.dtype != np.float64 or log.ndim != 2 or log.shape[1] != layout.size:
        raise OutputError(f"its log has shape {log.shape} of {log.dtype}, its signals need {layout.size} columns")
    if "time" not in layout or layout["time"].size != 1:
        raise OutputError("it has no signal 'time'")
    if any(len(s.units) not in (0, 1, s.size) for s in layout.signals):
        raise OutputError("the elements and the units of a signal differ in number")
    return layout
