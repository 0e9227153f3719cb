"""What a user adds is treated as what ships, and a wrapper as what it is made of; what it lacks is told where it is made."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import pytest
from helpers import tasks
from helpers.reviewed import answers, mass, torque

import fpirhc as fp
from fpirhc.contracts import Controller, Deformation
from fpirhc.errors import InvalidField, NotSupported

TRACK = fp.Exponential(rate=6.0)
LAW = fp.ComputedTorque(TRACK)
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


# What its contract asks for


@dataclass(frozen=True, eq=False)
class Alone(Controller):
    """A controller that does not say which map is in use."""

    other: Controller | None = None

    def blocks(self, built):
        del built
        return []


@dataclass(frozen=True)
class Halved(Deformation):
    """A map around another one, in a field that has the name of what it is."""

    inner: Deformation

    def step(self, request, response, desired, memory):
        raise NotImplementedError

    def effective_gain(self):
        return self.inner.effective_gain() / 2

    def with_effective_gain(self, gain):
        return Halved(self.inner.with_effective_gain(2 * gain))


class Nothing(Controller):
    """A controller that composes nothing."""


LACKING = [
    (lambda: Alone(LAW), "Alone has no `deformation`, which its contract Controller asks for"),
    (lambda: Alone(), "^test_facts.py, line .*: Alone has no `deformation`"),
    (lambda: Halved(cast(Any, 5)), "Halved.inner: expected a Deformation, got 5"),
    (cast(Any, Nothing), r"Nothing has no blocks\(...\), which its contract Controller asks for"),
]


@pytest.mark.parametrize(("make", "words"), LACKING, ids=range(len(LACKING)))
def test_what_is_lacking_is_told_in_the_line_that_makes_it(make, words):
    """Not by an error inside the library, cycles later."""
    with pytest.raises(InvalidField, match=f"(?s){words}"):
        make()


def test_what_a_member_holds_is_what_it_is_around():
    """Whatever the name of the field; the facts that it does not tell are those of the inner one."""
    assert Named(fp.ExactModel(LAW)).inner.inner is LAW
    assert Halved(fp.Paired(fp.Affine(-0.5), cycles=3)).form.cycles == 3
    computes: Any = type("Computes", (fp.ComputedTorque,), {"other": cached_property(lambda self: LAW)})
    beside = computes(LAW.tracking)
    assert (beside.other, beside.inner) == (LAW, None)
    assert Named(LAW).with_deformation(fp.Affine(-0.5)).wrapped.deformation.gain == -0.5
