"""Saved runs: written at once or not at all, and read with a schema whatever the file holds."""

import io
import json
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.plants import swing

import fpirhc as fp
from fpirhc.errors import OutputError


@pytest.fixture(scope="module")
def run() -> fp.Run:
    """A short run."""
    problem = swing(duration=0.05, measure_from=0.0)
    return fp.simulate(problem, fp.ComputedTorque(fp.Exponential(rate=6.0)), seed=0, compiled=False)


def npy(array: Any) -> bytes:
    """An array as numpy stores it."""
    content = io.BytesIO()
    np.lib.format.write_array(content, np.asarray(array), allow_pickle=True)
    return content.getvalue()


def write(path: Path, **parts: bytes) -> None:
    """A zip of named parts."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in parts.items():
            file.writestr(f"{name}.npy", content)


def facts_of(path: Path) -> dict[str, Any]:
    """The facts of a file."""
    with np.load(path) as stored:
        facts: dict[str, Any] = json.loads(str(stored["facts"]))
    return facts


HOSTILE = {
    "no zip": lambda log, facts: b"PK\x03\x04 nothing",
    "empty": lambda log, facts: b"",
    "format": lambda log, facts: {**facts, "format": 9},
    "no mapping": lambda log, facts: [1],
    "no period": lambda log, facts: {k: v for k, v in facts.items() if k != "period"},
    "signals of another size": lambda log, facts: {**facts, "signals": facts["signals"][:-1]},
    "same signal twice": lambda log, facts: {**facts, "signals": [*facts["signals"][:-1], facts["signals"][0]]},
    "flat log": lambda log, facts: log.ravel(),
    "log of texts": lambda log, facts: log.astype(str),
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_file_is_refused_in_one_way(case, run, tmp_path):
    good, bad = tmp_path / "good.npz", tmp_path / "bad.npz"
    run.save(good)
    change = HOSTILE[case](run.log, facts_of(good))
    if isinstance(change, bytes):
        bad.write_bytes(change)
    elif isinstance(change, np.ndarray):
        write(bad, log=npy(change), facts=npy(json.dumps(facts_of(good))))
    else:
        write(bad, log=npy(run.log), facts=npy(json.dumps(change)))
    with pytest.raises(OutputError, match="cannot read a run from"):
        fp.load_run(bad)


def test_a_file_runs_no_code(tmp_path, run):
    """Pickles are refused, wherever they stand."""

    class Trap:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "ran"),))

    (tmp_path / "bad.npz").write_bytes(pickle.dumps(Trap()))
    write(tmp_path / "worse.npz", log=npy(np.array([Trap()], dtype=object)), facts=npy("{}"))
    for name in ("bad.npz", "worse.npz"):
        with pytest.raises(OutputError):
            fp.load_run(tmp_path / name)
    assert not (tmp_path / "ran").exists()


def test_folders_and_missing_files_are_refused(tmp_path):
    for path in (tmp_path, tmp_path / "none.npz"):
        with pytest.raises(OutputError, match="cannot read a run from"):
            fp.load_run(path)


def test_a_write_that_fails_leaves_the_earlier_file(run, tmp_path, monkeypatch):
    run.save(tmp_path / "run.npz")
    before = (tmp_path / "run.npz").read_bytes()

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match=r"cannot write the run to .*No space left on device"):
        run.save(tmp_path / "run.npz")
    assert (tmp_path / "run.npz").read_bytes() == before
    assert os.listdir(tmp_path) == ["run.npz"]
