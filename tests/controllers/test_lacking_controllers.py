"""A controller or a map of a user's own that lacks what its contract asks for is told so by name, in the line that makes it."""

from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, cast

import pytest
from helpers import tasks

import fpirhc as fp
from fpirhc.contracts import Controller, Deformation
from fpirhc.errors import InvalidField

brief = cache(lambda: replace(tasks.two_mass.problem, duration=0.01, measure_from=0.0))
LAW = fp.ComputedTorque(fp.Exponential(rate=6.0))


@dataclass(frozen=True, eq=False)
class Around(Controller):
    """A wrapper that does not say which map is in use."""

    other: Controller

    def blocks(self, built):
        return self.other.blocks(built)


@dataclass(frozen=True, eq=False)
class Alone(Controller):
    """A controller without a map."""

    rate: float = 1.0

    def blocks(self, built):
        del built
        return []


@dataclass(frozen=True, eq=False)
class Whole(Around):
    """The wrapper with everything that its contract asks for."""

    @property
    def deformation(self):
        return self.other.deformation


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
    (lambda: Around(LAW), "Around has no `deformation`, which its contract Controller asks for"),
    (lambda: Alone(), "^test_lacking_controllers.py, line .*: Alone has no `deformation`"),
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
    assert Whole(fp.ExactModel(LAW)).inner.inner is LAW
    assert Halved(fp.Paired(fp.Affine(-0.5), cycles=3)).form.cycles == 3
    computes: Any = type("Computes", (fp.ComputedTorque,), {"other": cached_property(lambda self: LAW)})
    beside = computes(LAW.tracking)
    assert (beside.other, beside.inner) == (LAW, None)
    assert Whole(LAW).with_deformation(fp.Affine(-0.5)).other.deformation.gain == -0.5


def test_a_whole_wrapper_runs():
    one, other = (fp.simulate(brief(), c, seed=0, compiled=False) for c in (LAW, Whole(LAW)))
    assert (one["command"] == other["command"]).all()
