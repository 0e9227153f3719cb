"""A wrong member of a family is caught by the public laws, with the law that it breaks; the right one beside it is not."""

from dataclasses import replace
from typing import Any

import pytest
from wrong import controllers, maps, observers, optimisers
from wrong.tables import CONTROLLER_MEMBERS, CONTROLLERS, MAP_MEMBERS, MAPS, OBSERVERS, OPTIMISERS

import fpirhc as fp
from fpirhc import conformance
from fpirhc.conformance import check_deformation, check_observer, two_masses
from fpirhc.conformance import controller as controller_laws
from fpirhc.conformance import deformation as deformation_laws
from fpirhc.conformance import optimiser as optimiser_laws
from fpirhc.conformance.horizons import Trial as OptimiserTrial
from fpirhc.conformance.laws import keep
from fpirhc.conformance.loops import Trial
from fpirhc.contracts import Controller, Deformation

DEFORMATION = fp.Sigmoid(gain=-0.5)


def caught(check, member, law, sentence):
    """One sentence that names the class, the law, the numbers and what to do."""
    with pytest.raises(
        AssertionError, match=f"^{type(member).__name__} breaks the law '{law}': .*{sentence}.*The law: "
    ):
        check(member)


def by_its_law(laws, trial, member, law, sentence):
    """Caught by this law of a family; the laws before it are tried on right members."""
    [one] = [own for own in laws if own.__name__ == law.replace(" ", "_")]
    caught(lambda m: keep(m, trial, [one], seed=1), member, law, sentence)


def check_controller(member):
    conformance.check_controller(member, seed=1, compiled=False)


@pytest.mark.parametrize("wrong", CONTROLLERS, ids=lambda c: c.__name__)
def test_a_wrong_controller_is_caught(wrong):
    member = wrong(6.0, DEFORMATION)
    trial = Trial(member, two_masses(), 1, 0.05, compiled=False)
    by_its_law(controller_laws.LAWS, trial, member, *CONTROLLERS[wrong])


@pytest.mark.parametrize("wrong", MAPS, ids=lambda c: c.__name__)
def test_a_wrong_map_is_caught(wrong):
    caught(lambda m: check_deformation(m, seed=1), wrong(0.3, 5.0), *MAPS[wrong])


@pytest.mark.parametrize("wrong", OPTIMISERS, ids=lambda c: c.__name__)
def test_a_wrong_optimiser_is_caught(wrong):
    """Its plan, its numbers or its memory are not what they are said to be."""
    member = wrong(100, 1e-6)
    by_its_law(optimiser_laws.LAWS, OptimiserTrial(member, 1e-6, 50), member, *OPTIMISERS[wrong])


@pytest.mark.parametrize("wrong", OBSERVERS, ids=lambda c: c.__name__)
def test_a_wrong_observer_is_caught(wrong):
    """It uses what it cannot know, or does not come to the truth."""
    caught(lambda m: check_observer(m, seed=1), wrong(0.4), *OBSERVERS[wrong])


def test_a_diverging_observer_is_caught():
    """The same class with a gain above two: every correction is wrong by more than the error was."""
    caught(
        lambda m: check_observer(m, seed=1),
        observers.ConstantGain(3.0),
        "wrong start is corrected",
        "does not converge",
    )


@pytest.mark.parametrize(
    ("contract", "table", "laws"),
    [(Controller, CONTROLLER_MEMBERS, controller_laws.LAWS), (Deformation, MAP_MEMBERS, deformation_laws.LAWS)],
    ids=["Controller", "Deformation"],
)
def test_every_member_of_a_contract_has_a_law(contract, table, laws):
    """A fact that no law tests may be anything."""
    own = {n for n in (*vars(contract), *contract.__annotations__) if not n.startswith("_")}
    assert own == {*table}
    assert {*table.values()} <= {law.__name__.replace("_", " ") for law in laws}


def test_the_right_members_are_not_refused():
    """Every wrong member is one change away from a right one."""
    check_controller(controllers.Gentle(6.0, DEFORMATION))
    check_deformation(maps.Softsign(0.3, 5.0), seed=1)
    conformance.check_optimiser(optimisers.HeavyBall(100, 1e-6), tolerance=1e-6, seed=1)
    check_observer(observers.ConstantGain(0.4), seed=1)


def test_nobody_wrong_is_left_out():
    """A class that is added to the wrong members stands in the tables."""
    tables: dict[Any, Any] = {controllers: CONTROLLERS, maps: MAPS, optimisers: OPTIMISERS, observers: OBSERVERS}
    right = {controllers.Gentle, maps.Softsign, optimisers.HeavyBall, observers.ConstantGain, observers.Told}
    for module, table in tables.items():
        own = {c for c in vars(module).values() if isinstance(c, type) and c.__module__ == module.__name__}
        assert own - right == {*table}


def test_a_controller_that_knows_the_exact_parameters_may_say_so():
    """As the bound of a comparison: the same command, honestly named."""

    class Honest(controllers.KnowsThePlant):
        def plant_model(self, problem):
            return replace(super().plant_model(problem), exact=True)

    check_controller(Honest(6.0, DEFORMATION))
    problem = two_masses()
    assert fp.ExactModel(controllers.Gentle(6.0)).plant_model(problem).exact
    assert not fp.ComputedTorque(fp.Exponential(rate=6.0)).plant_model(problem).exact
