"""Joins baselines of single controllers, as tests measure them, with the file that is there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from fpirhc.baselines.baseline import Baseline, to_text
from fpirhc.baselines.places import baseline_path, check_inside, write_whole
from fpirhc.baselines.reading import read_baseline, read_text
from fpirhc.baselines.settings import Settings, fingerprint
from fpirhc.errors import BaselineError


def write_merged(problem: Path, parts: Sequence[str], working: Path) -> Path:
    """Write the baseline that holds all parts, and of the file that is there every controller that no part has.

    Raises:
        BaselineError: the problem's settings changed, and the file has controllers that were not measured. OutputError: the file
            cannot be written.
    """
    path = baseline_path(problem)
    check_inside(path, working)
    merged = read_text(parts[0], path)
    for text in parts[1:]:
        merged = _joined(merged, read_text(text, path))
    if path.exists():
        merged = _joined(_kept(read_baseline(path), merged), merged)
    write_whole(to_text(merged), path, "baseline")
    return path


def _kept(before: Baseline, merged: Baseline) -> Baseline:
    """What was there, if it can stay."""
    others = [name for name in before.controllers if name not in merged.controllers]
    if others and (
        fingerprint(before.settings.problem) != fingerprint(merged.settings.problem) or before.seed != merged.seed
    ):
        raise BaselineError(
            f"problem '{before.problem}' changed, and {', '.join(others)} were not measured; its baseline is left as it "
            "is: run the tests of all its controllers, or fpirhc accept"
        )
    return before


def _joined(first: Baseline, second: Baseline) -> Baseline:
    """The second, and of the first what it has beyond."""
    settings = Settings(second.settings.problem, {**first.settings.controllers, **second.settings.controllers})
    return replace(second, settings=settings, controllers={**first.controllers, **second.controllers})
