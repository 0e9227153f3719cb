"""Generic code asks objects for facts: what a user adds is treated as what ships, a wrapper of a wrapper as what it is made of."""

from dataclasses import dataclass, replace

import pytest
from helpers import tasks
from helpers.reviewed import answers, mass, torque

import fpirhc as fp
from fpirhc.contracts import Controller
from fpirhc.errors import NotSupported

TRACK = fp.Exponential(rate=6.0)
PLAN = fp.RecedingHorizon(fp.FixedPointSolver(iterations=1, tolerance=1e-3))
LIMITS = fp.Limits(inputs={"u": (-20.0, 20.0)})
LOOKING_AHEAD = {
    "horizon": fp.Horizon(stages=10, step=1e-2),
    "cost": fp.Quadratic(states={"q": 1e3, "q'": 1.0}, deviation={"u": 1e-3}),
    "limits": LIMITS,
    "duration": 0.2,
    "start": {"q": 0.05},
}
FILTER = fp.DisturbanceKalman(drift={"q": 1e-3}, measured={"q": 1e-4, "q'": 1e-4}, noise={"q": 1e-3})


@dataclass(frozen=True)
class Named(Controller):
    """A user's own wrapper, which adds nothing."""

    wrapped: Controller
    label: str = "mine"

    @property
    def inner(self):
        return self.wrapped

    @property
    def deformation(self):
        return self.wrapped.deformation

    def blocks(self, built):
        return self.wrapped.blocks(built)


def twice(controller: Controller) -> Named:
    """A user's wrapper of a user's wrapper."""
    return Named(Named(controller), label="outer")


@pytest.mark.parametrize(
    ("controller", "settings"),
    [
        (torque(), {}),
        (fp.Predicted(torque(), inputs=2e-3), {"dead_time": fp.DeadTime(inputs={"u": 2e-3})}),
        (fp.Estimating(PLAN, FILTER), LOOKING_AHEAD),
    ],
    ids=["torque", "predicted", "estimating"],
)
def test_a_wrapper_of_a_wrapper_is_reviewed_as_what_it_is_made_of(controller, settings):
    problem = mass(**settings)
    told = [answers(problem, one) for one in (controller, twice(controller))]
    plain, wrapped = (
        {k: replace(a, change=a.change.rpartition("controller.")[2]) for k, a in one.items()} for one in told
    )
    assert wrapped == plain != {}


def test_a_pair_is_found_through_wrappers():
    """A comparison has a wrapped controller beside the wrapped plain one; one that cannot have another deformation says so."""
    plain, adaptive = (twice(fp.ComputedTorque(TRACK, d)) for d in (fp.Identity(), fp.Affine(-0.5)))
    found = fp.compare(tasks.made(mass(duration=0.2), {"it": plain, "it+FPI": adaptive}), seed=0, compiled=False)
    assert found["it+FPI"].pair == "it"
    with pytest.raises(NotSupported, match="no deformation that can be replaced"):
        Named(fp.rivals.AccelerationFeedback(TRACK, gain=1.0)).with_deformation(fp.Affine(-0.5))
