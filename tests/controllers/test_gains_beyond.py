"""A gain beyond the limit of its iteration is refused, built in or given while the loop runs, unless it is asked for."""

from dataclasses import replace
from functools import cache

import pytest
from helpers import tasks

import fpirhc as fp
from fpirhc.errors import NotContractive

brief = cache(lambda: replace(tasks.two_mass.problem, duration=0.05, measure_from=0.0))
LAW = fp.ComputedTorque(fp.Exponential(rate=6.0))
LARGEST = 4 / 1.5  # of an affine map: |1 - a lambda| < 1 with a half of its gain, lambda = 1.5 and 1.3


def affine(gain, around=lambda m: m):
    """Computed torque with an affine map."""
    return LAW.with_deformation(around(fp.Affine(gain=gain)))


@pytest.mark.parametrize("gain", [-1.01 * LARGEST, -5.0, -1e300])
def test_a_gain_beyond_the_limit_is_refused_in_every_way(gain):
    """Built in, as a live setting of a run and of a stepper: one message with the limit and a remedy."""
    message = r"too large; use 0 < \|gain\| < 2.67, where the iteration alone converges"
    path = "deformation.gain"
    for make in (fp.Stepper, fp.simulator):
        with pytest.raises(NotContractive, match=message):
            make(brief(), affine(gain), compiled=False)
    loop = fp.simulator(brief(), affine(-0.5), compiled=False, live=[path])
    with pytest.raises(NotContractive, match=message):
        loop.run(seed=0, settings={path: gain})
    stepper = fp.Stepper(brief(), affine(-0.5), compiled=False, live=[path])
    assert not stepper.change({path: gain})
    assert (stepper.refused, stepper.numbers[path]) == (1, -0.5)
    assert "use 0 < |gain| < 2.67, where the iteration alone converges" in stepper.why_refused


@pytest.mark.parametrize("gain", [-0.99 * LARGEST, -0.1])
def test_a_gain_below_the_limit_runs(gain):
    loop = fp.simulator(brief(), affine(-0.5), live=["deformation.gain"])
    assert loop.run(seed=0, settings={"deformation.gain": gain}).stop is None


def test_a_map_that_lowers_its_gain_begins_where_it_likes():
    """`Tuned` finds its gain on line, from twice the limit as well."""
    fp.Stepper(brief(), affine(-2 * LARGEST, lambda m: fp.Tuned(m, largest_gain=6.0)), compiled=False)


def test_forms_of_the_iteration_have_their_own_limits():
    """The model-referenced form at -1e300 is refused, too."""
    with pytest.raises(NotContractive, match=r"^ModelReferenced\(Affine\(gain=-1e\+300\)\) is too large"):
        fp.Stepper(brief(), affine(-1e300, fp.ModelReferenced), compiled=False)
    fp.Stepper(brief(), affine(-0.9, fp.ModelReferenced), compiled=False)
