"""Attacks on files that are read again: a reader refuses one with a flipped bit by name, or gives exactly what was written."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import fpirhc as fp
from fpirhc.errors import FpirhcError
from helpers.attack.problems import line_task

Read = Callable[[Path], object]


@dataclass(frozen=True)
class Flips:
    """What came of the flipped bits of one artefact."""

    tried: int
    raw: tuple[str, ...]
    unnoticed: int


def _run_file(folder: Path) -> tuple[Path, Read]:
    problem, controllers = line_task()
    path = folder / "run.npz"
    fp.simulate(problem, controllers["CTC+FPI"], seed=0, compiled=False).save(path)

    def read(path: Path) -> object:
        run = fp.load_run(path)
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
            unnoticed += read(path) != written
        except FpirhcError:
            pass
        except Exception as error:  # noqa: BLE001 -- what is looked for
            raw.append(f"{name}, bit {place}: {type(error).__name__}: {error}")
    return Flips(count, tuple(raw), unnoticed)
