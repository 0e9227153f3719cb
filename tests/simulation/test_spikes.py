"""An absurd but finite sample does not stay in integrals, filters and queues: the run returns to the undisturbed one."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.lossy import Lossy

import fpirhc as fp
from fpirhc.conformance import two_masses
from fpirhc.contracts import Deformation, Tracking

PROBLEM = replace(two_masses(), duration=6.0)
LAWS: dict[str, Tracking] = {
    "exponential": fp.Exponential(rate=6.0),
    "exponential, integral from zero": fp.Exponential(rate=6.0, bumpless=False),
    "exponential, no integral": fp.Exponential(rate=6.0, integral=False),
    "fractional below one": fp.Fractional(rate=6.0, order=0.8, memory=2.0),
    "fractional above one": fp.Fractional(rate=6.0, order=1.2, memory=2.0),
}
SHAPE = fp.Sigmoid(gain=-0.5, scale=50.0)
MAPS: dict[str, Deformation] = {
    "none": fp.Identity(),
    "sigmoid": SHAPE,
    "affine": fp.Affine(gain=-0.5),
    "eq 3": fp.RFPT(offset=1e5, sign=-1, gain=5e-6),
    "eq 3, vector": fp.RFPTVector(offset=1e5, sign=-1, gain=5e-6),
    "rotation": fp.Rotation(fraction=0.4, radius=1e3),
    "filtered": fp.Filtered(SHAPE, pole=0.5),
    "filtered slowly": fp.Filtered(fp.Affine(gain=-0.5), pole=0.8),
    "tuned": fp.Tuned(SHAPE, largest_gain=1.0),
    "increment": fp.Increment(SHAPE, cycles=2),
    "paired": fp.Paired(fp.Sigmoid(gain=-0.3, scale=50.0), cycles=0),
    "model-referenced": fp.ModelReferenced(SHAPE),
}
QUICK = (
    ("exponential", "filtered"),
    ("exponential, integral from zero", "increment"),
    ("fractional below one", "none"),
)
SPIKES = tuple((what, size, first) for what in ("state", "realised") for size in (1e9, -1e155) for first in (0, 200))
RETURNS = 15.0  # over the law's rate: time after which the run is back
NEAR = 2e-3  # m; the motion has 0.4 m


def stays_away(law: Tracking, deformation: Deformation, spikes=SPIKES) -> dict[str, float]:
    """Distance to the undisturbed motion after the stated time, of every spike where it is too large."""
    own = Lossy(PROBLEM, fp.ComputedTorque(law, deformation))
    back, after = round(RETURNS / law.rate / PROBLEM.period), 20

    def motion(what: str = "", size: float = 0.0, at: int = -1, cycles: int = 220 + back) -> np.ndarray:
        """Positions of the two masses; one sample of the states or of the responses has this size."""

        def shown(k: int, row: np.ndarray) -> np.ndarray:
            row[slice(4) if what == "state" else slice(4, None)] = size
            return row

        own.run(cycles, shown=lambda k, row: shown(k, row) if k == at else row)
        return np.array(own.states)[:, :2]

    clean, far = motion(), {}
    for what, size, first in spikes:
        end = first + back
        rest = np.abs(motion(what, size, first, end + after) - clean[: end + after])[end:].max()
        if not rest < NEAR:
            far[f"{what} {size:g} in cycle {first}"] = float(rest)
    return far


@pytest.mark.parametrize(("law", "deformation"), QUICK)
def test_a_run_returns_after_a_spike(law, deformation):
    """Within 15 / rate, to half a per cent of the motion."""
    assert stays_away(LAWS[law], MAPS[deformation]) == {}


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("deformation", MAPS)
def test_a_run_returns_after_a_spike_with_every_law_and_map(law, deformation):
    assert stays_away(LAWS[law], MAPS[deformation]) == {}


def test_without_its_bound_the_law_does_not_return():
    """The test above can fail: a law that is told that anything is possible keeps the first spike in its integral."""
    unbounded = fp.Exponential(rate=6.0, largest=(np.inf, np.inf))
    assert "state 1e+09 in cycle 0" in stays_away(unbounded, SHAPE, SPIKES[:1])
