"""Joins baselines of single controllers, which tests measure, with the file of the problem."""

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
    """Write the baseline of all parts, with those controllers of the earlier file that no part has.

    Args:
        problem: path of the problem file.
        parts: texts of baselines.
        working: a folder of the project, outside of which nothing is written.

    Raises:
        BaselineError: the problem's settings changed, and the file has controllers that were not measured.
        OutputError: the file cannot be written.
    """
    path = baseline_path(problem)
    check_inside(path, working)
    merged = read_text(parts[0], path)
    for text in parts[1:]:
        merged = _joined(merged, read_text(text, path))
    if path.exists():
        earlier = read_baseline(path)
        _check_mergeable(earlier, merged)
        merged = _joined(earlier, merged)
    write_whole(to_text(merged), path, "baseline")
    return path


def _check_mergeable(before: Baseline, merged: Baseline) -> None:
    """Raise if controllers of the earlier baseline were not measured, although problem or seed changed."""
    others = [name for name in before.controllers if name not in merged.controllers]
    if others and (
        fingerprint(before.settings.problem) != fingerprint(merged.settings.problem) or before.seed != merged.seed
    ):
        raise BaselineError(
            f"problem '{before.problem}' changed, and {', '.join(others)} were not measured; its baseline is left as it "
            "is: run the tests of all its controllers, or fpirhc accept"
        )


def _joined(first: Baseline, second: Baseline) -> Baseline:
    """The second baseline with those controllers of the first that it lacks."""
    settings = Settings(second.settings.problem, {**first.settings.controllers, **second.settings.controllers})
    return replace(second, settings=settings, controllers={**first.controllers, **second.controllers})
