"""A wrong member of a family is caught by the public laws, with the law that it breaks; the right one beside it is not."""

from typing import Any

import pytest
from wrong import controllers, maps, observers, optimisers, tables
from wrong.tables import CONTROLLERS, MAPS, OBSERVERS, OPTIMISERS

import fpirhc as fp
from fpirhc.conformance import check_controller, check_deformation, check_observer, check_optimiser, laws_of
from fpirhc.contracts import Controller, Deformation, StateObserver, Tracking

DEFORMATION = fp.Sigmoid(gain=-0.5)
FAMILIES: dict[Any, tuple[Any, tuple[Any, ...], Any]] = {  # wrong members: their table, their settings, their laws
    controllers: (CONTROLLERS, (6.0, DEFORMATION), lambda one: check_controller(one, seed=1, compiled=False)),
    maps: (MAPS, (0.3, 5.0), lambda one: check_deformation(one, seed=1)),
    optimisers: (OPTIMISERS, (100, 1e-6), lambda one: check_optimiser(one, tolerance=1e-6, seed=1)),
    observers: (OBSERVERS, (0.4,), lambda one: check_observer(one, seed=1)),
}
WRONG = [
    pytest.param(wrong(*settings), check, *expected, id=wrong.__name__)
    for table, settings, check in FAMILIES.values()
    for wrong, expected in table.items()
]
LOUD = pytest.param(observers.ConstantGain(3.0), FAMILIES[observers][2], *tables.LOUD, id="Loud")


@pytest.mark.parametrize(("member", "check", "law", "sentence"), [*WRONG, LOUD])
def test_a_wrong_member_is_caught(member, check, law, sentence):
    """One sentence that names the class, the law, the numbers and what to do."""
    told = f"^{type(member).__name__} breaks the law '{law}': .*{sentence}.*The law: "
    with pytest.raises(AssertionError, match=told):
        check(member)


MEMBERS = {
    "controller": (Controller, tables.CONTROLLER_MEMBERS),
    "deformation": (Deformation, tables.MAP_MEMBERS),
    "observer": (StateObserver, tables.OBSERVER_MEMBERS),
    "tracking": (Tracking, tables.TRACKING_MEMBERS),
}


@pytest.mark.parametrize("module", MEMBERS)
def test_every_member_of_a_contract_has_a_law(module):
    """A fact that no law tests may be anything."""
    contract, table = MEMBERS[module]
    own = {n for n in (*vars(contract), *contract.__annotations__) if not n.startswith("_")}
    assert own == {*table}
    laws = laws_of(f"fpirhc.conformance.{module}")
    assert {*table.values()} <= {"frozen value", *(law.__name__.replace("_", " ") for law in laws)}


RIGHT = {
    controllers: controllers.Gentle,
    maps: maps.Softsign,
    optimisers: optimisers.HeavyBall,
    observers: observers.ConstantGain,
}


@pytest.mark.parametrize("module", FAMILIES, ids=lambda module: module.__name__)
def test_the_right_members_are_not_refused(module):
    """Every wrong member is one change away from a right one, and stands in its table."""
    table, settings, check = FAMILIES[module]
    check(RIGHT[module](*settings))
    own = {c for c in vars(module).values() if isinstance(c, type) and c.__module__ == module.__name__}
    assert own - {*RIGHT.values(), observers.Told} == {*table}


def test_a_controller_that_knows_the_exact_parameters_may_say_so():
    """As the bound of a comparison: the same command, honestly named."""

    class Honest(controllers.KnowsThePlant):
        exact_model = True

    check_controller(Honest(6.0, DEFORMATION), seed=1, compiled=False)
    assert fp.Predicted(fp.ExactModel(controllers.Gentle(6.0)), inputs=0.0).exact_model
    assert not fp.ComputedTorque(fp.Exponential(rate=6.0)).exact_model
