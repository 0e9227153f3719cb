"""Does the inverse exist along the reference? B = d response / d input must stay regular and keep its orientation."""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid, each

QUESTION = "Does the inverse exist along the reference?"
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
        return Answer(QUESTION, Verdict.NO, "the gain of the inputs is not finite along the reference", _CHANGE)
    usual = gains[~bad]
    sizes = np.linalg.svd(usual, compute_uv=False)
    with np.errstate(divide="ignore", invalid="ignore"):
        condition = float((sizes[:, 0] / sizes[:, -1]).max())
    share = float(sizes[:, -1].min() / sizes[:, -1].max()) if sizes[:, -1].max() > 0 else 0.0
    numbers = {"condition": condition, "smallest_share": share}
    signs = [np.sign(np.linalg.det(g)) for g in (gains[0], usual)]
    text = f"condition at most {condition:.3g}, the smallest gain is {share:.3g} of its largest"
    if np.unique(signs[0]).size > 1 or not np.linalg.cond(gains[0]).max() < _SINGULAR:
        return Answer(QUESTION, Verdict.NO, f"{text}; it vanishes along the reference", _CHANGE, numbers)
    if np.unique(signs[1]).size > 1 or bad.any():
        return Answer(
            QUESTION, Verdict.UNKNOWN, f"{text}; it changes sign within the box of the parameters", _CHANGE, numbers
        )
    if condition > _DOUBTFUL or share < _VANISHING:
        return Answer(QUESTION, Verdict.UNKNOWN, text, _CHANGE, numbers)
    return Answer(QUESTION, Verdict.YES, text, "", numbers)


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
