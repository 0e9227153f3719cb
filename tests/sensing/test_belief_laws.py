"""Every observer keeps the public laws, and every law catches an observer that breaks it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc.conformance.observer as laws
from fpirhc.conformance import check_observer
from fpirhc.members import examples
from fpirhc.sensing.base import Correct, Model, Predict
from fpirhc.sensing.observers.model_states import ModelStates

BELIEFS = examples("observers")


@pytest.mark.parametrize("number", range(len(BELIEFS)), ids=[f"{type(b).__name__}-{k}" for k, b in enumerate(BELIEFS)])
def test_belief_laws(number: int) -> None:
    check_observer(BELIEFS[number], seed=4)


class Thawed(ModelStates):
    """Can be changed."""

    __setattr__ = object.__setattr__
    __delattr__ = object.__delattr__


@dataclass(frozen=True)
class Boastful(ModelStates):
    """Believes what does not exist."""

    def believes(self, plant: Any, known: Any) -> tuple[str, ...]:
        return (*ModelStates().believes(plant, known), "c")


@dataclass(frozen=True)
class Slow(ModelStates):
    """Moves by nine tenths of what the model moves."""

    def predict(self, model: Model) -> Predict:
        """Nine tenths of a cycle."""
        whole = ModelStates().predict(model)
        return lambda e, m: m["observer_state"] + 0.9 * (whole(e, m) - m["observer_state"])


@dataclass(frozen=True)
class Eager(ModelStates):
    """Takes a part of a cycle for a whole one."""

    def predict(self, model: Model) -> Predict:
        """A whole cycle wherever the sample is later at all."""
        calm = np.zeros(len(model.plant.names))
        return lambda e, m: model.move(m["observer_state"], e.command, e.parameters, calm, e.moves > 0)


@dataclass(frozen=True)
class Fragile(ModelStates):
    """Takes the root of its error."""

    def correct(self, model: Model) -> Correct:
        """NaN where the measured position is below the predicted one; exact where they agree."""

        def corrected(evidence: Any, memory: Any, predicted: Any) -> Any:
            state, after = ModelStates().correct(model)(evidence, memory, predicted)
            error = evidence.measured["a"] - predicted[0]
            part = 1e-20 * ca.if_else(ca.fabs(error) > 1e-9, ca.sqrt(error), 0)
            return state + part, after | {"observer_state": after["observer_state"] + part}

        return corrected


BROKEN = {
    "frozen_value": Thawed(),
    "facts_hold": Boastful(),
    "right_model_believes_what_is": Slow(),
    "lives_in_the_time_of_the_samples": Eager(),
    "finite_under_noise": Fragile(),
}


@pytest.mark.parametrize("law", BROKEN)
def test_a_broken_law_is_named(law: str) -> None:
    with pytest.raises(AssertionError, match=f"{type(BROKEN[law]).__name__} breaks the law '{law.replace('_', ' ')}'"):
        check_observer(BROKEN[law], seed=4)
    assert law in {one.__name__ for one in laws.LAWS}
