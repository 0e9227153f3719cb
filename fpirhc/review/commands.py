"""Are the commands along the reference inside the limits? Inverse dynamics of the exact plant, over the box."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid

QUESTION = "Are the commands that the reference needs inside the limits?"


def commands_inside(grid: ReviewGrid) -> Answer:
    """Return the largest share of its limits that the reference needs of an input."""
    plant = grid.problem.plant
    lower, upper = grid.problem.limits.input_bounds(plant)
    # Inner states begin at the problem's start, and not where the reference would have led them before.
    commands = grid.commands[:, 1:] if grid.inner else grid.commands
    text = "needed: " + _named_ranges(plant.inputs, commands[0])
    used = _used(commands, lower, upper)
    if not np.isfinite(used).any():
        return Answer(QUESTION, Verdict.UNKNOWN, "no finite command is known", "See whether the problem is well posed.")
    own, widest = float(np.nanmax(used[0])), float(np.nanmax(used))
    numbers = {"share_of_limits": own, "share_over_box": widest}
    if not np.isfinite(np.concatenate([lower, upper])).any():
        return Answer(QUESTION, Verdict.YES, f"{text}; no input has limits", "", numbers)
    text += f"; {100 * own:.3g} % of the limits, {100 * widest:.3g} % over the box"
    held = _named_ranges(plant.inputs, commands, np.nan_to_num(used).max(axis=(0, 1)) > 1)
    change = f"Slow the reference down or ask for less; limits that are a choice must hold {held}."
    if own > 1:
        return Answer(QUESTION, Verdict.NO, text, change, numbers)
    return Answer(QUESTION, Verdict.UNKNOWN if widest > 1 else Verdict.YES, text, change if widest > 1 else "", numbers)


def _named_ranges(names: Iterable[str], commands: np.ndarray, chosen: np.ndarray | None = None) -> str:
    """The ranges of the inputs in words, or of the chosen ones."""
    low, high = _range(commands.reshape(-1, commands.shape[-1]))
    return ", ".join(f"{n} {low[k]:.3g} to {high[k]:.3g}" for k, n in enumerate(names) if chosen is None or chosen[k])


def _range(commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    own = commands[np.isfinite(commands).all(axis=1)]
    if not len(own):
        nothing = np.full(commands.shape[1], np.nan)
        return nothing, nothing
    return own.min(axis=0), own.max(axis=0)


def _used(commands: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Share of the way from the middle to its limit that a command needs; above 1 it is outside.

    Where one side has no limit, the share is 0 inside and 2 outside.
    """
    both = np.isfinite(lower) & np.isfinite(upper)
    middle = np.where(both, 0.5 * (np.where(both, lower, 0) + np.where(both, upper, 0)), 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        above = np.where(np.isfinite(upper), (commands - middle) / np.abs(upper - middle), 0.0)
        below = np.where(np.isfinite(lower), (middle - commands) / np.abs(middle - lower), 0.0)
    one_sided = np.where(commands > upper, 2.0, np.where(commands < lower, 2.0, 0.0))
    shares = np.where(both, np.maximum(above, below), one_sided)
    return np.asarray(np.where(np.isfinite(commands), shares, np.nan))
