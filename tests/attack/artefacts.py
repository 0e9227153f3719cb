"""Attacks on files that are read again: one flipped bit in a saved run, a ledger, or a baseline.

A reader must refuse the file by name, or give exactly what was written. (`results.json` is written and read by nothing.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import fpirhc as fp
from attack.problems import line_task
from fpirhc.errors import FpirhcError

Read = Callable[[Path], object]


@dataclass(frozen=True)
class Flips:
    """What came of the flipped bits of one artefact.

    Args:
        tried: number of flips.
        raw: errors that are none of fpirhc's, each in words.
        unnoticed: flips after which the reader gives something else than was written.
    """

    tried: int
    raw: tuple[str, ...]
    unnoticed: int


def _run_file(folder: Path) -> tuple[Path, Read]:
    problem, controllers = line_task()
    path = folder / "run.npz"
    fp.simulate(problem, controllers["CTC+FPI"], seed=0, compiled=False).save(path)

    def read(path: Path) -> object:
        run = fp.load_run(path)
        run.to_dict() if hasattr(run, "to_dict") else None
        facts = (run.problem, run.controller, run.seed, run.period, run.stop, run.compiled, repr(run.settings))
        return run.log.tobytes(), run.layout.columns, run.layout.units, facts

    return path, read


ARTEFACTS: dict[str, Callable[[Path], tuple[Path, Read]]] = {"saved run": _run_file}


def flipped(name: str, folder: Path, count: int, *, seed: int) -> Flips:
    """Flip one bit at a time and read the file again."""
    folder.mkdir(parents=True, exist_ok=True)
    path, read = ARTEFACTS[name](folder)
    whole, generator = path.read_bytes(), np.random.default_rng(seed)
    written, raw, unnoticed = read(path), [], 0
    for place in generator.integers(0, 8 * len(whole), size=count):
        damaged = bytearray(whole)
        damaged[place // 8] ^= 1 << (place % 8)
        path.write_bytes(damaged)
        try:
            unnoticed += read(path) != written and not _torn(name, damaged, whole)
        except FpirhcError:
            pass
        except Exception as error:  # noqa: BLE001 -- what is looked for
            raw.append(f"{name}, bit {place}: {type(error).__name__}: {error}")
    return Flips(count, tuple(raw), unnoticed)


def _torn(name: str, damaged: bytearray, whole: bytes) -> bool:
    """Whether the end of a ledger's last line is lost: then its record was never acknowledged, and is computed again."""
    return name == "ledger of a study" and damaged[-1:] != whole[-1:]
