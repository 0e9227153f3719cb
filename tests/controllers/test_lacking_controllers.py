"""A controller or a map of a user's own that lacks what its contract asks for is told so by name, in the line that makes it."""

from dataclasses import dataclass, field, replace
from functools import cache
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
    """A wrapper that says neither what it wraps nor which map is in use."""

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
    def inner(self):
        """What it wraps."""
        return self.other

    @property
    def deformation(self):
        return self.inner.deformation


@dataclass(frozen=True, eq=False)
class Halfway(Controller):
    """A wrapper of something that is no controller."""

    inner: Any
    deformation: Deformation = field(default_factory=fp.Identity)

    def blocks(self, built):
        """Those of the inner one."""
        return self.inner.blocks(built)


class Nothing(Controller):
    """A controller that composes nothing."""


@dataclass(frozen=True, eq=False)
class Doubled(Deformation):
    """A map around another one, which it does not name."""

    map: Deformation

    def step(self, request, response, desired, memory):
        return self.map.step(request, response, desired, memory)

    def effective_gain(self):
        return 2 * self.map.effective_gain()

    secant_gain = effective_gain

    def with_effective_gain(self, gain):
        return Doubled(self.map.with_effective_gain(gain / 2))


LACKING = [
    (lambda: Around(LAW), "Around holds a Controller in 'other' and has no `inner`.*returns self.other"),
    (lambda: Around(LAW), "Around has no `deformation`, which its contract Controller asks for"),
    (lambda: Alone(), "^test_lacking_controllers.py, line .*: Alone has no `deformation`"),
    (lambda: Halfway(5), "Halfway: `inner` is the Controller that it wraps, or None, got 5"),
    (cast(Any, Nothing), r"Nothing has no blocks\(...\), which its contract Controller asks for"),
    (lambda: Doubled(fp.Affine(-0.5)), "Doubled holds a Deformation in 'map' and has no `inner`"),
]


@pytest.mark.parametrize(("make", "words"), LACKING, ids=range(len(LACKING)))
def test_what_is_lacking_is_told_in_the_line_that_makes_it(make, words):
    """Not by an error inside the library, cycles later."""
    with pytest.raises(InvalidField, match=f"(?s){words}"):
        make()


def test_a_whole_wrapper_runs():
    one, other = (fp.simulate(brief(), c, seed=0, compiled=False) for c in (LAW, Whole(LAW)))
    assert (one["command"] == other["command"]).all()
