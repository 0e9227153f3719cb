"""Five observers that break the contract, each in one thing, and the right one that they are made from."""

# ruff: noqa: ARG002 - arguments are those of the contract

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from fpirhc.contracts import Layout, Signal, StateObserver, values_of


@dataclass(frozen=True)
class ConstantGain(StateObserver):
    """x^ = x- + gain (y - h(x-)) for every state that is measured itself; an observer that keeps every law."""

    gain: float

    def check(self, plant, measured):
        """Accept every plant."""

    def memory(self, model):
        state = model.plant.state
        return Layout((Signal("observed_state", state.elements, state.units, tuple(map(float, model.start))),))

    def predict(self, model):
        calm = np.zeros(len(model.plant.names))
        return lambda evidence, memory: model.move(
            memory["observed_state"], evidence.command, evidence.parameters, calm, evidence.moves
        )

    def correct(self, model):
        """A share of what is measured beyond the prediction."""
        elements = model.plant.state.elements

        def corrected(evidence, memory, predicted):
            expected = values_of(model.plant, predicted, evidence.command, evidence.parameters)
            shown = [evidence.measured[e] - expected[e] if e in model.measured else 0 for e in elements]
            state = ca.if_else(evidence.counts, predicted + self.gain * ca.vertcat(*shown), predicted)
            return state, {"observed_state": state}

        return corrected


@dataclass(frozen=True)
class Told(ConstantGain):
    """The observer with evidence that is changed before it is used."""

    def evidence(self, evidence, model):
        raise NotImplementedError

    def predict(self, model):
        inner = super().predict(model)
        return lambda evidence, memory: inner(self.evidence(evidence, model), memory)

    def correct(self, model):
        inner = super().correct(model)
        return lambda evidence, memory, predicted: inner(self.evidence(evidence, model), memory, predicted)


class EverySampleCounts(Told):
    """Corrects with samples that were taken before the run."""

    def evidence(self, evidence, model):
        return replace(evidence, counts=ca.SX(1))


class EverySampleMoves(Told):
    """Predicts a cycle also where the sample still shows the start."""

    def evidence(self, evidence, model):
        return replace(evidence, moves=ca.SX(1))


class KnowsThePlant(Told):
    """Predicts with the exact parameters."""

    def evidence(self, evidence, model):
        return replace(evidence, parameters=ca.DM(model.plant.exact))


class ForgetsItsCorrection(ConstantGain):
    """Remembers what it predicted."""

    def correct(self, model):
        inner = super().correct(model)
        return lambda evidence, memory, predicted: (
            inner(evidence, memory, predicted)[0],
            {"observed_state": predicted},
        )
