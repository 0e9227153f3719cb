"""Is the range of the map large enough? RFPT maps and the rotation hold only for requests much smaller than their own constant."""

from __future__ import annotations

import numpy as np

from fpirhc.deformation.base import Deformation
from fpirhc.deformation.rfpt import Rfpt
from fpirhc.deformation.rfpt_vector import RfptVector
from fpirhc.deformation.rotation import Rotation
from fpirhc.studies.review.along import Along
from fpirhc.studies.review.answer import Answer, Verdict
from fpirhc.studies.review.maps import innermost

QUESTION = "Is the map's range large enough for the requests?"
_SPARE = 10.0


def range_enough(al: Along, deformation: Deformation, believed: np.ndarray) -> Answer | None:
    """Return the ratio of the map's constant to the largest request; None for a map without one."""
    inner = innermost(deformation)
    if isinstance(inner, Rfpt | RfptVector):
        size, name = abs(inner.offset), "offset"
    elif isinstance(inner, Rotation):
        size, name = inner.radius, "radius"
    else:
        return None
    requests = al.requests(believed)
    largest = float(np.nan_to_num(np.linalg.norm(np.hstack([requests, al.responses]), axis=1)).max())
    ratio = size / max(largest, 1e-300)
    text = f"{name} {size:.3g} is {ratio:.3g} times the largest request and response, {largest:.3g}"
    change = f"Use {name} = {_SPARE * largest:.2g} or more."
    if ratio < 1:
        return Answer(QUESTION, Verdict.NO, text, change, {"ratio": ratio})
    good = ratio >= _SPARE
    return Answer(QUESTION, Verdict.YES if good else Verdict.UNKNOWN, text, "" if good else change, {"ratio": ratio})
