"""States that no sensor shows, by the model alone: it is integrated on the own commands.

    x-_k = F(x^_{k-1}, u_{k-1}, p),     x^_k = x-_k with the known states in their places

The errors of the other states, e, then follow the model's own dynamics with the known states as inputs, e' = A_uu e + (what the
model gets wrong): they decay where A_uu does, and drift where it does not. With the right model and start they are zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import Correct, Evidence, Model, Predict, Remembered, StateObserver
from fpirhc.symbolic.layout import Expression, Layout, Signal


@dataclass(frozen=True)
class ModelStates(StateObserver):
    """The model's own states in place of those that are not known.

    Args:
        corrected: whether the model goes on from the known states; False: it runs by itself from the start.
    """

    corrected: bool = True

    def check(self, plant: Plant, measured: tuple[str, ...]) -> None:
        """Accept every plant."""

    def believes(self, plant: Plant, known: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(e for e in plant.state.elements if e not in known)

    def memory(self, model: Model) -> Layout:
        state = model.plant.state
        return Layout((Signal("observer_state", state.elements, state.units, tuple(map(float, model.start))),))

    def predict(self, model: Model) -> Predict:
        calm = np.zeros(len(model.plant.names))

        def predicted(evidence: Evidence, memory: Remembered) -> Expression:
            return model.move(memory["observer_state"], evidence.command, evidence.parameters, calm, evidence.moves)

        return predicted

    def correct(self, model: Model) -> Correct:
        elements = model.plant.state.elements

        def corrected(
            evidence: Evidence, memory: Remembered, predicted: Expression
        ) -> tuple[Expression, dict[str, Expression]]:
            del memory
            state = ca.vertcat(*(evidence.known.get(e, predicted[k]) for k, e in enumerate(elements)))
            return state, {"observer_state": state if self.corrected else predicted}

        return corrected

    def free(self, slopes: Sequence[np.ndarray], shown: Sequence[np.ndarray], known: Sequence[int]) -> np.ndarray:
        del shown
        every = np.eye(len(slopes[0]))
        return np.delete(every, list(known), axis=1) if self.corrected else every


EXAMPLES = (ModelStates(), ModelStates(corrected=False))
