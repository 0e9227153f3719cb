"""Are there commands for the reference, and are they inside the limits? Inverse dynamics of the exact plant, over the box.

B = d response / d input must stay regular and keep its orientation.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.plant.motion import with_space
from fpirhc.plant.plant import Plant
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid, each
from fpirhc.review.question import ProblemQuestion

INVERSE = "Does the inverse exist along the reference?"
_SINGULAR = 1e8
_DOUBTFUL = 1e4
_VANISHING = 0.01  # share of its largest size below which a gain is doubtful


def inverse_exists(grid: ReviewGrid) -> Answer:
    """Return the conditioning of B along the reference and over the box.

    Between two points at which det B has different signs it is zero somewhere.
    """
    gains = _gains(grid)
    bad = ~np.isfinite(gains).all(axis=(2, 3))
    if bad[0].any():
        return Answer(INVERSE, Verdict.NO, "the gain of the inputs is not finite along the reference", _CHANGE)
    usual = gains[~bad]
    sizes = np.linalg.svd(usual, compute_uv=False)
    with np.errstate(divide="ignore", invalid="ignore"):
        condition = float((sizes[:, 0] / sizes[:, -1]).max())
    share = float(sizes[:, -1].min() / sizes[:, -1].max()) if sizes[:, -1].max() > 0 else 0.0
    numbers = {"condition": condition, "smallest_share": share}
    signs = [np.sign(np.linalg.det(g)) for g in (gains[0], usual)]
    text = f"condition at most {condition:.3g}, the smallest gain is {share:.3g} of its largest"
    if np.unique(signs[0]).size > 1 or not np.linalg.cond(gains[0]).max() < _SINGULAR:
        return Answer(INVERSE, Verdict.NO, f"{text}; it vanishes along the reference", _CHANGE, numbers)
    if np.unique(signs[1]).size > 1 or bad.any():
        return Answer(
            INVERSE, Verdict.UNKNOWN, f"{text}; it changes sign within the box of the parameters", _CHANGE, numbers
        )
    if condition > _DOUBTFUL or share < _VANISHING:
        return Answer(INVERSE, Verdict.UNKNOWN, text, _CHANGE, numbers)
    return Answer(INVERSE, Verdict.YES, text, "", numbers)


_CHANGE = "Control another coordinate, move the reference away from the singular state, or use time slots."


def _gains(grid: ReviewGrid) -> np.ndarray:
    """B at every draw and point, shape (draws + 1, m, n, n); the last one is the model's."""
    plant = grid.problem.plant
    x, u, p = plant.symbols()
    slope = ca.densify(ca.jacobian(plant.equations.controlled_response(x, u, p), u))
    function = ca.Function("fpirhc_input_gain", [x, u, p], [ca.vec(slope)])
    m, n = len(grid.times), len(plant.inputs)
    sets = np.vstack([grid.draws, plant.approximate])
    states = np.concatenate([grid.drawn_states, grid.states[None]]).reshape(-1, plant.state.size)
    commands = np.concatenate([grid.commands, grid.needed(plant.approximate)[None]]).reshape(-1, n)
    columns = each(function, states, commands, np.repeat(sets, m, axis=0))
    return columns.reshape(len(sets), m, n, n).transpose(0, 1, 3, 2)


COMMANDS = "Are the commands that the reference needs inside the limits?"


def commands_inside(grid: ReviewGrid) -> Answer:
    """Return the largest share of its limits that the reference needs of an input."""
    plant = grid.problem.plant
    lower, upper = grid.problem.limits.input_bounds(plant)
    # Inner states begin at the problem's start, and not where the reference would have led them before.
    commands = grid.commands[:, 1:] if grid.inner else grid.commands
    text = "needed: " + _named_ranges(plant, commands[0])
    used = _used(commands, lower, upper)
    if not np.isfinite(used).any():
        return Answer(COMMANDS, Verdict.UNKNOWN, "no finite command is known", "See whether the problem is well posed.")
    own, widest = float(np.nanmax(used[0])), float(np.nanmax(used))
    numbers = {"share_of_limits": own, "share_over_box": widest}
    if not np.isfinite(np.concatenate([lower, upper])).any():
        return Answer(COMMANDS, Verdict.YES, f"{text}; no input has limits", "", numbers)
    text += f"; {100 * own:.3g} % of the limits, {100 * widest:.3g} % over the box"
    held = _named_ranges(plant, commands, np.nan_to_num(used).max(axis=(0, 1)) > 1)
    change = f"Slow the reference down or ask for less; limits that are a choice must hold {held}."
    if own > 1:
        return Answer(COMMANDS, Verdict.NO, text, change, numbers)
    return Answer(COMMANDS, Verdict.UNKNOWN if widest > 1 else Verdict.YES, text, change if widest > 1 else "", numbers)


def _named_ranges(plant: Plant, commands: np.ndarray, chosen: np.ndarray | None = None) -> str:
    """The ranges of the inputs with their units, or of the chosen ones."""
    low, high = _range(commands.reshape(-1, commands.shape[-1]))
    ranges = [
        f"{n} {a:.3g} to {b:.3g}{with_space(u)}" for (n, u), a, b in zip(plant.inputs.items(), low, high, strict=True)
    ]
    return ", ".join(text for k, text in enumerate(ranges) if chosen is None or chosen[k])


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


QUESTIONS = (
    ProblemQuestion(inverse_exists, INVERSE, order=3, doubts=True),
    ProblemQuestion(commands_inside, COMMANDS, order=4, doubts=True),
)
