"""A study that is killed again and again: nothing that was finished is lost, and nothing is there twice."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from attack.problems import LINE

SCENARIOS = 12


@dataclass(frozen=True)
class Kills:
    """What came of the kills.

    Args:
        tried: number of kills.
        lost: records of the undisturbed study that the killed one lacks.
        doubled: records that are there more than once.
        changed: records with other numbers.
        failed: whether the last, undisturbed call failed.
    """

    tried: int
    lost: int
    doubled: int
    changed: int
    failed: bool

    @property
    def wrong(self) -> int:
        return self.lost + self.doubled + self.changed + self.failed


def killed_studies(folder: Path, count: int, *, seed: int) -> Kills:
    """Kill a study at random moments, start it again each time, and compare its records with those of a calm one.

    A study that has finished begins anew in another folder, so that every kill meets one that is running.
    """
    folder.mkdir(parents=True)
    (folder / "line.py").write_text(LINE, encoding="utf-8")
    begin = time.perf_counter()
    calm = _finished(folder, "calm")
    whole = time.perf_counter() - begin
    generator, kills, part, results = np.random.default_rng(seed), 0, 0, []
    while kills < count:
        process = _started(folder, f"out{part}")
        try:
            process.wait(timeout=whole * generator.uniform(0.2, 0.9))
            part += 1
            continue
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            kills += 1
        if kills % 10 == 0:
            results.append(_compared(calm, _finished(folder, f"out{part}")))
            part += 1
    rest = [_compared(calm, _finished(folder, f"out{part}"))] if count % 10 else []
    lost, doubled, changed = (sum(one[k] for one in [*results, *rest]) for k in range(3))
    return Kills(kills, lost, doubled, changed, not calm)


def _compared(calm: list[str], other: list[str]) -> tuple[int, int, int]:
    def named(lines: list[str]) -> dict[str, str]:
        return {json.dumps([json.loads(t).get(k) for k in ("scenario", "controller")]): t for t in lines[1:]}

    one, two = named(calm), named(other)
    return (
        len(one.keys() - two.keys()),
        len(other) - 1 - len(two),
        sum(one[name] != two[name] for name in one.keys() & two.keys()),
    )


def _started(folder: Path, out: str) -> subprocess.Popen[bytes]:
    words = ["compare", "line.py", "--scenarios", str(SCENARIOS), "--mismatch", "20", "--no-compile", "--out", out]
    return subprocess.Popen(
        [sys.executable, "-m", "fpirhc", *words],
        cwd=folder,
        env={**os.environ, "FPIRHC_CC": "none"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def _finished(folder: Path, out: str) -> list[str]:
    """The lines of the ledger of a study that runs to its end; none where it fails."""
    if _started(folder, out).wait(timeout=600) not in (0, 1):
        return []
    return (folder / out / "scenarios.jsonl").read_text(encoding="utf-8").splitlines()
