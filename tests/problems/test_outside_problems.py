"""Plants of other packages: what their baselines promise, and that the packages themselves still give it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "problems" / "outside"
# Errors of RHC with the model-referenced form in the first study of these plants, and what a tenth of a more may be.
REACHED = {
    "car": {"side": 0.5e-3},
    "lab": {"T1": 0.145, "T2": 0.154},
    "mujoco_arm": {"shoulder": 59e-6, "elbow": 62e-6},
}


def errors(name: str, controller: str) -> dict[str, float]:
    """The rms errors of the baseline."""
    metrics = json.loads((FOLDER / "baselines" / f"{name}.json").read_text())["controllers"][controller]["metrics"]
    return {key.partition(".")[2]: one[0] for key, one in metrics.items() if key.startswith("rms_error.")}


@pytest.mark.parametrize("name", REACHED)
def test_adaptation_is_as_good_as_it_was(name):
    """At most 1.2 times the error of the first study, and far below RHC."""
    found, plain = errors(name, "RHC+FPI"), errors(name, "RHC")
    for coordinate, reached in REACHED[name].items():
        assert found[coordinate] <= 1.2 * reached
        assert found[coordinate] < plain[coordinate]
