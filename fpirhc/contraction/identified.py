"""The contraction that a run shows."""

from __future__ import annotations

import numpy as np

from fpirhc.contraction.gains import predicted_factor
from fpirhc.contraction.spectrum import Array
from fpirhc.errors import InvalidShape

_EXCITED = 1e-2  # share of the largest increment of the request from which a cycle counts as excited
_INDEPENDENT = 1e-6  # smallest ratio of singular values at which the excited directions count as independent


def identified_factor(deformed: Array, realised: Array, effective_gain: float) -> float:
    """Return max|1 - a eig(J)| with J fitted to a run; NaN when the run does not excite every direction.

        realised[k+1] - realised[k] = J (deformed[k] - deformed[k-1]) + drift

    Parameters: `deformed` and `realised`, shape (cycles, n); row k of `realised` is the response to the request issued
    in cycle k - 1. Only cycles with large increments of the request are used, since in the others the drift of the task,
    which the request follows, hides the plant's answer.

    Raises:
        InvalidShape: the arrays differ in shape.
    """
    requests, responses = np.asarray(deformed, dtype=float), np.asarray(realised, dtype=float)
    if requests.shape != responses.shape:
        raise InvalidShape(f"deformed has shape {requests.shape} but realised {responses.shape}; expected the same")
    n = requests.shape[1]
    asked, answered = np.diff(requests, axis=0)[:-1], np.diff(responses, axis=0)[1:]
    finite = np.isfinite(asked).all(axis=1) & np.isfinite(answered).all(axis=1)
    asked, answered = asked[finite], answered[finite]
    sizes = np.linalg.norm(asked, axis=1)
    excited = sizes > _EXCITED * sizes.max(initial=0.0)
    if np.count_nonzero(excited) < n + 2:
        return float("nan")
    asked, answered = (v[excited] - v[excited].mean(axis=0) for v in (asked, answered))
    singular = np.linalg.svd(asked, compute_uv=False)
    if not singular[-1] > _INDEPENDENT * singular[0]:
        return float("nan")
    fitted = np.linalg.lstsq(asked, answered, rcond=None)[0].T
    return predicted_factor(np.linalg.eigvals(fitted), effective_gain)
