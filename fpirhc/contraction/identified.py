"""The contraction that a run shows."""

from __future__ import annotations

import numpy as np

from fpirhc.contraction.gains import predicted_factor
from fpirhc.contraction.spectrum import Array
from fpirhc.errors import InvalidShape

_WINDOW = 15  # times (number of coordinates + 1): the cycles that are used; the transient of a useful gain is shorter
_INDEPENDENT = 1e-3  # share of the size of the requests that each direction must reach, apart from the drift


def identified_factor(deformed: Array, realised: Array, effective_gain: float) -> float:
    """Return max|1 - a eig(J)| with J fitted to a run; NaN when the run does not excite every direction.

        realised[k+1] - realised[k] = J (deformed[k] - deformed[k-1]) + drift

    Only the cycles from the largest increment of the request onwards are used, and the drift there is taken as linear in time:
    later the request only follows the drift of the task, which hides the response of the plant.

    Args:
        deformed: requests, shape (cycles, n).
        realised: responses, shape (cycles, n); row k is the response to the request issued in cycle k - 1.
        effective_gain: a of the deformation, dimensionless.

    Raises:
        InvalidShape: the arrays differ in shape.
    """
    requests, responses = np.asarray(deformed, dtype=float), np.asarray(realised, dtype=float)
    if requests.shape != responses.shape or requests.ndim != 2:
        raise InvalidShape(
            f"deformed has shape {requests.shape} but realised {responses.shape}; expected the same, (cycles, n)"
        )
    request_steps, response_steps = np.diff(requests, axis=0)[:-1], np.diff(responses, axis=0)[1:]
    finite = np.isfinite(request_steps).all(axis=1) & np.isfinite(response_steps).all(axis=1)
    request_steps, response_steps = request_steps[finite], response_steps[finite]
    n = request_steps.shape[1]
    count = min(len(request_steps), _WINDOW * (n + 1))
    if count < n + 3:
        return float("nan")
    first = min(int(np.argmax(np.linalg.norm(request_steps, axis=1))), len(request_steps) - count)
    request_steps, response_steps = request_steps[first : first + count], response_steps[first : first + count]
    excitation, answer = _without_trend(request_steps), _without_trend(response_steps)
    smallest = np.linalg.svd(excitation, compute_uv=False)[-1]
    if not smallest > _INDEPENDENT * np.linalg.norm(request_steps):
        return float("nan")
    fitted = np.linalg.lstsq(excitation, answer, rcond=None)[0].T
    return predicted_factor(np.linalg.eigvals(fitted), effective_gain)


def _without_trend(rows: Array) -> Array:
    """The rows minus their least-squares line in time."""
    time = np.arange(len(rows))
    line = np.vander(time, 2)
    return np.asarray(rows - line @ np.linalg.lstsq(line, rows, rcond=None)[0])
