"""The contraction that a run shows."""

from __future__ import annotations

import numpy as np

from fpirhc.contraction.gains import predicted_factor
from fpirhc.contraction.spectrum import Array
from fpirhc.errors import InvalidShape

_WINDOW = 15  # cycles per coordinate and one more that are used; the transient of a useful gain is shorter
_INDEPENDENT = 1e-3  # share of the requests' size that each direction must reach, apart from the drift


def identified_factor(deformed: Array, realised: Array, effective_gain: float) -> float:
    """Return max|1 - a eig(J)| with J fitted to a run; NaN when the run does not excite every direction.

        realised[k+1] - realised[k] = J (deformed[k] - deformed[k-1]) + drift

    Parameters: `deformed` and `realised`, shape (cycles, n); row k of `realised` is the response to the request issued
    in cycle k - 1. Only the cycles from the largest increment of the request onwards are used, and the drift there is
    taken as linear in time, since later the request only follows the drift of the task, which hides the plant's answer.

    Raises:
        InvalidShape: the arrays differ in shape.
    """
    requests, responses = np.asarray(deformed, dtype=float), np.asarray(realised, dtype=float)
    if requests.shape != responses.shape or requests.ndim != 2:
        raise InvalidShape(
            f"deformed has shape {requests.shape} but realised {responses.shape}; expected the same, (cycles, n)"
        )
    asked, answered = np.diff(requests, axis=0)[:-1], np.diff(responses, axis=0)[1:]
    finite = np.isfinite(asked).all(axis=1) & np.isfinite(answered).all(axis=1)
    asked, answered = asked[finite], answered[finite]
    n = asked.shape[1]
    count = min(len(asked), _WINDOW * (n + 1))
    if count < n + 3:
        return float("nan")
    first = min(int(np.argmax(np.linalg.norm(asked, axis=1))), len(asked) - count)
    asked, answered = asked[first : first + count], answered[first : first + count]
    excitation, answer = _without_trend(asked), _without_trend(answered)
    smallest = np.linalg.svd(excitation, compute_uv=False)[-1]
    if not smallest > _INDEPENDENT * np.linalg.norm(asked):
        return float("nan")
    fitted = np.linalg.lstsq(excitation, answer, rcond=None)[0].T
    return predicted_factor(np.linalg.eigvals(fitted), effective_gain)


def _without_trend(rows: Array) -> Array:
    """Rows less their least-squares line in time."""
    time = np.arange(len(rows))
    line = np.vander(time, 2)
    return np.asarray(rows - line @ np.linalg.lstsq(line, rows, rcond=None)[0])
