"""Is the range of the map large enough? Some maps are valid only for requests that are much smaller than a constant of theirs."""

from __future__ import annotations

import numpy as np

from fpirhc.deformation.base import Deformation
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid

QUESTION = "Is the map's range large enough for the requests?"
_SPARE = 10.0


def range_enough(grid: ReviewGrid, deformation: Deformation, believed: np.ndarray) -> Answer | None:
    """Return the ratio of the map's constant to the largest request; None for a map without such a constant."""
    reach = deformation.iteration.reach
    if reach is None:
        return None
    size, name = reach.size, reach.name
    requests = grid.requests(believed)
    largest = float(np.nan_to_num(np.linalg.norm(np.hstack([requests, grid.responses]), axis=1)).max())
    ratio = size / max(largest, 1e-300)
    text = f"{name} {size:.3g} is {ratio:.3g} times the largest request and response, {largest:.3g}"
    change = f"Use {name} = {_SPARE * largest:.2g} or more."
    if ratio < 1:
        return Answer(QUESTION, Verdict.NO, text, change, {"ratio": ratio})
    good = ratio >= _SPARE
    return Answer(QUESTION, Verdict.YES if good else Verdict.UNKNOWN, text, "" if good else change, {"ratio": ratio})
